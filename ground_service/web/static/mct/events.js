// Event reports of a spacecraft as a table.
import { get } from "../api.js";
import { addExtra } from "./dictionary.js";
import { afterTelemetry, FAR, milliseconds } from "./feed.js";

const PAGE = 1000;
const MOST = 5000; // newest events of an interval that are shown

const text = (key, name, range) => ({ key, source: key, name, format: "string", hints: range ? { range } : {} });
const METADATA = {
  values: [
    { key: "utc", source: "utc", name: "Spacecraft time", format: "utc", hints: { domain: 1 } },
    text("severity", "Severity", 2),
    text("event", "Event", 1),
    text("detail", "Detail", 3),
  ],
};
const COLOUR = { high: "is-limit--upr is-limit--red", medium: "is-limit--upr is-limit--yellow" };

// Tables of Open MCT use the keys id and name themselves.
const datum = (one) => ({ id: `${one.time} ${one.name} ${one.detail}`, utc: milliseconds(one.time), severity: one.severity, event: one.name.replaceAll("_", " "), detail: one.detail });

// Of several data of the newest time, Open MCT 4.2 compares only the last with what follows, and would show the others
// again. So events of one millisecond get times of their own, in their order: late ones are after those known before.
function ordered(events) {
  const numbers = new Map();
  return events.map((one) => {
    const found = datum(one);
    const number = numbers.get(found.utc) ?? 0;
    numbers.set(found.utc, number + 1);
    return { ...found, utc: found.utc + Math.min(number, 999) / 1000 };
  });
}

async function request({ spacecraft }, { start, end, size, signal }) {
  const wanted = Math.min(size ?? MOST, MOST);
  const query = { ...spacecraft, start: new Date(Math.max(start, 0)).toISOString(), stop: new Date(Math.max(end, 0)).toISOString() };
  const found = [];
  for (let offset = 0; offset < wanted; offset += PAGE) {
    const page = await get("events", { ...query, limit: Math.min(PAGE, wanted - offset), offset }, { signal });
    found.push(...page.items);
    if (found.length >= page.total) break;
  }
  return ordered(found.reverse());
}

// From the start of what is shown: the interval ends after the newest telemetry, so its end would hide what follows.
function subscribe(openmct, object, callback) {
  let from = openmct.time.getBounds().start;
  let known = new Set(); // events from a millisecond before that time
  return afterTelemetry("events", async () => {
    try {
      const found = await request(object, { start: from - 1, end: FAR });
      const fresh = found.filter((one) => !known.has(one.id));
      if (!fresh.length) return;
      from = Math.floor(fresh.at(-1).utc);
      known = new Set(found.filter((one) => one.utc >= from - 1).map((one) => one.id));
      callback(fresh);
    } catch (error) {
      console.warn(`${object.name}: ${error.message}`);
    }
  });
}

export function installEvents(openmct) {
  const isEvents = (object) => object.type === "linna.events";
  openmct.types.addType("linna.events", { name: "Events", cssClass: "icon-tabular-realtime", creatable: false });
  addExtra("events", () => ({ type: "linna.events", name: "Events", telemetry: METADATA, configuration: { hiddenColumns: { name: true } } }));
  openmct.telemetry.addProvider({
    supportsRequest: isEvents,
    request,
    supportsSubscribe: isEvents,
    subscribe: (object, callback) => subscribe(openmct, object, callback),
    supportsLimits: isEvents,
    getLimitEvaluator: () => ({
      evaluate: (found, metadata) => (metadata?.key === "severity" && COLOUR[found.severity] ? { cssClass: COLOUR[found.severity], name: found.severity } : undefined),
    }),
    getLimits: () => ({ limits: async () => ({}) }),
  });
}
