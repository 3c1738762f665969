// One job: its state while it runs, then its result as report.html shows it.

import { events, get, hasToken, post, request } from "./api.js";
import { $, ACTIVE, badge, button, bytes, cell, duration, element, guarded, heading, list, ran } from "./dom.js";
import * as labels from "./labels.js";
import * as share from "./share.js";

let watching = null; // AbortController of the job that is shown
let view = null;
let shownJob = null; // its id
let addressing = null; // timer after which the address holds the time that is shown

export function leave() {
  watching?.abort();
  watching = null;
  clearTimeout(addressing);
  view?.end();
  view = null;
  labels.leave();
  share.leave();
}

// `time` (s) is where the result is opened, as in a link that somebody sent.
export async function show(id, focus, time = 0) {
  const mine = begin();
  shownJob = id;
  const job = await guarded(() => get(`/v1/jobs/${id}`));
  if (!isThere(job, mine)) return;
  render(job);
  if (focus) $("job-title").focus();
  const ending = follow(job, mine);
  if (ACTIVE.includes(job.state)) await ending;
  if (mine.aborted) return;
  const ended = ACTIVE.includes(job.state) ? await guarded(() => get(`/v1/jobs/${id}`)) : job;
  if (!ended || mine.aborted) return;
  if (ended !== job) render(ended);
  if (ended.state === "succeeded") await guarded(() => showResult(ended, `/v1/jobs/${id}/results`, mine, time));
}

// The job that a link shows, read-only.
export async function showShared(secret, time = 0) {
  const mine = begin(), job = await guarded(() => get(`/v1/shared/${secret}`));
  if (!isThere(job, mine)) return;
  render(job, false);
  if (job.state === "succeeded") await guarded(() => showResult(job, `/v1/shared/${secret}/results`, mine, time));
}

// Of a job that is deleted, or a link that is revoked, there is the notice alone.
function isThere(job, mine) {
  if (!mine.aborted) $("job").hidden = !job;
  return Boolean(job) && !mine.aborted;
}

function begin() {
  leave();
  watching = new AbortController();
  $("result").hidden = $("job-log").hidden = $("start-here").hidden = $("state-loops").hidden = true;
  $("headline").replaceChildren();
  $("facts").textContent = "";
  $("job-log").lastElementChild.textContent = $("job-notes").textContent = "";
  return watching.signal;
}

// Others of the queue end without an event of this job.
async function watchQueue(job, mine) {
  while (job?.state === "queued") {
    await new Promise((done) => { setTimeout(done, 5000); });
    if (mine.aborted) return;
    job = await guarded(() => get(`/v1/jobs/${job.id}`));
    if (job?.state === "queued" && !mine.aborted) render(job);
  }
}

// What the job's process writes, and how far it is, until it has ended.
async function follow(job, mine) {
  watchQueue(job, mine);
  const isActive = ACTIVE.includes(job.state), box = $("job-log"), text = box.lastElementChild;
  box.open = isActive ? box.open : ["failed", "crashed"].includes(job.state);
  for await (const { kind, data } of events(`/v1/jobs/${job.id}/events`, mine)) {
    if (kind === "log") {
      const atEnd = text.scrollTop + text.clientHeight >= text.scrollHeight - 4;
      text.append(`${data.lines.join("\n")}\n`);
      box.hidden = false;
      if (atEnd) text.scrollTop = text.scrollHeight;
    } else if (isActive) {
      const now = await guarded(() => get(`/v1/jobs/${job.id}`));
      if (now && !mine.aborted) render(now);
    }
  }
}

export function renamed(job) {
  $("job-title").replaceChildren(job.title ?? job.log, ...(job.title ? [" ", element("small", job.log, "quiet")] : []));
  $("job-notes").textContent = job.notes ?? "";
  document.title = `${job.title ?? job.log}: hsloc`;
}

