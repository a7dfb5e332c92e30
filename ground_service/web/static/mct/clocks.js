// Clocks on spacecraft UTC: the mission time, and the time of the newest telemetry.
import { followNewest, milliseconds, newest } from "./feed.js";

const TICK_MS = 1000;

class Clock {
  constructor(key, name, description, value) {
    Object.assign(this, { key, name, description, cssClass: "icon-clock", value, listeners: [] });
  }

  on(_event, listener, context) {
    this.listeners.push([listener, context]);
    return this;
  }

  off(_event, listener) {
    this.listeners = this.listeners.filter(([one]) => one !== listener);
    return this;
  }

  currentValue() {
    return this.value;
  }

  tick(value) {
    this.value = value;
    for (const [listener, context] of [...this.listeners]) listener.call(context, value);
  }
}

// Time of the newest value of a spacecraft, and the mission time that its age states.
function timesOf(values) {
  const times = values.map((one) => milliseconds(one.time));
  const aged = values.find((one) => one.age_s !== null);
  return {
    last: times.length ? Math.max(...times) : null,
    mission: aged ? milliseconds(aged.time) + 1000 * aged.age_s : null,
  };
}

export async function installClocks(openmct, spacecraft, session) {
  let offset = milliseconds(session.time) - Date.now();
  const found = spacecraft ? timesOf(await newest(spacecraft)) : { last: null };
  const mission = new Clock("mission", "Mission time", "Clock of the service: UTC, or the time of a simulated mission.", Date.now() + offset);
  const data = new Clock("newest", "Newest telemetry", "Spacecraft time of the newest telemetry received.", found.last ?? mission.value);
  setInterval(() => mission.tick(Date.now() + offset), TICK_MS);
  openmct.time.addClock(mission);
  openmct.time.addClock(data);
  if (spacecraft) {
    followNewest(
      spacecraft,
      (values) => {
        const { last, mission: now } = timesOf(values);
        if (now !== null) offset = now - Date.now();
        if (last !== null && last > data.value) data.tick(last);
      },
      (error) => console.warn(error.message),
    );
  }
  return data.value;
}
