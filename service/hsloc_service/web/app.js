// The page. Whatever comes from a log or a person goes in as text, never as markup.

import { Refused, events, get, hasToken, onToken, post, request, useToken } from "./api.js";
import { build, chosen as chosenOptions } from "./options.js";
import { plot } from "./plot.js";
import { upload } from "./upload.js";
import { Viewer } from "./viewer.js";

const $ = (id) => document.getElementById(id);
const ACTIVE = ["queued", "running", "cancelling"];
let chosen = null; // id of the job that is shown
let watching = null; // AbortController of its events
let uploading = null;
let pages = 1;
let playing = null;
const sent = new WeakMap(); // files that were uploaded for a job that is not queued yet, with their ids

function element(tag, text = "", className = "") {
  const made = document.createElement(tag);
  made.textContent = text;
  if (className) made.className = className;
  return made;
}

function notice(text) {
  $("notice").textContent = text;
  $("notice").hidden = !text;
}

async function guarded(work) {
  try { return await work(); } catch (error) {
    if (error.name !== "AbortError") notice(error instanceof Refused || error instanceof SyntaxError ? error.message : `the server cannot be reached (${error.message})`);
    return undefined;
  }
}

const bytes = (n) => n < 1e6 ? `${(n / 1e3).toFixed(0)} kB` : n < 1e9 ? `${(n / 1e6).toFixed(1)} MB` : `${(n / 1e9).toFixed(2)} GB`;
const when = (text) => new Date(text).toLocaleString();

// --- token -----------------------------------------------------------------------------------------------------------
onToken(() => {
  $("token-form").hidden = false;
  if (hasToken()) notice("this token is unknown, expired or revoked");
});
$("token-form").addEventListener("submit", (event) => {
  event.preventDefault();
  useToken($("token").value);
  $("token").value = "";
  $("token-form").hidden = true;
  notice("");
  refresh();
  about();
  if (chosen) show(chosen, false);
});

async function about() {
  const info = await guarded(() => get("/v1/info"));
  if (info) $("server").textContent = `version ${info.version}, ${bytes(info.free_bytes)} free, ${info.tenant}`;
  if (info && !$("options").children.length) build($("options"), (await guarded(() => get("/v1/options")))?.run ?? []);
}

// --- new job ---------------------------------------------------------------------------------------------------------
function chosenLog() {
  const files = [...$("log").files];
  $("drop-text").textContent = files.length ? `${files.map((f) => f.name).join(", ")} (${bytes(files.reduce((n, f) => n + f.size, 0))})` : "Choose a log, or drop one here";
}
$("log").addEventListener("change", chosenLog);
for (const kind of ["dragover", "dragleave", "drop"]) {
  $("drop").addEventListener(kind, (event) => {
    event.preventDefault();
    $("drop").classList.toggle("over", kind === "dragover");
    if (kind === "drop" && event.dataTransfer.files.length) {
      $("log").files = event.dataTransfer.files;
      chosenLog();
    }
  });
}

function options() {
  const found = chosenOptions($("options"));
  if ($("resume").value) found.resume = $("resume").value;
  return found;
}

async function submit() {
  const wanted = options();
  const report = (done, total, note) => {
    $("upload-bar").value = total ? done / total : 1;
    $("upload-text").textContent = `${bytes(done)} of ${bytes(total)}${note ? `: ${note}` : ""}`;
  };
  // What is there already is not sent again when a later file was paused or refused.
  const send = async (file) => {
    if (!sent.has(file)) sent.set(file, await upload(file, report, uploading.signal));
    return sent.get(file);
  };
  const files = [...$("map").files];
  if (files.length) {
    const yaml = files.find((file) => /\.ya?ml$/i.test(file.name)), image = files.find((file) => file !== yaml);
    if (!yaml || !image || files.length !== 2) throw new SyntaxError("a map is two files: its YAML and its image");
    wanted.map = { yaml: await send(yaml), image: await send(image) };
  }
  const others = ["relations", "reference", "calibration"].filter((name) => $(name).files.length);
  for (const name of others) wanted[name] = await send($(name).files[0]);
  const logs = [];
  for (const file of $("log").files) logs.push(await send(file));
  if (logs.length === 1) [wanted.log] = logs; else wanted.logs = logs;
  const job = await post("/v1/jobs", wanted, { "Idempotency-Key": crypto.randomUUID ? crypto.randomUUID() : String(Math.random()) });
  for (const file of [...$("log").files, ...files, ...others.map((name) => $(name).files[0])]) sent.delete(file);
  await refresh();
  show(job.id, true);
}