function render(job, isMine = true) {
  renamed(job);
  labels.show(job);
  const state = $("job-state");
  // "succeeded" beside the verdict "failed" would be read as a contradiction.
  const ended = job.state === "succeeded" && job.summary?.verdict_text && job.started ? `ran for ${ran(job)}` : null;
  state.replaceChildren(element("span", ended ?? job.state, `state ${job.state}${ended ? " quiet" : ""}`));
  if (job.reason) state.append(` (${job.reason.replaceAll("_", " ")})`);
  if (job.message) state.append(`: ${job.message}`);
  if (job.state === "queued") state.append(`: waits for a slot${place(job.queue)}`);
  const progress = job.progress;
  $("job-bar").hidden = !ACTIVE.includes(job.state);
  if (progress) {
    if (progress.total > 0) $("job-bar").value = progress.fraction;
    else $("job-bar").removeAttribute("value");  // how much there is to do is not known
    state.append(`: ${progress.text}, ${amount(progress)}, ${progress.age_s.toFixed(0)} s ago`);
  } else {
    $("job-bar").removeAttribute("value");
  }
  const settings = Object.fromEntries(Object.entries(job.request).filter(([, value]) => value !== null));
  $("job-request").lastElementChild.textContent = JSON.stringify(settings, null, 2);
  offer(job, isMine);
  $("job-describe").hidden = !isMine;
}

function amount({ phase, done, total, fraction, speed }) {
  if (phase === "compile") return `${done} done`;
  if (phase !== "replay") return `${Math.round(100 * fraction)} %`;
  return `${done.toFixed(0)} of ${total.toFixed(0)} s${speed ? `, ${speed.toFixed(0)} times real time` : ""}`;
}

function place(queue) {
  if (!queue) return "";
  const ahead = queue.ahead === 0 ? "next of yours" : `${queue.ahead} of yours before it`;
  return `, ${ahead}${queue.wait_s === null ? "" : `, begins in about ${duration(queue.wait_s)}`}`;
}

// What can be done with a job. While it runs the buttons stay, so that progress does not take the focus from them.
function offer(job, isMine) {
  const box = $("job-buttons"), of = isMine && ACTIVE.includes(job.state) ? job.id : "", buttons = [];
  if (of && box.dataset.of === of) return;
  box.dataset.of = of;
  if (ACTIVE.includes(job.state)) {
    buttons.push(button("Cancel", async () => { await post(`/v1/jobs/${job.id}/cancel`); render(await get(`/v1/jobs/${job.id}`)); }));
  } else {
    buttons.push(button("Run again", async () => { location.hash = `job=${(await post(`/v1/jobs/${job.id}/rerun`)).id}`; }));
    buttons.push(button("Delete", async () => {
      if (!confirm(`Delete the job on ${job.log} and its results?`)) return;
      await request(`/v1/jobs/${job.id}`, { method: "DELETE" });
      location.hash = "";
    }));
  }
  box.replaceChildren(...(isMine ? buttons : []));
}

// The view of a result, and the picture of its map; `base` is the address of its files.
export async function load(base) {
  const data = await get(`${base}/viewer.json`);
  // Jobs of earlier versions have a view that this page cannot draw.
  if (!data.extent) return null;
  const image = data.map ? await createImageBitmap(await (await request(`${base}/${data.map.image}`)).blob()) : null;
  return { data, image };
}

