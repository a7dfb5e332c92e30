// Live feed of the displays: one socket, told to all that listen, and newest values requested once for all of them.
import { follow, get } from "../api.js";

const AGAIN_MS = 250; // shortest time between two requests of the newest values of a spacecraft

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
      // What was read before the connection may be older than its first message.
      if (state) for (const kind of ["telemetry", "alarm"]) listeners.get(kind)?.forEach((listener) => listener({ kind }));
      states.forEach((listener) => listener(state));
    },
  );
}

export const milliseconds = (text) => Date.parse(`${text.slice(0, 23).replace(/Z$/, "")}Z`);

const keyOf = (spacecraft) => `${spacecraft.spacecraft_id} ${spacecraft.instance}`;

const request = (spacecraft) => get("parameters", spacecraft).then(({ items }) => items.filter((one) => one.value !== null));

// Newest values of a spacecraft: the result is shared by requests that come while one is under way.
const running = new Map();
export function newest(spacecraft) {
  const key = keyOf(spacecraft);
  if (!running.has(key)) {
    const asked = request(spacecraft);
    running.set(key, asked);
    asked.catch(() => {}).finally(() => running.delete(key));
  }
  return running.get(key);
}

// Requests of the newest values of one spacecraft after telemetry events: at once, then at most every AGAIN_MS.
class Follower {
  constructor(spacecraft) {
    Object.assign(this, { spacecraft, followers: new Set(), busy: false, again: false });
    listen("telemetry", () => this.refresh());
  }

  async refresh() {
    if (!this.followers.size) return;
    if (this.busy) {
      this.again = true;
      return;
    }
    this.busy = true;
    this.again = false;
    const next = new Promise((resolve) => setTimeout(resolve, AGAIN_MS));
    try {
      const values = await request(this.spacecraft); // not one that began before the event
      this.followers.forEach(([listener]) => listener(values));
    } catch (error) {
      this.followers.forEach(([, onError]) => onError(error));
    }
    await next;
    this.busy = false;
    if (this.again) this.refresh();
  }
}

// Tell the newest values of a spacecraft after each telemetry event; returns the function that ends it.
const followed = new Map();
export function followNewest(spacecraft, listener, onError) {
  const key = keyOf(spacecraft);
  if (!followed.has(key)) followed.set(key, new Follower(spacecraft));
  const { followers } = followed.get(key);
  const entry = [listener, onError];
  followers.add(entry);
  return () => followers.delete(entry);
}