$("upload-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  notice("");
  uploading = new AbortController();
  $("go").disabled = true;
  $("stop").hidden = $("upload-progress").hidden = false;
  await guarded(submit);
  if (uploading.signal.aborted) $("upload-text").textContent += ": paused; the same file goes on from here";
  $("go").disabled = false;
  $("go").textContent = uploading.signal.aborted ? "Go on" : "Upload and run";
  $("stop").hidden = true;
});
$("stop").addEventListener("click", () => uploading.abort());

// --- list ------------------------------------------------------------------------------------------------------------
function line(job) {
  const item = element("li"), button = element("button");
  button.type = "button";
  button.append(element("span", job.log, "name"), element("span", job.state, `state ${job.state}`));
  button.append(element("span", `${when(job.created)}, seed ${job.request.seed}${job.rerun_of ? ", run again" : ""}`, "quiet"));
  if (job.progress) {
    const bar = element("progress");
    bar.value = job.progress.fraction;
    bar.setAttribute("aria-label", job.progress.phase);
    button.append(bar);
  }
  button.setAttribute("aria-current", String(job.id === chosen));
  button.dataset.job = job.id;
  button.addEventListener("click", () => show(job.id, true));
  item.append(button);
  return item;
}

async function refresh() {
  const jobs = [];
  let before = null;
  for (let page = 0; page < pages; page += 1) {
    const found = await get(`/v1/jobs?limit=50${before ? `&before=${before}` : ""}`);
    jobs.push(...found.jobs);
    before = found.next;
    if (!before) break;
  }
  const focused = document.activeElement?.dataset?.job;
  $("jobs").replaceChildren(...jobs.map(line));
  if (focused) [...$("jobs").querySelectorAll("button")].find((b) => b.dataset.job === focused)?.focus();
  $("no-jobs").hidden = jobs.length > 0;
  extendable(jobs);
  $("more").hidden = !before;
  return jobs;
}

// Jobs that drew a map, which another can extend; rebuilt only if they changed, so that an open list stays open.
function extendable(jobs) {
  const drew = jobs.filter((job) => job.state === "succeeded" && job.summary?.metrics?.run?.mode === "slam" && job.request.mapper !== "point" && job.request.config?.mapper !== "point");
  const box = $("resume"), ids = ["", ...drew.map((job) => job.id)], before = box.value;
  if (ids.join() === [...box.options].map((option) => option.value).join()) return;
  const option = (value, text) => { const made = element("option", text); made.value = value; return made; };
  box.replaceChildren(option("", "none: begin a new one"), ...drew.map((job) => option(job.id, `${job.log}, ${when(job.created)}`)));
  box.value = ids.includes(before) ? before : "";
}
$("more").addEventListener("click", () => { pages += 1; guarded(refresh); });

// --- one job ---------------------------------------------------------------------------------------------------------
const viewer = new Viewer($("view"), (steps) => scrub(Number($("time").value) + 10 * steps));

