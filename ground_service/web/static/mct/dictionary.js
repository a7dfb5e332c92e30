// The dictionary as an object tree: spacecraft -> packet -> parameter, and the further objects of a spacecraft.
import { get } from "../api.js";
import { parameterName, unitText } from "../units.js";
import { newest } from "./feed.js";

export const NAMESPACE = "linna";
const ROOT = "spacecraft";
const SEPARATOR = "~";

export const identifier = (key) => ({ namespace: NAMESPACE, key });
const words = (name) => name.replaceAll("_", " ");

export function spacecraftKey(one) {
  return [one.spacecraft_id, one.instance].join(SEPARATOR);
}

// Kinds of objects: the first part of a key.
const KEY = {
  spacecraft: (one) => ["vehicle", spacecraftKey(one)].join(SEPARATOR),
  packet: (one, packet) => ["packet", spacecraftKey(one), packet].join(SEPARATOR),
  group: (one, packet, group) => ["group", spacecraftKey(one), packet, group].join(SEPARATOR),
  parameter: (one, name) => ["parameter", spacecraftKey(one), name].join(SEPARATOR),
};

export function parsed(key) {
  const [kind, number, instance, ...rest] = key.split(SEPARATOR);
  return { kind, spacecraft: { spacecraft_id: Number(number), instance }, rest };
}

export const parameterIdentifier = (one, name) => identifier(KEY.parameter(one, name));

// A parameter of several estimators or instruments is grouped by the part of its name before the last dot.
function groupOf(parameter) {
  const parts = parameter.name.split(".");
  return parts.length > 2 && parts[0] === parameter.packet ? parts[1] : null;
}

// Parameters without series are known from their newest values only.
async function loadParameters(spacecraft) {
  const series = await get(`spacecraft/${spacecraft.spacecraft_id}/parameters`, { instance: spacecraft.instance });
  const known = new Map(series.items.map((one) => [one.name, { ...one, series: true }]));
  for (const one of await newest(spacecraft)) {
    if (known.has(one.name) || series.items.some((each) => each.packet === one.packet)) continue;
    const name = `${one.packet}.${one.name}`;
    known.set(name, { ...one, name, short: one.name, labels: {}, warning: null, alarm: null, series: false });
  }
  return known;
}

const loaded = new Map();
export function parametersOf(spacecraft) {
  const key = spacecraftKey(spacecraft);
  if (!loaded.has(key)) {
    const request = loadParameters(spacecraft);
    loaded.set(key, request);
    request.catch(() => loaded.delete(key));
  }
  return loaded.get(key);
}

let vehicles = null;
export function allSpacecraft() {
  vehicles ??= get("spacecraft").then(
    ({ items }) => items,
    (error) => {
      vehicles = null;
      throw error;
    },
  );
  return vehicles;
}

export const spacecraftName = (one) => (one.instance === "flight" ? `Spacecraft ${one.spacecraft_id}` : `Spacecraft ${one.spacecraft_id}, ${one.instance}`);

const TIME = { key: "utc", source: "utc", name: "Spacecraft time", format: "utc", hints: { domain: 1 } };

export function metadataOf(parameter) {
  const codes = Object.entries(parameter.labels).map(([value, string]) => ({ value: Number(value), string: words(string) }));
  const unit = unitText(parameter.unit) || undefined;
  if (codes.length) {
    return { values: [TIME, { key: "value", name: "Value", format: "enum", enumerations: codes, hints: { range: 1 } }] };
  }
  const format = parameter.name.endsWith("_hash") ? "linna.hash" : "linna.number";
  const value = (key, name, range) => ({ key, name, unit, format, hints: { range } });
  return { values: [TIME, value("value", "Value", 1), value("mean", "Mean", 2), value("min", "Minimum", 3), value("max", "Maximum", 4)] };
}

function parameterObject(spacecraft, parameter) {
  const group = groupOf(parameter);
  const short = parameterName(parameter.short ?? parameter.name.split(".").at(-1), parameter.unit);
  const parent = group ? KEY.group(spacecraft, parameter.packet, group) : KEY.packet(spacecraft, parameter.packet);
  return {
    identifier: parameterIdentifier(spacecraft, parameter.name),
    type: "linna.parameter",
    name: group ? `${short}, ${words(group)}` : short,
    notes: parameter.description,
    location: `${NAMESPACE}:${parent}`,
    spacecraft,
    parameter,
    telemetry: metadataOf(parameter),
  };
}

function folder(key, name, parent, type = "linna.packet") {
  const location = parent === "ROOT" ? parent : `${NAMESPACE}:${parent}`;
  return { identifier: identifier(key), type, name, location, composition: [] };
}

