// The uploads: what is there, use it again, delete it.

import { get, request } from "./api.js";
import { $, button, bytes, cell, element, guarded, when } from "./dom.js";

let shown = [];
let next = null;

function row(file, useAgain) {
  const line = element("tr"), size = file.state === "complete" ? bytes(file.size) : `${bytes(file.received)} of ${file.size === null ? "?" : bytes(file.size)}`;
  const buttons = element("div", "", "row");
  if (file.state === "complete") buttons.append(button("New job", () => useAgain(file)));
  buttons.append(button("Delete", async () => {
    if (!confirm(`Delete the upload ${file.name}?`)) return;
    await request(`/v1/files/${file.id}`, { method: "DELETE" });
    await show(useAgain);
  }));
  line.append(cell(element("span", file.name, "name")), cell(size), cell(when(file.created)), cell(element("code", file.sha256?.slice(0, 12) ?? "")), cell(buttons));
  return line;
}

export async function show(useAgain, more = false) {
  const found = await get(`/v1/files?limit=50${more && next ? `&before=${next}` : ""}`), info = await get("/v1/info");
  $("quota").textContent = `They take ${bytes(info.upload_bytes)} and the results of your jobs ${bytes(info.result_bytes)}, of ${bytes(info.quota_bytes)}.`;
  shown = more ? [...shown, ...found.files] : found.files;
  next = found.next;
  $("file-table").tBodies[0].replaceChildren(...shown.map((file) => row(file, useAgain)));
  $("file-table").hidden = shown.length === 0;
  $("no-files").hidden = shown.length > 0;
  $("more-files").hidden = !next;
}

export function listen(useAgain) {
  $("more-files").addEventListener("click", () => guarded(() => show(useAgain, true)));
}