async function show(id, focus) {
  chosen = id;
  watching?.abort();
  watching = new AbortController();
  stopPlaying();
  $("job").hidden = false;
  $("result").hidden = true;
  if (location.hash !== `#job=${id}`) history.replaceState(null, "", `#job=${id}`);
  for (const button of $("jobs").querySelectorAll("button")) button.setAttribute("aria-current", String(button.dataset.job === id));
  const mine = watching.signal;
  const job = await guarded(() => get(`/v1/jobs/${id}`));
  if (!job || mine.aborted) return;
  render(job);
  if (focus) $("job-title").focus();
  if (ACTIVE.includes(job.state)) {
    for await (const _ of events(`/v1/jobs/${id}/events`, mine)) {
      const now = await guarded(() => get(`/v1/jobs/${id}`));
      if (now && !mine.aborted) render(now);
    }
  }
  if (mine.aborted) return;
  const ended = await guarded(() => get(`/v1/jobs/${id}`));
  if (!ended || mine.aborted) return;
  render(ended);
  guarded(refresh);
  if (ended.state === "succeeded") await guarded(() => showResult(ended, mine));
}

function render(job) {
  $("job-title").textContent = job.log;
  const state = $("job-state");
  state.replaceChildren(element("span", job.state, `state ${job.state}`));
  if (job.reason) state.append(` (${job.reason})`);
  if (job.message) state.append(`: ${job.message}`);
  if (job.state === "queued") state.append(": waits for a slot");
  const progress = job.progress;
  $("job-bar").hidden = !ACTIVE.includes(job.state);
  if (progress) {
    $("job-bar").value = progress.fraction;
    const speed = progress.phase === "replay" && progress.speed ? `, ${progress.speed.toFixed(0)} times real time` : "";
    const amount = progress.phase === "replay" ? `${progress.done.toFixed(0)} of ${progress.total.toFixed(0)} s` : `${Math.round(100 * progress.fraction)} %`;
    state.append(`: ${progress.phase}, ${amount}${speed}, ${progress.age_s.toFixed(0)} s ago`);
  } else {
    $("job-bar").removeAttribute("value");
  }
  const buttons = [];
  const add = (text, work) => {
    const button = element("button", text);
    button.type = "button";
    button.addEventListener("click", () => guarded(work));
    buttons.push(button);
  };
  if (ACTIVE.includes(job.state)) {
    add("Cancel", async () => { await post(`/v1/jobs/${job.id}/cancel`); render(await get(`/v1/jobs/${job.id}`)); });
  } else {
    add("Run again", async () => { const made = await post(`/v1/jobs/${job.id}/rerun`); await refresh(); show(made.id, true); });
    add("Delete", async () => {
      if (!confirm(`Delete the job on ${job.log} and its results?`)) return;
      await request(`/v1/jobs/${job.id}`, { method: "DELETE" });
      chosen = null;
      $("job").hidden = true;
      history.replaceState(null, "", "#");
      await refresh();
    });
  }
  $("job-buttons").replaceChildren(...buttons);
}

// --- result ----------------------------------------------------------------------------------------------------------
async function showResult(job, mine) {
  const base = `/v1/jobs/${job.id}/results`;
  const manifest = await get(base);
  const names = new Set(manifest.assets.map((asset) => asset.name));
  $("assets").replaceChildren(...manifest.assets.filter((a) => !a.name.startsWith("viewer")).map((a) => assetLine(a)));
  const zip = element("li"), button = element("button", "all files (.zip)");
  button.type = "button";
  button.addEventListener("click", () => guarded(() => download(`${base}.zip`, "results.zip")));
  zip.append(button);
  $("assets").append(zip);
  metrics(job);
  $("result").hidden = false;
  if (!names.has("viewer.json")) return;
  const data = await get(`${base}/viewer.json`);
  const picture = await (await request(`${base}/${data.map.image}`)).blob();
  const image = await createImageBitmap(picture);
  if (mine.aborted) return;
  legend(data);
  viewer.show(data, image);
  scrub(1000);
}

