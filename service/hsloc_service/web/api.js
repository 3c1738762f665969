// The service's API: every request carries the token of this tab, if there is one.

const KEY = "hsloc-token";
let token = sessionStorage.getItem(KEY) || "";
const asked = new EventTarget();
export const onToken = (listener) => asked.addEventListener("token", listener);
export const hasToken = () => token !== "";

export function useToken(text) {
  token = text.trim();
  seen.clear();
  sessionStorage.setItem(KEY, token);
}

// Whether the server answered last: what is shown may be out of date where it did not.
export const connection = new EventTarget();
let isAnswering = true;
function answering(is) {
  if (is === isAnswering) return;
  isAnswering = is;
  connection.dispatchEvent(new CustomEvent("change", { detail: is }));
}

// What the server refuses, with the status of its answer; 0 where there was none.
export class Refused extends Error {
  constructor(status, problem) {
    super(problem.message || `the server answered ${status}`);
    this.status = status;
    this.code = problem.code;
  }
}

export async function request(path, options = {}) {
  const headers = { ...options.headers };
  if (token) headers.Authorization = `Bearer ${token}`;
  let answer;
  try { answer = await fetch(path, { ...options, headers }); } catch (error) {
    if (error.name === "AbortError") throw error;
    answering(false);
    throw new Refused(0, { message: `the server cannot be reached (${error.message})` });
  }
  answering(true);
  if (answer.ok || answer.status === 304) return answer;
  let problem = {};
  try { problem = await answer.json(); } catch { /* not ours: a proxy's page */ }
  if (answer.status === 401) asked.dispatchEvent(new Event("token"));
  throw new Refused(answer.status, problem);
}

const seen = new Map(); // what polled paths answered last, with its ETag; in memory only

export async function get(path) {
  const known = seen.get(path);
  const answer = await request(path, known ? { headers: { "If-None-Match": known.tag } } : {});
  if (answer.status === 304) return known.value;
  const value = await answer.json(), tag = answer.headers.get("ETag");
  seen.delete(path);
  if (tag && !path.includes("/results")) seen.set(path, { tag, value });
  if (seen.size > 50) seen.delete(seen.keys().next().value);
  return value;
}

async function send(method, path, body, headers = {}) {
  const answer = await request(path, {
    method, body: body === undefined ? undefined : JSON.stringify(body),
    headers: { "Content-Type": "application/json", ...headers },
  });
  return answer.json();
}
export const post = (path, body) => send("POST", path, body);
export const patch = (path, body) => send("PATCH", path, body);
// For what must not be made twice, should the request be sent twice.
export const postOnce = (path, body) =>
  send("POST", path, body, { "Idempotency-Key": crypto.randomUUID ? crypto.randomUUID() : String(Math.random()) });

const ENDED = ["succeeded", "failed", "crashed", "cancelled"];

// Server-sent events by fetch, because EventSource cannot carry a token. Ends when the job has ended, when it is gone,
// when the token is refused, or by `signal`; a stream that ends otherwise, as of a server that restarts, is opened again.
export async function* events(path, signal) {
  let cursor = 0;
  for (let failures = 0; !signal.aborted;) {
    try {
      const answer = await request(`${path}?after=${cursor}`, { signal });
      const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
      let text = "";
      for (;;) {
        const { done, value } = await reader.read();
        if (done) break;
        failures = 0;
        text += value;
        const blocks = text.split("\n\n");
        text = blocks.pop();
        for (const block of blocks) {
          const lines = Object.fromEntries(block.split("\n").filter((l) => l.includes(": ")).map((line) => {
            const at = line.indexOf(": ");
            return [line.slice(0, at), line.slice(at + 2)];
          }));
          if (lines.id) cursor = Number(lines.id);
          if (!lines.data) continue;
          const data = JSON.parse(lines.data);
          yield { kind: lines.event, data };
          if (lines.event === "state" && ENDED.includes(data.state)) return;
        }
      }
    } catch (error) {
      if (signal.aborted || error.status === 404 || error.status === 401) return;
    }
    failures += 1;
    await new Promise((resolve) => setTimeout(resolve, Math.min(500 * 2 ** failures, 10000)));
  }
}
