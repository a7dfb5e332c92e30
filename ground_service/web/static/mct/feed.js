// Live feed of the displays: one socket for all listeners. Newest values come over it and are requested once at its start.
import { follow, get } from "../api.js";
import { merged } from "../newest.js";

const AGAIN_MS = 250; // shortest time between two requests after telemetry

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
    true,
  );
}

// Do work after telemetry with samples of a kind (null: any): at once, then at most every `againMs`, one at a time.
export function afterTelemetry(kind, work, againMs = AGAIN_MS) {
  let busy = false;
  let again = false;
  async function run() {
    if (busy) {
      again = true;
      return;
    }
    busy = true;
    do {
      again = false;
      const pause = new Promise((resolve) => setTimeout(resolve, againMs));
      await work();
      await pause;
    } while (again);
    busy = false;
  }
  const concerns = (payload) => !payload || kind === null || payload.kinds.includes(kind);
  const end = listen("telemetry", ({ payload }) => concerns(payload) && run());
  return () => {
    again = false;
    end();
  };
}

export const FAR = Date.UTC(2129, 0); // later than all telemetry

export const milliseconds = (text) => Date.parse(`${text.slice(0, 23).replace(/Z$/, "")}Z`);

const keyOf = (spacecraft) => `${spacecraft.spacecraft_id} ${spacecraft.instance}`;

const request = (spacecraft) => get("parameters", { spacecraft_id: spacecraft.spacecraft_id, instance: spacecraft.instance }).then(({ items }) => items);

// Newest values of a spacecraft: the result is shared by requests that come while one is under way.
const running = new Map();
export function newest(spacecraft) {
  const key = keyOf(spacecraft);
  if (!running.has(key)) {
    const asked = request(spacecraft).then((values) => values.filter((one) => one.value !== null));
    running.set(key, asked);
    asked.catch(() => {}).finally(() => running.delete(key));
  }
  return running.get(key);
}

// Newest values of one spacecraft: all of them at the start and after each connection, then those that the feed sends.
class Follower {
  constructor(spacecraft) {
    Object.assign(this, { spacecraft, followers: new Set(), values: [], packets: new Set(), early: [], asked: null });
    listen("telemetry", ({ payload }) => !payload && this.followers.size && this.refresh());
    listen("values", ({ payload }) => this.followers.size && keyOf(payload) === keyOf(spacecraft) && this.take(payload));
  }

  async refresh() {
    const asked = (this.asked = request(this.spacecraft));
    this.early = [];
    try {
      const values = await asked;
      if (asked !== this.asked) return;
      this.packets = new Set(values.map((one) => one.packet));
      this.asked = null;
      this.values = this.early.splice(0).reduce(merged, values);
      this.tell();
    } catch (error) {
      if (asked !== this.asked) return;
      this.asked = null;
      this.followers.forEach(([, onError]) => onError(error));
    }
  }

  take(packet) {
    if (this.asked) this.early.push(packet);
    else if (!this.packets.has(packet.packet)) this.refresh();
    else {
      this.values = merged(this.values, packet);
      this.tell();
    }
  }

  tell() {
    this.followers.forEach(([listener]) => listener(this.values.filter((one) => one.value !== null)));
  }
}

// Tell the newest values of a spacecraft whenever they change; returns the function that ends it.
const followed = new Map();
export function followNewest(spacecraft, listener, onError) {
  const key = keyOf(spacecraft);
  if (!followed.has(key)) followed.set(key, new Follower(spacecraft));
  const { followers } = followed.get(key);
  const entry = [listener, onError];
  const first = !followers.size;
  followers.add(entry);
  if (first) followed.get(key).refresh();
  return () => followers.delete(entry);
}
