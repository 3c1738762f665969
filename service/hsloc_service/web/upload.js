// Uploads by tus 1.0: in blocks, so that a broken line costs one block; continued after a reload of the page.

import { request } from "./api.js";

const MIN_BLOCK = 64 << 10;
let block = 8 << 20; // halved where a proxy takes smaller bodies only: nginx 1 MiB, unless it is configured
const TUS = { "Tus-Resumable": "1.0.0" };
const remembered = (file) => `hsloc-upload:${file.name}:${file.size}:${file.lastModified}`;
const pause = (ms) => new Promise((resolve) => setTimeout(resolve, ms));

function base64(text) {
  return btoa(String.fromCharCode(...new TextEncoder().encode(text)));
}

async function offsetOf(place) {
  const answer = await request(place, { method: "HEAD", headers: TUS });
  return Number(answer.headers.get("Upload-Offset"));
}

async function begin(file) {
  const known = localStorage.getItem(remembered(file));
  if (known) {
    try { return [known, await offsetOf(known)]; } catch (error) { if (!error.status) throw error; }
  }
  const answer = await request("/v1/tus", {
    method: "POST",
    headers: { ...TUS, "Upload-Length": String(file.size), "Upload-Metadata": `filename ${base64(file.name)}` },
  });
  const place = answer.headers.get("Location");
  localStorage.setItem(remembered(file), place);
  return [place, 0];
}

// Returns the file's id. `report(done, total, note)`; `signal` pauses: calling again goes on where it stopped.
export async function upload(file, report, signal) {
  let [place, offset] = await begin(file);
  for (let failures = 0; offset < file.size;) {
    report(offset, file.size, failures ? `the line broke; attempt ${failures + 1}` : "");
    try {
      const answer = await request(place, {
        method: "PATCH", signal, body: file.slice(offset, offset + block),
        headers: { ...TUS, "Upload-Offset": String(offset), "Content-Type": "application/offset+octet-stream" },
      });
      offset = Number(answer.headers.get("Upload-Offset"));
      failures = 0;
    } catch (error) {
      if (error.status === 413 && !error.code && block > MIN_BLOCK) { block /= 2; continue; } // not our answer
      const final = error.status && ![408, 409, 423, 429, 500, 502, 503, 504].includes(error.status);
      if (signal.aborted || final || ++failures > 10) throw error;
      await pause(Math.min(300 * 2 ** failures, 15000));
      try { offset = await offsetOf(place); } catch (lost) { if (lost.status === 404) throw lost; }
    }
  }
  report(file.size, file.size, "");
  localStorage.removeItem(remembered(file));
  return place.split("/").pop();
}