function assetLine(asset) {
  const item = element("li"), button = element("button", asset.name);
  button.type = "button";
  button.addEventListener("click", () => guarded(() => download(asset.href, asset.name)));
  item.append(button, element("span", bytes(asset.size), "quiet"), element("code", asset.sha256));
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

function legend(data) {
  $("legend").replaceChildren(...["trajectory", "odometry", "reference"].filter((name) => data[name]).map((name) => {
    const label = element("label"), box = element("input");
    box.type = "checkbox";
    box.checked = viewer.shown.has(name);
    box.addEventListener("change", () => {
      if (box.checked) viewer.shown.add(name); else viewer.shown.delete(name);
      viewer.draw();
    });
    label.append(box, element("i", "", `i-${name}`), name);
    return label;
  }));
}

function metrics(job) {
  const found = job.summary?.metrics ?? {}, rows = [];
  const row = (name, value) => {
    const line = element("tr"), head = element("th", name);
    head.scope = "row";
    line.append(head, element("td", value));
    rows.push(line);
  };
  if (found.verdict) row("Verdict", found.verdict);
  // The figures as the reports show them: made once, in hsloc.report.table.
  for (const figure of job.summary?.figures ?? []) row(figure.name, figure.values.join(", "));
  if (found.log) row("Log", `${found.log.duration_s.toFixed(1)} s, ${found.log.path_length_m.toFixed(1)} m, ${found.log.odometry_messages} odometry messages`);
  const seconds = job.summary?.timings;
  if (seconds?.times_real_time) row("Speed", `${seconds.times_real_time.toFixed(0)} times real time`);
  if (found.run) row("Run", `hsloc ${found.run.hsloc}, ${found.run.matcher}, preset ${found.run.preset}, seed ${found.run.seed}`);
  if (found.run) row("SHA-256 of the log", found.run.input_sha256);
  $("metrics").tBodies[0].replaceChildren(...rows);
  const reasons = job.summary?.verdict_reasons ?? [], known = new Set(reasons.map((reason) => reason.text));
  const warnings = (job.summary?.warnings ?? []).filter((warning) => !known.has(warning.text)).map(warningText);
  const lines = [...reasons.map((reason) => reason.line), ...warnings, ...(job.summary?.notes ?? [])];
  $("notes").replaceChildren(...lines.map((text) => element("p", text, "quiet")));
}

// Jobs of earlier versions hold warnings as text.
const warningText = (warning) => typeof warning === "string" ? warning : [warning.text, warning.remedy].filter(Boolean).join("; ");

// --- time ------------------------------------------------------------------------------------------------------------
function scrub(value) {
  if (!viewer.data) return;
  const part = Math.min(Math.max(value, 0), 1000);
  $("time").value = String(part);
  const t = viewer.end() * part / 1000;
  viewer.setTime(part >= 1000 ? Infinity : t);
  const path = viewer.data.trajectory, k = viewer.at(path, t);
  $("time-text").textContent = `${t.toFixed(1)} s: ${path.x[k]?.toFixed(2)}, ${path.y[k]?.toFixed(2)} m`;
  plot($("plot"), viewer.data, part >= 1000 ? NaN : t);
}
$("time").addEventListener("input", () => scrub(Number($("time").value)));

function stopPlaying() {
  cancelAnimationFrame(playing);
  playing = null;
  $("play").textContent = "Play";
}
$("play").addEventListener("click", () => {
  if (playing !== null) { stopPlaying(); return; }
  let part = Number($("time").value) >= 1000 ? 0 : Number($("time").value), before = performance.now();
  $("play").textContent = "Stop";
  const step = (now) => {
    part += (now - before) / 20; // the whole log in twenty seconds
    before = now;
    scrub(part);
    if (part < 1000) playing = requestAnimationFrame(step); else stopPlaying();
  };
  playing = requestAnimationFrame(step);
});
$("zoom-in").addEventListener("click", () => viewer.zoom(1.4));
$("zoom-out").addEventListener("click", () => viewer.zoom(1 / 1.4));
$("zoom-all").addEventListener("click", () => viewer.all());
addEventListener("resize", () => scrub(Number($("time").value)));

// --- begin -----------------------------------------------------------------------------------------------------------
about();
guarded(refresh).then(() => {
  const found = /^#job=([0-9a-f-]{36})$/.exec(location.hash);
  if (found) show(found[1], false);
});
setInterval(async () => {
  if (!document.hidden && $("token-form").hidden) {
    try { await refresh(); } catch { /* the next round tries again */ }
  }
}, 3000);
