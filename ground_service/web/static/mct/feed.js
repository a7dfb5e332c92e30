// Live feed of the displays: one socket, told to all that listen, and newest values requested once for all of them.
import { follow, get } from "../api.js";

const AGAIN_MS = 100; // shortest time between two requests of the newest values of a spacecraft

const listeners = new Map(); // event kind -> functions
let connected = false;
const states = new Set();

export function listen(kind, listener) {
  if (!listeners.has(kind)) listeners.set(kind, new Set());
  listeners.get(kind).add(listener);
  return () => listeners.get(kind).delete(listener);
}

export function onState(listener) {
  states.add(listener);
  listener(connected);
}

export function startFeed() {
  follow(
    (message) => listeners.get(message.kind)?.forEach((listener) => listener(message)),
    (state) => {
      connected = state;
      states.forEach((listener) => listener(state));
    },
  );
}

export const milliseconds = (text) => Date.parse(`${text.slice(0, 23).replace(/Z$/, "")}Z`);

// Newest values of a spacecraft: the result is shared by requests that come while one is under way.
const running = new Map();
export function newest(spacecraft) {
  const key = `${spacecraft.spacecraft_id} ${spacecraft.instance}`;
  if (!running.has(key)) {
    const request = get("parameters", spacecraft).then(({ items }) => items.filter((one) => one.value !== null));
    running.set(key, request);
    request.catch(() => {}).finally(() => running.delete(key));
  }
  return running.get(key);
}

// Tell the newest values of a spacecraft after each telemetry event; returns the function that ends it.
export function followNewest(spacecraft, listener, onError) {
  let waiting = null;
  let ended = false;
  const refresh = () => {
    waiting = null;
    newest(spacecraft)
      .then((values) => ended || listener(values))
      .catch(onError);
  };
  const stop = listen("telemetry", () => {
    waiting ??= setTimeout(refresh, AGAIN_MS);
  });
  return () => {
    ended = true;
    clearTimeout(waiting);
    stop();
  };
}
