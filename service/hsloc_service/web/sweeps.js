// Sweeps: logs x configurations x seeds. Their list, and one as a matrix that fills while its jobs run.

import { get, post, postOnce, request } from "./api.js";
import { $, button, cell, element, guarded, heading, when } from "./dom.js";

const EVERY_MS = 3000;
let timer = null;

export function leave() { clearTimeout(timer); timer = null; }

// 0,1,2 or 0-9
export function seeds(text) {
  const found = text.split(",").flatMap((part) => {
    const [, first, last] = /^\s*(\d+)\s*(?:-\s*(\d+)\s*)?$/.exec(part) ?? [];
    const span = Number(last ?? first) - Number(first);
    if (!(span >= 0)) throw new SyntaxError(`seeds: ${part.trim() || "nothing"} is no whole number, nor a span such as 0-9`);
    if (span > 999) throw new SyntaxError(`seeds: ${part.trim()} are more than 1000`);
    return Array.from({ length: span + 1 }, (_, k) => Number(first) + k);
  });
  return [...new Set(found)];
}

export const submit = (body) => postOnce("/v1/sweeps", body);

export async function list() {
  const { sweeps } = await get("/v1/sweeps?limit=200");
  $("sweep-table").tBodies[0].replaceChildren(...sweeps.map((sweep) => {
    const row = element("tr"), link = element("a", sweep.name || "sweep");
    link.href = `#sweep=${sweep.id}`;
    row.append(cell(link), cell(`${sweep.jobs} jobs: ${Object.entries(sweep.states).map(([state, n]) => `${n} ${state}`).join(", ")}`), cell(when(sweep.created)));
    return row;
  }));
  $("sweep-table").hidden = sweeps.length === 0;
  $("no-sweeps").hidden = sweeps.length > 0;
}

function run({ job, seed, state, verdict }) {
  const link = element("a", String(seed), verdict ? `badge verdict-${verdict}` : `badge state ${state}`);
  link.href = `#job=${job}`;
  link.setAttribute("aria-label", `seed ${seed}: ${verdict ?? state}`);
  link.title = verdict ?? state;
  return link;
}

export async function show(id) {
  leave();
  const found = await guarded(() => get(`/v1/sweeps/${id}/matrix`));
  if (!found || location.hash !== `#sweep=${id}`) return;
  $("sweep-title").textContent = found.name || "Sweep";
  const table = $("matrix"), head = element("tr"), lines = [];
  head.append(element("td"), ...found.configs.map((config) => heading("col", config)));
  const line = (name, cells) => {
    const row = element("tr");
    row.append(heading("row", name), ...cells);
    lines.push(row);
  };
  found.logs.forEach((log, k) => line(log, found.cells[k].map(({ runs, texts }) => {
    const links = element("div");
    links.append(...runs.flatMap((each) => [run(each), " "]));
    return cell(links, ...texts.map((text) => element("div", text)));
  })));
  if (found.logs.length > 1) line("all logs", found.overall.map((texts) => cell(...texts.map((text) => element("div", text)))));
  table.tHead.replaceChildren(head);
  table.tBodies[0].replaceChildren(...lines);
  const buttons = found.ended ? [button("Delete", async () => {
    if (!confirm("Delete the sweep, its jobs and their results?")) return;
    await request(`/v1/sweeps/${id}`, { method: "DELETE" });
    location.hash = "sweeps";
  })] : [button("Cancel", async () => { await post(`/v1/sweeps/${id}/cancel`); await show(id); })];
  $("sweep-buttons").replaceChildren(...buttons);
  if (!found.ended) timer = setTimeout(() => show(id), EVERY_MS);
}
