// The form of a new job: files that are dropped, chosen or uploaded already, and the options that the server offers.

import { get, post, postOnce } from "./api.js";
import { $, bytes, element, guarded, notice, when } from "./dom.js";
import * as inspection from "./inspect.js";
import { chosen as chosenOptions } from "./options.js";
import * as parameters from "./parameters.js";
import * as sweeps from "./sweeps.js";
import { upload } from "./upload.js";

const MAPS = { map: "map", align_to: "floor plan" }; // options of two files, and what they are called
let uploading = null;
const sent = new WeakMap(); // files that were uploaded, with their ids: the same choice is not sent twice

function chosenLog() {
  const files = [...$("log").files];
  $("drop-text").textContent = files.length ? `${files.map((f) => f.name).join(", ")} (${bytes(files.reduce((n, f) => n + f.size, 0))})` : "Choose logs, or drop them here";
  $("many").hidden = files.length < 2;
  inspection.hide();
}

export function listen(submitted) {
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
  $("more-options").addEventListener("toggle", () => { if ($("more-options").open) guarded(reusable); });
  const working = async (work) => {
    notice("");
    uploading = new AbortController();
    $("go").disabled = $("inspect").disabled = true;
    $("stop").hidden = $("upload-progress").hidden = false;
    const found = await guarded(work);
    if (uploading.signal.aborted) $("upload-text").textContent += ": paused; the same file goes on from here";
    else { $("upload-text").textContent = ""; $("upload-progress").hidden = true; }
    $("go").disabled = $("inspect").disabled = false;
    $("go").textContent = uploading.signal.aborted ? "Go on" : "Upload and run";
    $("stop").hidden = true;
    return found;
  };
  $("upload-form").addEventListener("submit", async (event) => {
    event.preventDefault();
    const jobs = await working(submit);
    if (!jobs) return;
    inspection.hide();
    submitted(jobs);
  });
  $("inspect").addEventListener("click", () => working(inspect));
  inspection.listen();
  $("stop").addEventListener("click", () => uploading.abort());
}

function options() {
  const found = chosenOptions($("options"));
  if ($("resume").value) found.resume = $("resume").value;
  return found;
}

// Uploads what is chosen, and gives the requests of the jobs.
async function requests() {
  const wanted = options(), files = [...$("log").files], stored = $("stored").value;
  if (!files.length && !stored) throw new SyntaxError("choose a log, or drop one on the field");
  const report = (name) => (done, total, note) => {
    $("upload-bar").value = total ? done / total : 1;
    $("upload-text").textContent = `${name}: ${bytes(done)} of ${bytes(total)}${note ? `: ${note}` : ""}`;
  };
  // What is there already is not sent again when a later file was paused or refused.
  const send = async (file) => {
    if (sent.has(file)) return sent.get(file);
    try { sent.set(file, await upload(file, report(file.name), uploading.signal)); } catch (error) {
      if (error.name !== "AbortError") error.message = `${file.name}: ${error.message}`;
      throw error;
    }
    return sent.get(file);
  };
  for (const [name, what] of Object.entries(MAPS)) {
    const chosen = [...$(name).files];
    if (chosen.length) {
      const yaml = chosen.find((file) => /\.ya?ml$/i.test(file.name)), image = chosen.find((file) => file !== yaml);
      if (!yaml || !image || chosen.length !== 2) throw new SyntaxError(`a ${what} is two files: its YAML and its image`);
      wanted[name] = { yaml: await send(yaml), image: await send(image) };
    } else if ($(`stored-${name}`).value) {
      const [yaml, image] = $(`stored-${name}`).value.split(" ");
      wanted[name] = { yaml, image };
    }
  }
  const others = ["relations", "reference", "calibration"].filter((name) => $(name).files.length);
  for (const name of others) wanted[name] = await send($(name).files[0]);
  const parts = document.querySelector("input[name=many]:checked").value === "parts" && files.length > 1;
  const found = [];
  if (parts) {
    const logs = [];
    for (const file of files) logs.push(await send(file));
    found.push({ ...wanted, logs });
  } else {
    if (stored) found.push({ ...wanted, log: stored });
    for (const file of files) found.push({ ...wanted, log: await send(file) });
  }
  return found;
}

