// The table of jobs: search, filter, order, pages, and what can be done with those that are ticked.

import { get, post, request } from "./api.js";
import { $, badge, cell, duration, element, guarded, ran, when } from "./dom.js";
import { chips, describe, known, words } from "./labels.js";

const PAGE = 50;
const ticked = new Set();
let offset = 0;

// Of a table that is polled every row stays while it says the same, so that focus and ticks stay.
const rows = new Map();

// Under each other in all rows, so that they can be compared at a glance.
function figures(found) {
  const box = element("div", "", "of-job");
  box.append(...found.map(({ name, values }) => {
    const each = element("div");
    each.append(element("small", name, "quiet"), " ", element("strong", values.join(" / ")));
    return each;
  }));
  return box;
}

// Small pictures of results, as object URLs by job; null where one could not be had.
const pictures = new Map();

// Those that come into sight are loaded, with some that are near.
const wanted = new WeakMap();
const sight = new IntersectionObserver((seen) => {
  for (const { target } of seen.filter((each) => each.isIntersecting)) { sight.unobserve(target); picture(target, ...wanted.get(target)); }
}, { rootMargin: "300px" });

async function picture(image, id, name) {
  if (!pictures.has(id)) {
    const answer = request(`/v1/jobs/${id}/results/${name}`);
    pictures.set(id, answer.then((found) => found.blob()).then((blob) => URL.createObjectURL(blob)).catch(() => null));
  }
  const address = await pictures.get(id);
  if (address) image.src = address; else image.remove();
}

function thumbnail(job) {
  if (!job.summary?.thumbnail) return []; // jobs of earlier versions have none
  const image = element("img");
  Object.assign(image, { alt: "", width: 72, height: 48 });
  wanted.set(image, [job.id, job.summary.thumbnail]);
  sight.observe(image);
  return [image];
}

function row(job) {
  const key = JSON.stringify(job, (name, value) => name === "age_s" || name === "heartbeat_age_s" ? undefined : value);
  const known = rows.get(job.id);
  if (known?.key === key) return known.line;
  const line = element("tr"), box = element("input");
  box.type = "checkbox";
  box.checked = ticked.has(job.id);
  box.setAttribute("aria-label", `select ${job.title ?? job.log}`);
  box.addEventListener("change", () => { if (box.checked) ticked.add(job.id); else ticked.delete(job.id); tick(); });
  const link = element("a", job.title ?? job.log, "name");
  link.href = `#job=${job.id}`;
  link.dataset.job = job.id;
  const result = cell(badge(job)), summary = job.summary ?? {};
  if (job.progress) {
    const bar = element("progress");
    if (job.progress.total > 0) bar.value = job.progress.fraction;
    bar.title = job.progress.text;
    bar.setAttribute("aria-label", `${job.progress.text}: ${job.log}`);
    result.append(bar);
  }
  const name = element("div"), named = element("div", "", "named");
  name.append(link, ...(job.title ? [element("small", job.log, "quiet name")] : []), ...chips(job.labels));
  named.append(...thumbnail(job), name);
  line.append(cell(box), cell(named), result,
    summary.key_figures?.length ? cell(figures(summary.key_figures)) : cell(job.message || ""),
    cell(summary.mode ?? ""), cell(summary.duration_s ? duration(summary.duration_s) : ""),
    cell(job.started && job.ended ? ran(job) : ""),
    cell(when(job.created) + (job.rerun_of ? ", run again" : "")));
  if (known && known.line.contains(document.activeElement)) queueMicrotask(() => link.focus());
  rows.set(job.id, { key, line });
  return line;
}

function forget(id) {
  rows.delete(id);
  pictures.get(id)?.then((address) => { if (address) URL.revokeObjectURL(address); });
  pictures.delete(id);
}

export async function refresh(label) {
  if (label !== undefined) {
    // One that no job has any more is a choice, too, so that the table says so.
    if (![...$("label-filter").options].some((option) => option.value === label)) $("label-filter").append(new Option(label, label));
    $("label-filter").hidden = false;
    $("label-filter").value = label;
  }
  const query = new URLSearchParams({ brief: "true", limit: PAGE, offset, order: $("order").value });
  if ($("search").value.trim()) query.set("search", $("search").value.trim());
  const [name, value] = $("filter").value.split("=");
  if (value) query.set(name, value);
  if ($("label-filter").value) query.set("label", $("label-filter").value);
  const { jobs, total } = await get(`/v1/jobs?${query}`);
  if (!jobs.length && offset) { offset = Math.max(offset - PAGE, 0); return refresh(); }
  const lines = jobs.map(row), body = $("jobs").tBodies[0];
  if (lines.length !== body.rows.length || lines.some((line, k) => body.rows[k] !== line)) body.replaceChildren(...lines);
  for (const id of rows.keys()) if (!jobs.some((job) => job.id === id)) forget(id);
  const filtered = Boolean(value || query.has("search") || query.has("label"));
  $("no-jobs").hidden = total > 0 || filtered;
  for (const part of [$("jobs"), document.querySelector(".filters"), document.querySelector(".pages")]) part.hidden = total === 0 && !filtered;
  $("page-text").textContent = total ? `${offset + 1} to ${offset + jobs.length} of ${total}` : filtered ? "no such job" : "";
  $("newer").disabled = offset === 0;
  $("older").disabled = offset + jobs.length >= total;
  tick();
  return jobs;
}

function tick() {
  $("ticked").hidden = ticked.size === 0;
  $("ticked-text").textContent = `${ticked.size} selected`;
  const boxes = [...$("jobs").tBodies[0].querySelectorAll("input")];
  $("tick-all").checked = boxes.length > 0 && boxes.every((box) => box.checked);
  $("compare-ticked").disabled = ticked.size < 2;
}

async function each(work) {
  try { for (const id of [...ticked]) { await work(id); ticked.delete(id); } } finally {
    rows.clear();
    await refresh();
  }
}

export function listen() {
  const again = () => { offset = 0; guarded(refresh); };
  let timer = null;
  $("search").addEventListener("input", () => { clearTimeout(timer); timer = setTimeout(again, 250); });
  for (const id of ["filter", "label-filter"]) $(id).addEventListener("change", again);
  $("order").addEventListener("change", again);
  $("older").addEventListener("click", () => { offset += PAGE; guarded(refresh); });
  $("newer").addEventListener("click", () => { offset = Math.max(offset - PAGE, 0); guarded(refresh); });
  $("tick-all").addEventListener("change", () => {
    const wanted = $("tick-all").checked;
    for (const box of $("jobs").tBodies[0].querySelectorAll("input")) if (box.checked !== wanted) box.click();
  });
  $("compare-ticked").addEventListener("click", () => { location.hash = `compare=${[...ticked].join(",")}`; });
  $("rerun-ticked").addEventListener("click", () => guarded(() => each((id) => post(`/v1/jobs/${id}/rerun`))));
  $("label-ticked").addEventListener("click", () => guarded(async () => {
    const added = words($("ticked-label").value);
    if (!added.length) throw new SyntaxError("type a label for the jobs that are selected");
    for (const id of ticked) await describe(id, { labels: [...(await get(`/v1/jobs/${id}`)).labels, ...added] });
    $("ticked-label").value = "";
    await known();
    await refresh();
  }));
  $("delete-ticked").addEventListener("click", () => {
    if (!confirm(`Delete ${ticked.size} jobs and their results?`)) return;
    guarded(() => each((id) => request(`/v1/jobs/${id}`, { method: "DELETE" })));
  });
}
