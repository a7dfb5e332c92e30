// The API with the session cookie of the browser; one problem document becomes one Error with a readable message.
const PREFIX = "/api/v1";

export class Problem extends Error {
  constructor(status, document) {
    super(document?.detail || document?.title || `status ${status}`);
    this.status = status;
    this.document = document ?? {};
  }
}

export async function request(path, { method = "GET", json, body, headers = {}, signal } = {}) {
  const sent = { ...headers };
  if (json !== undefined) sent["Content-Type"] = "application/json";
  const answer = await fetch(path.startsWith("/") ? path : `${PREFIX}/${path}`, {
    method,
    headers: sent,
    signal,
    body: json === undefined ? body : JSON.stringify(json),
  });
  if (answer.ok) return answer;
  const document = await answer.json().catch(() => null);
  if (answer.status === 401) window.dispatchEvent(new Event("linna-sign-in"));
  throw new Problem(answer.status, document);
}

export async function get(path, query = {}, options = {}) {
  const words = new URLSearchParams();
  for (const [name, value] of Object.entries(query)) {
    for (const one of [value].flat()) if (one !== undefined && one !== null) words.append(name, one);
  }
  const text = words.toString();
  return (await request(text ? `${path}?${text}` : path, options)).json();
}

export async function send(method, path, json, headers) {
  const answer = await request(path, { method, json, headers });
  return answer.status === 204 ? null : answer.json();
}

// A job until its end; `progress` gets each state of it.
export async function finished(jobId, progress = () => {}) {
  for (let wait = 150; ; wait = Math.min(1.3 * wait, 2000)) {
    const job = await get(`jobs/${jobId}`);
    progress(job);
    if (job.state === "done") return job;
    if (job.state === "failed") throw new Error(job.error || `${job.kind} failed`);
    await new Promise((resolve) => setTimeout(resolve, wait));
  }
}

// The feed of what happens: reconnects and misses nothing, since every message has the next number.
// With `values` the newest values of all spacecraft are among the messages, as they are received.
export function follow(onMessage, onState = () => {}, values = false) {
  let last = null;
  let wait = 1000;
  let stopped = false;
  let socket = null;
  function open() {
    const query = new URLSearchParams();
    if (last !== null) query.set("after", last);
    if (values) query.set("values", "true");
    socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}${PREFIX}/live?${query}`);
    socket.onopen = () => {
      wait = 1000;
      onState(true);
    };
    socket.onmessage = (event) => {
      const message = JSON.parse(event.data);
      last = message.sequence;
      onMessage(message);
    };
    socket.onclose = () => {
      onState(false);
      if (!stopped) setTimeout(open, wait);
      wait = Math.min(2 * wait, 30000);
    };
  }
  open();
  return () => {
    stopped = true;
    socket.close();
  };
}
