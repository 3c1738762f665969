// What every part of the page needs. Whatever comes from a log or a person goes in as text, never as markup.

import { Refused } from "./api.js";

export const $ = (id) => document.getElementById(id);
export const ACTIVE = ["queued", "running", "cancelling"];

export function element(tag, text = "", className = "") {
  const made = document.createElement(tag);
  made.textContent = text;
  if (className) made.className = className;
  return made;
}

export function cell(...content) {
  const made = element("td");
  made.append(...content);
  return made;
}

// Of a row ("row") or a column ("col").
export function heading(scope, text) {
  const made = element("th", text);
  made.scope = scope;
  return made;
}

// A list below its title, of [text, class]; nothing where there is no line.
export function list(title, lines, what = "") {
  if (!lines.length) return [];
  const all = element("ul");
  all.append(...lines.map(([text, kind]) => element("li", text, kind)));
  const head = element("h3", title);
  if (what) head.append(" ", element("small", what, "quiet"));
  return [head, all];
}

export function button(text, work, className = "") {
  const made = element("button", text, className);
  made.type = "button";
  made.addEventListener("click", () => guarded(work));
  return made;
}

export function notice(text) {
  $("notice").textContent = text;
  $("notice").hidden = !text;
}

export async function guarded(work) {
  try { return await work(); } catch (error) {
    // That the server does not answer is shown above all parts of the page already.
    if (error.name !== "AbortError" && error.status !== 0) notice(error instanceof Refused || error instanceof SyntaxError ? error.message : `this page has a fault: ${error.message}`);
    return undefined;
  }
}

export const bytes = (n) => n < 1e3 ? `${n} B` : n < 1e6 ? `${(n / 1e3).toFixed(0)} kB` : n < 1e9 ? `${(n / 1e6).toFixed(1)} MB` : `${(n / 1e9).toFixed(2)} GB`;
export const when = (text) => new Date(text).toLocaleString([], { dateStyle: "short", timeStyle: "short" });
// As format_duration in hsloc/report/table.py.
export function duration(s) {
  const whole = Math.round(s), two = (n) => String(n).padStart(2, "0");
  if (s < 60) return `${s.toFixed(1)} s`;
  return whole < 3600 ? `${Math.floor(whole / 60)} min ${two(whole % 60)} s` : `${Math.floor(whole / 3600)} h ${two(Math.floor(whole % 3600 / 60))} min`;
}

// How long a job ran.
export const ran = (job) => duration((new Date(job.ended) - new Date(job.started)) / 1000);

// The verdict of a result, or the state of a job that has none.
export function badge(job) {
  const verdict = job.state === "succeeded" && (job.summary?.verdict ?? job.summary?.metrics?.verdict);
  const made = verdict ? element("span", verdict, `badge verdict-${verdict}`) : element("span", job.state, `badge state ${job.state}`);
  made.dataset.state = job.state;
  return made;
}
