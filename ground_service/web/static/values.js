// Newest values of the parameters of a spacecraft: value, limit state, age and recent course, updated by the feed.
import { bind, restore } from "./address.js";
import { get } from "./api.js";
import { spacecraftOptions } from "./lists.js";
import { merged } from "./newest.js";
import { byId, element, lengthText, on, parameterName, show, stateMark, svg, table, trouble, unitText, watch, words } from "./page.js";

const KEPT = 60; // values of the recent course
const STALE_S = 120; // older values are marked
const AGAIN_MS = 100; // shortest time between two drawings

const course = new Map();
let values = [];
let drawing = null;
let asked = 0; // number of the last request
let asking = false;
const early = []; // messages that came during a request

const key = (one) => `${byId("spacecraft").value} ${one.packet} ${one.name}`;

function note(one) {
  const kept = course.get(key(one)) ?? [];
  if (one.value !== null && kept.at(-1)?.time !== one.time) kept.push({ time: one.time, value: one.value });
  course.set(key(one), kept.slice(-KEPT));
}

function spark(one) {
  const kept = (course.get(key(one)) ?? []).map((each) => each.value);
  if (kept.length < 2) return null;
  const [low, high] = [Math.min(...kept), Math.max(...kept)];
  const points = kept.map((value, index) => `${(80 * index) / (kept.length - 1)},${high > low ? 16 - (14 * (value - low)) / (high - low) : 9}`);
  return svg("svg", { viewBox: "0 0 80 18", class: "spark", role: "img", "aria-label": `last ${kept.length} values, ${low} to ${high}` }, svg("polyline", { points: points.join(" ") }));
}

function age(one) {
  const now = one.age_s + (Date.now() - one.received) / 1000;
  return element("span", { class: now > STALE_S ? "stale" : null }, now > STALE_S ? `${lengthText(now)}, stale` : lengthText(now));
}

function draw() {
  const chosen = values.filter((one) => one.packet === byId("packet").value);
  show(
    "live",
    table(
      "Newest values",
      [
        ["Parameter", (row) => element("span", { title: row.description }, parameterName(row.name, row.unit))],
        ["Value", (row) => `${row.text} ${unitText(row.unit)}`.trim(), "num"],
        ["Limits", (row) => (row.limit_state === "none" ? "" : [stateMark(row.limit_state), ` ${row.limits}`])],
        ["Trend", spark],
        ["Age", age],
        ["Spacecraft time", "time"],
      ],
      chosen,
      "No telemetry of this spacecraft has been received.",
    ),
  );
}

async function refresh() {
  const [spacecraft, instance] = byId("spacecraft").value.split(" ");
  if (!instance) return;
  const request = ++asked;
  asking = true;
  early.length = 0;
  const { items } = await get("parameters", { spacecraft_id: spacecraft, instance }).finally(() => {
    if (request === asked) asking = false;
  });
  if (request !== asked) return;
  values = early.splice(0).reduce(merged, items.map((one) => ({ ...one, received: Date.now() })));
  values.forEach(note);
  const packet = byId("packet").value;
  const packets = [...new Set(values.map((one) => one.packet))];
  show("packet", packets.map((one) => element("option", { value: one }, words(one))));
  if (packets.includes(packet)) byId("packet").value = packet;
  else restore("packet");
  draw();
}

// Values of the feed; a packet that was not there before brings its parameters by a request.
function take(packet) {
  if (`${packet.spacecraft_id} ${packet.instance}` !== byId("spacecraft").value) return;
  if (asking) {
    early.push(packet);
    return;
  }
  if (!values.some((one) => one.packet === packet.packet)) {
    refresh().catch(trouble);
    return;
  }
  values = merged(values, packet);
  values.filter((one) => one.packet === packet.packet).forEach(note);
  drawing ??= setTimeout(() => {
    drawing = null;
    draw();
  }, AGAIN_MS);
}

export async function showLive() {
  watch((message) => message.kind === "values" && take(message.payload), refresh, { values: true });
  try {
    if (!(await spacecraftOptions("spacecraft")).length) draw();
    await refresh();
  } catch (error) {
    if (error.status !== 401) trouble(error);
  }
  on("spacecraft", "change", refresh);
  bind("spacecraft", "packet");
  byId("packet").addEventListener("change", draw);
  setInterval(draw, 5000);
}