async function submit() {
  const jobs = [], wanted = $("sweep-seeds").value.trim() || $("sweep-configs").value.trim();
  try {
    if (wanted) {
      const seeds = sweeps.seeds($("sweep-seeds").value.trim() || "0"), configs = parameters.configs($("sweep-configs").value);
      const found = await requests();
      if (found.some((request) => request.logs)) throw new SyntaxError("a sweep runs each log by itself; choose \"a job for each\"");
      if (found[0].resume) throw new SyntaxError("a sweep does not extend maps");
      const { log, seed, ...run } = found[0];
      const name = [...$("log").files].map((file) => file.name).join(", ").slice(0, 200);
      return { sweep: (await sweeps.submit({ name, logs: found.map((request) => request.log), seeds, run, ...(configs ? { configs } : {}) })).id };
    }
    for (const request of await requests()) {
      jobs.push(await postOnce("/v1/jobs", request));
    }
  } catch (error) {
    forget(error);
    throw error;
  }
  return jobs;
}

// An upload may have been deleted: the next attempt sends all of them again.
function forget(error) {
  if (!error.status) return;
  for (const name of ["log", ...Object.keys(MAPS), "relations", "reference", "calibration"]) for (const file of $(name).files) sent.delete(file);
}

async function inspect() {
  try {
    const [first] = await requests();
    $("upload-text").textContent = "reading it …";
    await inspection.show(await post("/v1/inspect", first));
  } catch (error) {
    forget(error);
    throw error;
  }
}

const isMap = (file) => /\.(ya?ml|pgm|png|bmp)$/i.test(file.name);

// Uploads and maps that another job can use; rebuilt only if they changed, so that an open list stays open.
async function reusable() {
  const { files } = await get("/v1/files?limit=200"), complete = files.filter((file) => file.state === "complete");
  const stem = (name) => name.replace(/\.[^.]+$/, "");
  const logs = complete.filter((file) => !isMap(file)).map((file) => [file.id, `${file.name}, ${bytes(file.size)}, ${when(file.created)}`]);
  const images = complete.filter((file) => /\.(pgm|png|bmp)$/i.test(file.name));
  const maps = complete.filter((file) => /\.ya?ml$/i.test(file.name)).flatMap((yaml) => {
    // Images of its name; where there is none, the YAML may state any of them.
    const own = images.filter((each) => stem(each.name) === stem(yaml.name)).slice(0, 1);
    return (own.length ? own : images).map((image) => [`${yaml.id} ${image.id}`, `${yaml.name} and ${image.name}, ${when(yaml.created)}`]);
  });
  const { jobs } = await get("/v1/jobs?limit=200&state=succeeded&brief=true");
  const built = jobs.filter((job) => job.summary?.mode === "slam" && job.request.mapper !== "point" && job.request.config?.mapper !== "point");
  fill($("stored"), "none", logs);
  for (const name of Object.keys(MAPS)) fill($(`stored-${name}`), "none", maps);
  fill($("resume"), "none", built.map((job) => [job.id, `${job.log}, ${when(job.created)}`]));
}

function fill(box, none, entries) {
  const values = ["", ...entries.map(([value]) => value)], before = box.value;
  if (values.join() === [...box.options].map((option) => option.value).join()) return;
  box.replaceChildren(...[["", none], ...entries].map(([value, text]) => { const made = element("option", text); made.value = value; return made; }));
  box.value = values.includes(before) ? before : "";
}

// For an upload that is to be used in a new job: returns the list in which it is chosen.
export async function use(file) {
  $("more-options").open = true;
  await guarded(reusable);
  const box = $(isMap(file) ? "stored-map" : "stored");
  const choice = [...box.options].find((option) => option.value.split(" ").includes(file.id));
  if (choice) box.value = choice.value;
  else notice(isMap(file) ? `${file.name}: a map is a YAML and an image; upload the other one, too` : `${file.name} is not among the newest uploads`);
  return box;
}
