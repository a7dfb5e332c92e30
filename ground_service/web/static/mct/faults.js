// Alarms of the service as faults: acknowledge and shelve them.
import { get, send } from "../api.js";
import { parameterName, unitText } from "../units.js";
import { followNewest, listen, newest } from "./feed.js";

const AGAIN_MS = 1000; // shortest time between two updates of the list because of new values
const MINUTE_MS = 60_000;
const HOUR_MS = 60 * MINUTE_MS;
const DAY_MS = 24 * HOUR_MS;
const DURATIONS = [
  { name: "15 minutes", value: 15 * MINUTE_MS },
  { name: "1 hour", value: HOUR_MS },
  { name: "8 hours", value: 8 * HOUR_MS },
  { name: "1 day", value: DAY_MS },
  { name: "29 days", value: 29 * DAY_MS },
];
const CHANGED = { type: "global-alarm-status" };
const ANY_CHANGE = "alarms";

const packets = (count) => `${count} packet${count === 1 ? "" : "s"}`;

// Value with severity and side: a severity of a value within its limits is neither "warning" nor "alarm".
function valueInfo(alarm, value, severity) {
  const text = `${Number(value.toPrecision(6))} ${unitText(alarm.unit)}`.trim();
  if (severity !== "alarm" && severity !== "warning") return { value: text, rangeCondition: "", monitoringResult: "IN_LIMITS" };
  const low = Number(alarm.limits.split(" to ")[0]);
  return { value: text, rangeCondition: value < low ? "LOW" : "HIGH", monitoringResult: severity === "alarm" ? "CRITICAL" : "WARNING" };
}

const withoutLimits = (value) => ({ value, rangeCondition: "", monitoringResult: "IN_LIMITS" });

// Value in the last packet with the condition, and value in the newest packet.
function triggerOf(alarm) {
  return alarm.value === null ? withoutLimits(packets(alarm.count)) : valueInfo(alarm, alarm.value, alarm.severity);
}

function currentOf(alarm, values) {
  if (alarm.source === "event") return withoutLimits(alarm.active ? packets(alarm.count) : "ended");
  const found = values.find((one) => one.packet === "housekeeping" && one.name === alarm.name);
  return found ? valueInfo(alarm, found.value, found.limit_state) : withoutLimits("unknown");
}

function faultOf(alarm, values) {
  const limits = alarm.limits ? `, limits ${alarm.limits} ${unitText(alarm.unit)}` : "";
  return {
    type: ANY_CHANGE,
    fault: {
      id: String(alarm.id),
      seqNum: alarm.id,
      name: parameterName(alarm.name, alarm.unit),
      namespace: `Spacecraft ${alarm.spacecraft_id}, ${alarm.instance}`,
      severity: alarm.severity === "alarm" ? "CRITICAL" : "WARNING",
      acknowledged: alarm.state === "acknowledged",
      shelved: alarm.state === "shelved",
      shortDescription: `${packets(alarm.count)}${limits}${alarm.active ? "" : ", condition ended"}`,
      triggerTime: `${alarm.last.slice(0, 10)} ${alarm.last.slice(11, 19)}Z`,
      triggerValueInfo: triggerOf(alarm),
      currentValueInfo: currentOf(alarm, values),
    },
  };
}

export function installFaults(openmct, session) {
  const changed = new Set();
  let asked = null; // the last request of the alarms, null once they have changed: an earlier answer is out of date
  const notify = () => changed.forEach((callback) => callback(CHANGED));
  const alarmsChanged = () => {
    asked = null;
    notify();
  };
  listen("alarm", alarmsChanged);

  // Newest values of the spacecraft with alarms: the list is shown again when they change.
  const known = new Map();
  const keyOf = (alarm) => `${alarm.spacecraft_id} ${alarm.instance}`;
  let due = null;
  const valuesChanged = () => {
    due ??= setTimeout(() => {
      due = null;
      notify();
    }, AGAIN_MS);
  };
  async function readValues(alarm) {
    const key = keyOf(alarm);
    if (known.has(key)) return;
    known.set(key, []);
    const warn = (error) => console.warn(`newest values: ${error.message}`);
    const take = (values) => {
      known.set(key, values);
      valuesChanged();
    };
    await newest(alarm).then((values) => known.set(key, values), warn);
    followNewest(alarm, take, warn);
  }

  async function act(fault, path, json) {
    try {
      await send("POST", `alarms/${fault.id}/${path}`, json);
    } catch (error) {
      openmct.notifications.error(`Alarm ${fault.name}: ${error.message}`);
    }
    alarmsChanged();
  }
  const provider = {
    supportsRequest: (object) => object.type === "faultManagement",
    supportsSubscribe: (object) => object.type === "faultManagement",
    async request() {
      let found = null;
      for (let answered = null; answered === null || answered !== asked; ) {
        answered = asked ??= get("alarms", { state: ["raised", "acknowledged", "shelved"], limit: 1000 });
        const ended = answered;
        ended.catch(() => {
          if (asked === ended) asked = null;
        });
        found = await answered;
      }
      await Promise.all(found.items.filter((one) => one.source === "parameter").map(readValues));
      return found.items.map((one) => faultOf(one, known.get(keyOf(one)) ?? []));
    },
    subscribe(_object, callback) {
      changed.add(callback);
      asked = null;
      callback(CHANGED);
      return () => changed.delete(callback);
    },
    getShelveDurations: () => DURATIONS,
  };
  if (session.role !== "viewer") {
    provider.acknowledgeFault = (fault, given) => act(fault, "acknowledge", { comment: given?.comment ?? "" });
    provider.shelveFault = async (fault, { shelved = true, shelveDuration, comment } = {}) => {
      const now = Date.parse((await get("session")).time); // alarms are shelved in mission time
      const until = now + (shelved ? (shelveDuration ?? DURATIONS[0].value) : -MINUTE_MS);
      return act(fault, "shelve", { until: new Date(until).toISOString(), comment: comment ?? "" });
    };
  }
  openmct.install(openmct.plugins.FaultManagement());
  openmct.faults.addProvider(provider);
}
