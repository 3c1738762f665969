// The page: which part of it is shown, by the address. #job=ID&t=SECONDS, #shared=SECRET&t=SECONDS, #compare=ID,ID,
// #sweep=ID, #sweeps, #files, #label=TEXT; else the jobs.

import { connection, get, hasToken, onToken, post, request, useToken } from "./api.js";
import { $, bytes, guarded, notice } from "./dom.js";
import * as files from "./files.js";
import * as form from "./form.js";
import { offerTopics } from "./inspect.js";
import * as jobs from "./jobs.js";
import * as labels from "./labels.js";
import { build } from "./options.js";
import * as result from "./result.js";
import * as share from "./share.js";
import * as parameters from "./parameters.js";
import * as sweeps from "./sweeps.js";

const EVERY_MS = 3000;
const ID = /^[0-9a-f-]{36}$/; // of a job: what is in the address becomes part of a request's path
const SECRET = /^hss_[\w-]{43}$/; // of a link
const OF_FILES = ["log", "map", "align_to", "reference", "relations", "calibration", "resume", "webhook"]; // ids that say nothing to people
let comparison = null;

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
  about();
  route();
});

// --- a server that does not answer -----------------------------------------------------------------------------------
let asking = null; // timer
connection.addEventListener("change", ({ detail: isAnswering }) => {
  $("offline").textContent = isAnswering ? "" : "The server does not answer: what is shown may be out of date, and what you asked for was not done. It is asked again …";
  $("offline").hidden = isAnswering;
  clearInterval(asking);
  if (!isAnswering) { asking = setInterval(() => request("/healthz").catch(() => null), EVERY_MS); return; }
  if (!$("server").textContent && !document.body.classList.contains("visitor")) about();
  if ($("home").hidden && $("job").hidden) route(); // the other parts, and a job that could not be loaded
});

async function about() {
  const info = await guarded(() => get("/v1/info"));
  if (info) $("server").textContent = `version ${info.version}, ${bytes(info.free_bytes)} free, ${info.tenant}`;
  const options = info && await guarded(() => get("/v1/options"));
  if (!options || $("options").children.length) return;
  parameters.use(options.config_schema);
  build($("options"), options.run);
  $("sweep-configs").closest(".grid").append(parameters.finder($("sweep-configs")));
  offerTopics();
}

// --- parts of the page -----------------------------------------------------------------------------------------------
const useAgain = async (file) => { location.hash = ""; (await form.use(file)).focus(); };

function route(event) {
  const [, name, value = ""] = /^#(\w+)=?(.*)$/.exec(location.hash) ?? [];
  const [list, time] = value.split("&t="), ids = list.split(",").filter(Boolean);
  const ofJobs = (name === "job" && ids.length === 1) || (name === "sweep" && ids.length === 1) || (name === "compare" && ids.length > 0);
  const isShared = name === "shared" && SECRET.test(list);
  const part = isShared ? "job" : name === "files" || name === "sweeps" || (ofJobs && ids.every((id) => ID.test(id))) ? name : "home";
  document.body.classList.toggle("visitor", isShared);
  for (const each of ["home", "job", "compare", "sweep", "sweeps", "files"]) $(each).hidden = each !== part;
  for (const link of document.querySelectorAll("nav a")) {
    if (link.dataset.parts.split(" ").includes(part)) link.setAttribute("aria-current", "page"); else link.removeAttribute("aria-current");
  }
  document.title = "hsloc: where was the robot?";
  result.leave();
  sweeps.leave();
  comparison?.end();
  comparison = null;
  if (event) { notice(""); scrollTo(0, 0); }
  if (isShared) result.showShared(list, Number(time) || 0);
  else if (part === "job") result.show(ids[0], Boolean(event), Number(time) || 0);
  else if (part === "compare") guarded(() => compare(ids));
  else if (part === "sweep") sweeps.show(ids[0]);
  else if (part === "sweeps") guarded(sweeps.list);
  else if (part === "files") guarded(() => files.show(useAgain));
  else if (name === "label") guarded(async () => { await labels.known(); await jobs.refresh(decoded(value)); });
  else {
    if (location.hash.length > 1) notice(`there is nothing at ${location.hash}: the address is not whole`);
    guarded(async () => {
      const known = labels.known();
      if ($("label-filter").value) await known; // which may not be a label any more
      await Promise.all([known, jobs.refresh()]);
    });
  }
}

// A label may be typed into the address as it is.
function decoded(text) {
  try { return decodeURIComponent(text); } catch { return text; }
}

async function compare(ids) {
  const runs = [], address = location.hash;
  for (const id of ids.slice(0, 12)) {
    const job = await get(`/v1/jobs/${id}`), loaded = job.state === "succeeded" ? await result.load(`/v1/jobs/${id}/results`) : null;
    if (location.hash !== address) return; // something else is shown by now
    if (loaded) runs.push({ name: `${job.title ?? job.log}, seed ${job.request.seed}`, href: `#job=${id}`, request: job.request, ...loaded });
    else notice(`${job.log}: ${job.state === "succeeded" ? "made by an earlier version; run it again to compare it" : "it has no result to compare"}`);
  }
  tellApart(runs);
  const seeds = runs.length > 1 ? await get(`/v1/compare?${new URLSearchParams(ids.slice(0, 12).map((id) => ["job", id]))}`) : null;
  if (runs.length && location.hash === address) comparison = new globalThis.ResultComparison($("comparison"), runs, seeds?.names.length ? seeds : null);
}

// Runs of one name get what their settings differ in, else their number.
function tellApart(runs) {
  const text = (key, value) => [key.replaceAll("_", " "), ...(value === true ? [] : [typeof value === "object" ? JSON.stringify(value) : value])].join(" ");
  const setting = (run, key) => run.request[key] && !OF_FILES.includes(key) ? text(key, run.request[key]) : "";
  for (const name of new Set(runs.map((run) => run.name))) {
    const alike = runs.filter((run) => run.name === name), keys = [...new Set(alike.flatMap((run) => Object.keys(run.request)))];
    if (alike.length < 2) continue;
    const differing = keys.filter((key) => new Set(alike.map((run) => setting(run, key))).size > 1);
    const settings = alike.map((run) => differing.map((key) => setting(run, key)).filter(Boolean).join(", "));
    alike.forEach((run, k) => { run.name += new Set(settings).size < alike.length ? ` (${k + 1})` : settings[k] && `, ${settings[k]}`; });
  }
}

form.listen((made) => { if (made.sweep) location.hash = `sweep=${made.sweep}`; else if (made.length === 1) location.hash = `job=${made[0].id}`; else guarded(jobs.refresh); });
jobs.listen();
files.listen(useAgain);
labels.listen(result.renamed);
share.listen();
$("try-sample").addEventListener("click", () => guarded(async () => {
  $("try-sample").disabled = true;
  try {
    const job = await post("/v1/jobs", { log: (await post("/v1/sample-log")).id });
    location.hash = `job=${job.id}`;
  } finally { $("try-sample").disabled = false; }
}));
// The address says which part is shown: it stays.
document.querySelector(".skip").addEventListener("click", (event) => { event.preventDefault(); $("main").focus(); });
addEventListener("hashchange", route);
if (!location.hash.startsWith("#shared=")) about();
route();
setInterval(async () => {
  if (!document.hidden && $("token-form").hidden && !$("home").hidden) {
    try { await jobs.refresh(); } catch { /* the next round tries again */ }
  }
}, EVERY_MS);