// Objects of other modules below a spacecraft: kind -> function of the spacecraft that makes one; in the tree or not.
const extras = new Map();
const listed = [];
export function addExtra(kind, make, inTree = true) {
  extras.set(kind, make);
  if (inTree) listed.push(kind);
}
const extraKey = (kind, one) => [kind, spacecraftKey(one)].join(SEPARATOR);
export const extraIdentifier = (kind, one) => identifier(extraKey(kind, one));

// Address of such an object in the page.
export function addressOf(spacecraft, kind) {
  return `#/browse/${[ROOT, KEY.spacecraft(spacecraft), extraKey(kind, spacecraft)].map((key) => `${NAMESPACE}:${key}`).join("/")}`;
}

async function objectOf(key) {
  if (key === ROOT) return folder(ROOT, "Spacecraft", "ROOT", "linna.packet");
  const { kind, spacecraft, rest } = parsed(key);
  if (extras.has(kind)) {
    const location = `${NAMESPACE}:${KEY.spacecraft(spacecraft)}`;
    return { identifier: identifier(key), location, spacecraft, ...(await extras.get(kind)(spacecraft, rest)) };
  }
  if (kind === "vehicle") return { ...folder(key, spacecraftName(spacecraft), ROOT, "linna.spacecraft"), spacecraft };
  if (kind === "packet") return folder(key, words(rest[0]), KEY.spacecraft(spacecraft));
  if (kind === "group") return folder(key, words(rest[1]), KEY.packet(spacecraft, rest[0]));
  const parameter = (await parametersOf(spacecraft)).get(rest.join(SEPARATOR));
  return parameter ? parameterObject(spacecraft, parameter) : undefined;
}

// Views of objects: Open MCT watches those of some types, of ours the plan.
const observers = new Map(); // key -> functions that take the new state of the object
function observe({ key }, callback) {
  if (!observers.has(key)) observers.set(key, new Set());
  observers.get(key).add(callback);
  return () => observers.get(key).delete(callback);
}

// Read the shown objects of a kind again.
export async function refreshObjects(kind) {
  for (const [key, callbacks] of observers) {
    if (!callbacks.size || parsed(key).kind !== kind) continue;
    const found = await objectOf(key);
    const now = Date.now();
    callbacks.forEach((callback) => callback({ ...found, modified: now, persisted: now }));
  }
}

async function childrenOf(key) {
  if (key === ROOT) return (await allSpacecraft()).map((one) => identifier(KEY.spacecraft(one)));
  const { kind, spacecraft, rest } = parsed(key);
  const parameters = [...(await parametersOf(spacecraft)).values()];
  if (kind === "vehicle") {
    const packets = [...new Set(parameters.map((one) => one.packet))].map((packet) => identifier(KEY.packet(spacecraft, packet)));
    return [...listed.map((one) => extraIdentifier(one, spacecraft)), ...packets];
  }
  const inside = parameters.filter((one) => one.packet === rest[0]);
  if (kind === "group") return inside.filter((one) => groupOf(one) === rest[1]).map((one) => parameterIdentifier(spacecraft, one.name));
  const groups = [...new Set(inside.map(groupOf).filter(Boolean))].map((group) => identifier(KEY.group(spacecraft, rest[0], group)));
  return [...groups, ...inside.filter((one) => !groupOf(one)).map((one) => parameterIdentifier(spacecraft, one.name))];
}

export function installDictionary(openmct) {
  openmct.types.addType("linna.spacecraft", { name: "Spacecraft", cssClass: "icon-object", creatable: false });
  openmct.types.addType("linna.packet", { name: "Packet", cssClass: "icon-folder", creatable: false });
  openmct.types.addType("linna.parameter", { name: "Parameter", cssClass: "icon-telemetry", creatable: false });
  openmct.telemetry.addFormat({
    key: "linna.number",
    format: (value) => (typeof value !== "number" || Number.isNaN(value) ? "" : Number.isInteger(value) ? String(value) : String(Number(value.toPrecision(6)))),
    parse: (value) => (typeof value === "number" ? value : Number.parseFloat(value)),
    validate: (value) => Number.isFinite(Number(value)),
  });
  openmct.telemetry.addFormat({
    key: "linna.hash",
    format: (value) => (typeof value === "number" && Number.isInteger(value) ? value.toString(16).padStart(8, "0") : ""),
    parse: (value) => (typeof value === "number" ? value : Number.parseInt(value, 16)),
    validate: (value) => /^[0-9a-f]+$/i.test(String(value)),
  });
  openmct.objects.addProvider(NAMESPACE, { get: ({ key }) => objectOf(key), isReadOnly: () => true, observe });
  openmct.objects.addRoot(identifier(ROOT), openmct.priority.HIGH);
  openmct.composition.addProvider({
    appliesTo: (one) => one.identifier.namespace === NAMESPACE && ["linna.spacecraft", "linna.packet"].includes(one.type),
    load: (one) => childrenOf(one.identifier.key),
  });
}
