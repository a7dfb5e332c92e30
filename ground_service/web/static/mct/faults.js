// Alarms of the service as faults: acknowledge and shelve them.
import { get, send } from "../api.js";
import { parameterName, unitText } from "../units.js";
import { listen } from "./feed.js";

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

// Severity and side of a value outside its limits.
function valueInfo(alarm) {
  if (alarm.value === null) return { value: packets(alarm.count), rangeCondition: "", monitoringResult: "IN_LIMITS" };
  const low = Number(alarm.limits.split(" to ")[0]);
  const result = alarm.severity === "alarm" ? "CRITICAL" : "WARNING";
  return { value: `${Number(alarm.value.toPrecision(6))} ${unitText(alarm.unit)}`.trim(), rangeCondition: alarm.value < low ? "LOW" : "HIGH", monitoringResult: result };
}

function faultOf(alarm) {
  const trigger = valueInfo(alarm);
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
      triggerValueInfo: trigger,
      currentValueInfo: alarm.active ? trigger : { ...trigger, value: "ended", monitoringResult: "IN_LIMITS" },
    },
  };
}

export function installFaults(openmct, session) {
  const changed = new Set();
  let asked = null; // the last request: the answer of an earlier one may come after its answer
  const notify = () => changed.forEach((callback) => callback(CHANGED));
  listen("alarm", notify);

  async function act(fault, path, json) {
    try {
      await send("POST", `alarms/${fault.id}/${path}`, json);
    } catch (error) {
      openmct.notifications.error(`Alarm ${fault.name}: ${error.message}`);
    }
    notify();
  }
  const provider = {
    supportsRequest: (object) => object.type === "faultManagement",
    supportsSubscribe: (object) => object.type === "faultManagement",
    async request() {
      asked = get("alarms", { state: ["raised", "acknowledged", "shelved"], limit: 1000 });
      let found = null;
      for (let answered = null; answered !== asked; ) {
        answered = asked;
        found = await answered;
      }
      return found.items.map(faultOf);
    },
    subscribe(_object, callback) {
      changed.add(callback);
      callback(CHANGED);
      return () => changed.delete(callback);
    },
    getShelveDurations: () => DURATIONS,
  };
  if (session.role !== "viewer") {
    provider.acknowledgeFault = (fault, given) => act(fault, "acknowledge", { comment: given?.comment ?? "" });
    provider.shelveFault = (fault, { shelved = true, shelveDuration, comment } = {}) => {
      const until = shelved ? Date.now() + (shelveDuration ?? DURATIONS[0].value) : Date.now() - MINUTE_MS;
      return act(fault, "shelve", { until: new Date(until).toISOString(), comment: comment ?? "" });
    };
  }
  openmct.install(openmct.plugins.FaultManagement());
  openmct.faults.addProvider(provider);
}
