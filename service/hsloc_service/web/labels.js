// What a person calls a job and notes about it: title, labels, notes.

import { get, patch } from "./api.js";
import { $, element, guarded, notice } from "./dom.js";

let shown = null; // id of the job in the form

// The labels of a job as links to all jobs that have them.
export function chips(labels) {
  return labels.map((label) => {
    const made = element("a", label, "label");
    made.href = `#label=${encodeURIComponent(label)}`;
    return made;
  });
}

export const describe = (id, changes) => patch(`/v1/jobs/${id}`, changes);

// The words between commas.
export const words = (text) => [...new Set(text.split(",").map((word) => word.trim()).filter(Boolean))];

export function show(job) {
  $("job-labels").replaceChildren(...chips(job.labels));
  if (shown === job.id) return; // what is being typed stays
  shown = job.id;
  $("title").value = job.title ?? "";
  $("title").placeholder = job.log;
  $("labels").value = job.labels.join(", ");
  $("notes-text").value = job.notes ?? "";
  $("saved").textContent = "";
}

export function leave() { shown = null; }

// The labels that are known: choices of the table's filter, and suggestions.
export async function known() {
  const { labels } = await get("/v1/labels"), before = $("label-filter").value;
  $("label-filter").replaceChildren(new Option("any label", ""), ...labels.map((label) => new Option(label, label)));
  $("label-filter").value = labels.includes(before) ? before : "";
  $("label-filter").hidden = labels.length === 0;
  $("known-labels").replaceChildren(...labels.map((label) => new Option(label, label)));
}

export function listen(changed) {
  $("describe").addEventListener("submit", (event) => {
    event.preventDefault();
    guarded(async () => {
      const job = await describe(shown, { title: $("title").value.trim() || null, labels: words($("labels").value), notes: $("notes-text").value.trim() || null });
      notice("");
      $("saved").textContent = "saved";
      changed(job);
      show(job);
    });
  });
  $("describe").addEventListener("input", () => { $("saved").textContent = ""; });
}
