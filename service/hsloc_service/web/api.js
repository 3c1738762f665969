// The service's API: every request carries the token of this tab, if there is one.

const KEY = "hsloc-token";
let token = sessionStorage.getItem(KEY) || "";
const asked = new EventTarget();
export const onToken = (listener) => asked.addEventListener("token", listener);
export const hasToken = () => token !== "";

export function useToken(text) {
  token = text.trim();
  sessionStorage.setItem(KEY, token);
}

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
  const answer = await fetch(path, { ...options, headers });
  if (answer.ok || answer.status === 304) return answer;
  let problem = {};
  try { problem = await answer.json(); } catch { /* not ours: a proxy's page */ }
  if (answer.status === 401) asked.dispatchEvent(new Event("token"));
  throw new Refused(answer.status, problem);
}

export const get = async (path) => (await request(path)).json();

export async function post(path, body, headers = {}) {
  const answer = await request(path, {
    method: "POST", body: body === undefined ? undefined : JSON.stringify(body),
    headers: { "Content-Type": "application/json", ...headers },
  });
  return answer.json();
}

// Server-sent events by fetch: EventSource cannot carry a token. Ends when the job has ended or `signal` says so.
export async function* events(path, signal) {
  let cursor = 0;
  for (let failures = 0; failures < 8;) {
    try {
      const answer = await request(`${path}?after=${cursor}`, { signal });
      const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
      let text = "";
      for (;;) {
        const { done, value } = await reader.read();
        if (done) return;
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
          if (lines.data) yield { kind: lines.event, data: JSON.parse(lines.data) };
        }
      }
    } catch (error) {
      if (signal.aborted || error.status === 404 || error.status === 401) return;
      failures += 1;
      await new Promise((resolve) => setTimeout(resolve, Math.min(500 * 2 ** failures, 10000)));
    }
  }
}
