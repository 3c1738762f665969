// Links by which a job is seen without a token: make one, see which are valid, revoke; and other viewers.

import { get, post, request } from "./api.js";
import { $, button, element, guarded, when } from "./dom.js";

// Both run in the browser: the file goes nowhere else. Foxglove needs an account.
const VIEWERS = [["Lichtblick", "https://lichtblick-suite.github.io/lichtblick/"], ["Foxglove", "https://app.foxglove.dev/~/view"]];
const VIEWER_DAYS = 1;
let shown = null; // id of the job

const make = (id, days) => post(`/v1/jobs/${id}/shares`, { valid_days: days });

async function list() {
  const id = shown, { shares } = await get(`/v1/jobs/${id}/shares`);
  if (id !== shown) return;
  $("shares").replaceChildren(...shares.map((share) => {
    const item = element("li", `made ${when(share.created)}, valid until ${when(share.expires)} `);
    item.append(button("Revoke", async () => { await request(`/v1/jobs/${id}/shares/${share.id}`, { method: "DELETE" }); await list(); }));
    return item;
  }));
}

export function show(id) {
  shown = id;
  $("job-share").hidden = false;
  $("job-share").open = false;
  $("share-link").value = "";
  $("share-made").hidden = true;
}

export function leave() { shown = null; $("job-share").hidden = true; }

// Buttons that open run.mcap in a viewer, each by a link of its own that is valid for a day.
export const viewerButtons = (id) => VIEWERS.map(([name, address]) => button(`Open in ${name}`, async () => {
  // Opened before the link is there: a browser opens no window that comes later than the click.
  const opened = open("about:blank", "_blank");
  const { secret } = await make(id, VIEWER_DAYS), file = `${location.origin}/v1/shared/${secret}/results/run.mcap`;
  if (opened) {
    opened.opener = null;
    opened.location = `${address}?ds=remote-file&ds.url=${encodeURIComponent(file)}`;
  }
  if ($("job-share").open) await list();
}));

export function listen() {
  $("job-share").addEventListener("toggle", () => { if ($("job-share").open && shown) guarded(list); });
  $("make-share").addEventListener("click", () => guarded(async () => {
    const { secret } = await make(shown, Number($("share-days").value));
    $("share-link").value = `${location.origin}/#shared=${secret}`;
    $("share-made").hidden = false;
    $("share-link").select();
    await list();
  }));
  $("copy-share").addEventListener("click", async () => {
    $("share-link").select();
    try { await navigator.clipboard.writeText($("share-link").value); $("copy-share").textContent = "Copied"; } catch { /* it is selected, to be copied by hand */ }
    setTimeout(() => { $("copy-share").textContent = "Copy"; }, 2000);
  });
}