async function showResult(job, base, mine, time) {
  const manifest = await get(base), isShared = base.startsWith("/v1/shared/");
  const names = new Set(manifest.assets.map((asset) => asset.name));
  const files = manifest.assets.filter((a) => !a.name.startsWith("viewer")).map(assetLine), zip = element("li");
  if (isShared) zip.hidden = true;
  else zip.append(button("all files (.zip)", () => download(`${base}.zip`, "results.zip")));
  if (!isShared) share.show(job.id);
  if (!isShared && names.has("run.mcap")) $("job-buttons").append(...share.viewerButtons(job.id));
  if (names.has("report.html") && (isShared || !hasToken())) {
    const item = element("li"), link = element("a", "open the report");
    link.href = `${base}/report.html?download=false`;
    link.target = "_blank";
    item.append(link);
    files.unshift(item);
  }
  $("assets").replaceChildren(...files, zip);
  summary(job, null);
  $("result").hidden = false;
  const loaded = names.has("viewer.json") ? await load(base) : null;
  if (!loaded || mine.aborted) return;
  summary(job, loaded.data.summary);
  view = new globalThis.ResultView($("view"), loaded.data, loaded.image, $("charts"));
  const built = job.summary?.mode === "slam" || job.summary?.metrics?.run?.mode === "slam";
  if (!isShared && !built) view.offerPose("run again from a start pose: drag an arrow");
  if (!isShared && built && loaded.data.loops && !job.request.resume) offerLoops(job);
  if (time > 0) view.seek(time);
}

// An arrow was dragged on the map: where the robot stood when the log begins.
$("view").addEventListener("pose", ({ detail: pose }) => {
  const bar = $("start-here"), [x, y, yaw] = pose;
  bar.hidden = false;
  bar.firstElementChild.textContent = `start at x ${x.toFixed(2)} m, y ${y.toFixed(2)} m, ${(180 * yaw / Math.PI).toFixed(1)}°`;
  const id = shownJob;
  bar.replaceChildren(bar.firstElementChild, button("Run again from here", async () => {
    location.hash = `job=${(await post(`/v1/jobs/${id}/rerun`, { initial_pose: pose, unknown_start: false })).id}`;
  }, "primary"), button("Cancel", () => { bar.hidden = true; view?.setPose(null); }));
});

// Two places of the trajectory were clicked, of which a person knows whether they are one: loops for the next run.
const LOOPS = [["assert-loop", "assert_loop", "green"], ["forbid-loop", "forbid_loop", "vermillion"]]; // field, option, ink
let clicked = [];

function showLoops(times) {
  clicked = times;
  $("state-loops").querySelector("p").textContent = times.length < 2 ? "Click two places of the trajectory: the same place, seen at two times, or two that look alike."
    : `${times.map((t) => `${t.toFixed(1)} s`).join(" and ")}: one place, or two that look alike?`;
  $("one-place").disabled = $("two-places").disabled = times.length < 2;
}

const written = (id) => $(id).value.split(",").filter((part) => part.trim());

function pairs(id) {
  const times = written(id).map(Number);
  if (times.length % 2 || times.some((t) => !(t >= 0))) throw new SyntaxError("loops: pairs of times in seconds are needed, such as 12.5,140");
  return times;
}

function drawLoops() {
  const found = [];
  for (const [id, , ink] of LOOPS) {
    const times = pairs(id);
    for (let k = 0; k < times.length; k += 2) found.push([times[k], times[k + 1], ink]);
  }
  view?.setLoops(found);
}

function offerLoops(job) {
  for (const [id, name] of LOOPS) $(id).value = job.request[name] ?? "";
  view.offerLoop("state a loop: click two places");
  guarded(drawLoops);
}

function state(id) {
  $(id).value = [...written(id), ...clicked.map((t) => t.toFixed(1))].join(",");
  showLoops([]);
  guarded(drawLoops);
}

$("view").addEventListener("loop", ({ detail }) => { $("state-loops").hidden = !view.picking; showLoops(detail); });
$("one-place").addEventListener("click", () => state("assert-loop"));
$("two-places").addEventListener("click", () => state("forbid-loop"));
for (const [id] of LOOPS) $(id).addEventListener("change", () => guarded(drawLoops));
$("state-loops").addEventListener("submit", (event) => {
  event.preventDefault();
  const id = shownJob;
  guarded(async () => {
    const wanted = Object.fromEntries(LOOPS.map(([box, name]) => [name, pairs(box).join(",") || null]));
    location.hash = `job=${(await post(`/v1/jobs/${id}/rerun`, wanted)).id}`;
  });
});

// The address holds the time that is shown, so that it can be sent.
$("view").addEventListener("seek", (event) => {
  if (!view) return;
  clearTimeout(addressing);
  addressing = setTimeout(() => {
    const [job] = location.hash.split("&");
    history.replaceState(null, "", event.detail > 0 ? `${job}&t=${event.detail.toFixed(1)}` : job);
  }, 300);
});

function assetLine(asset) {
  const item = element("li");
  item.append(button(asset.name, () => download(asset.href, asset.name)), element("span", bytes(asset.size), "quiet"), element("code", asset.sha256));
  return item;
}

// Through fetch, because a link cannot carry the token.
async function download(path, name) {
  const blob = await (await request(path)).blob();
  const link = document.createElement("a");
  link.href = URL.createObjectURL(blob);
  link.download = name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60000);
}

// The summary as the reports show it: made once, by hsloc.report.summary. The job's row holds it without explanations.
function summary(job, whole) {
  const short = job.summary ?? {}, found = short.metrics ?? {}, figures = whole?.figures ?? short.figures ?? [];
  const headline = element("span", short.headline ?? "");
  $("headline").replaceChildren(badge(job), " ", headline);
  if (short.verdict_text) badgeText($("headline").firstChild, short.verdict_text);
  // What the verdict means, without its word; jobs of earlier versions have no text of it.
  const meaning = (short.verdict_text ?? "").split(": ").slice(1).join(": ");
  $("facts").textContent = [meaning, ...(whole?.facts ?? [])].filter(Boolean).join(" · ");
  $("key-figures").replaceChildren(...(short.key_figures ?? []).map((name) => {
    const figure = figures.find((each) => each.name === name), box = element("div");
    box.append(element("dt", name), element("dd", figure?.values.join(" / ") ?? ""), element("dd", figure?.explanation ?? "", "quiet"));
    return box;
  }));
  const reasons = short.verdict_reasons ?? [], known = new Set(reasons.map((reason) => reason.text));
  const warnings = whole?.warnings ?? [...(short.warnings ?? []).filter((warning) => !known.has(warning.text)).map(warningText), ...(short.notes ?? [])];
  const lines = (texts) => texts.map((text) => [text]);
  // The headings are those of hsloc.report.summary.
  $("notes").replaceChildren(
    ...list("Look at this", lines(whole?.reasons ?? reasons.map((reason) => reason.line)), "what speaks against the result: why the verdict is not good"),
    ...list("Warnings", lines(warnings), "what was assumed, corrected, doubtful or lost: the verdict does not rest on it"));
  const rows = [];
  const row = (name, values, explanation = "") => {
    const line = element("tr");
    line.append(heading("row", name), cell(values.join(" / ")), element("td", explanation, "quiet"));
    rows.push(line);
  };
  if (found.verdict) row("verdict", [short.verdict_text ?? found.verdict]);
  for (const figure of figures) row(figure.name, figure.values, figure.explanation);
  if (found.log) row("log", [`${found.log.duration_s.toFixed(1)} s, ${found.log.path_length_m.toFixed(1)} m, ${found.log.odometry_messages} odometry messages`]);
  if (short.timings?.times_real_time) row("speed", [`${short.timings.times_real_time.toFixed(short.timings.times_real_time < 10 ? 1 : 0)} times real time`]);
  if (found.run) row("run", [`hsloc ${found.run.hsloc}, ${found.run.matcher ?? "graph mapper"}, preset ${found.run.preset}, seed ${found.run.seed}`]);
  if (found.run) row("SHA-256 of the log", [found.run.input_sha256]);
  $("metrics").tBodies[0].replaceChildren(...rows);
}

const badgeText = (mark, text) => { mark.title = text; };
// Jobs of earlier versions hold warnings as text.
const warningText = (warning) => typeof warning === "string" ? warning : [warning.text, warning.remedy].filter(Boolean).join("; ");
