// Conditions and resources of the plan over time: lanes of the timeline, values at a time, ground track.
import { get } from "./api.js";
import { style } from "./charts.js";
import { byId, element, figure, isoText, missionNow, show, svg, timeText } from "./page.js";
import { densityLayer, layerItem, legendItem, moonMap, terrain, track } from "./moon.js";

const LONGEST_S = 8 * 86400; // of a forecast
const SUN_PX = 36;
const CURVE_PX = 56;

// Sun elevations of the bands, from night to high Sun.
const BANDS = [
  ["night", -90, 0],
  ["0 to 10 deg", 0, 10],
  ["10 to 30 deg", 10, 30],
  ["30 to 60 deg", 30, 60],
  ["above 60 deg", 60, 90.1],
];
const bandOf = (elevation) => BANDS.findIndex(([, from, to]) => elevation >= from && elevation < to);

let found = null;
export const forecast = () => found;
export const conflictsOf = (id) => found?.conflicts.find((one) => one.window_id === id)?.reasons ?? [];

export async function loadForecast([from, to], spacecraft, ephemeris) {
  const stop = Math.min(Math.ceil(to), Math.floor(from) + LONGEST_S);
  found = await get("plan/forecast", { ...spacecraft, start: isoText(Math.floor(from)), stop: isoText(stop), ephemeris_id: ephemeris });
  const shortened = to - from > LONGEST_S ? `Conditions and resources are shown for the first ${LONGEST_S / 86400} days of the view.` : "";
  const reason = found.reason ? (found.time_s.length ? `Part of the time has no forecast: ${found.reason}.` : `There is no forecast: ${found.reason}.`) : "";
  const next = found.reason ? [" Windows can be found where an ephemeris is: ", element("a", { href: "/#upload" }, "upload one"), "."] : [];
  show("forecast-state", [shortened, reason].filter(Boolean).join(" "), next);
}

// Curves of the forecast: name, unit, values, greatest value of the lane, limit.
function curves() {
  const kib = (values) => values.map((value) => value / 1024);
  const most = (values, least) => Math.max(least, ...values);
  const rate = (values) => values.map((value) => (value * 8) / found.step_s / 1000);
  return [
    { name: "battery", unit: "%", values: found.battery_share.map((value) => 100 * value), top: 100, limit: 100 * found.battery_floor, below: true },
    { name: "storage", unit: "KiB", values: kib(found.stored_octets), top: most(kib(found.stored_octets), 1), limit: found.storage_octets / 1024 },
    { name: "downlink", unit: "kbit/s", values: rate(found.sent_octets), top: most(rate(found.downlink_octets), 1), behind: rate(found.downlink_octets) },
  ];
}

export const lanesHeight = () => (found?.time_s.length ? SUN_PX + 3 * CURVE_PX : 0);

const text = (x, y, words, kind) => svg("text", { x, y, class: kind }, words);

// Runs of equal values: [value, first index, index after the last].
function runs(values) {
  const all = [];
  values.forEach((value, index) => {
    if (all.length && all.at(-1)[0] === value) all.at(-1)[2] = index + 1;
    else all.push([value, index, index + 1]);
  });
  return all;
}

export function drawLanes(drawn, x, width, top) {
  if (!found?.time_s.length) return;
  const half = found.step_s / 2;
  const left = (index) => x(found.time_s[index] - half);
  const right = (index) => x(found.time_s[index] + half);
  const sun = svg("g", { class: "sun", role: "img", "aria-label": sunText() });
  for (const [band, from, to] of runs(found.sun_elevation_deg.map(bandOf))) {
    sun.append(svg("rect", { x: left(from), y: top + 15, width: Math.max(0.5, right(to - 1) - left(from)), height: SUN_PX - 22, class: `band${band}` }));
  }
  for (const [dark, from, to] of runs(found.sunlit.map((value) => value < 0.5))) {
    if (dark) sun.append(svg("rect", { x: left(from), y: top + SUN_PX - 6, width: Math.max(0.5, right(to - 1) - left(from)), height: 4, class: "shadow" }));
  }
  sun.append(svg("line", { x1: 0, x2: width, y1: top, y2: top, class: "edge" }), text(4, top + 12, "Sun elevation; black below: spacecraft in shadow", "lane"));
  drawn.append(sun);
  curves().forEach((one, index) => {
    const [high, low] = [top + SUN_PX + index * CURVE_PX + 19, top + SUN_PX + (index + 1) * CURVE_PX - 4];
    const y = (value) => low - ((low - high) * value) / one.top;
    const points = (values) => values.map((value, at) => `${x(found.time_s[at]).toFixed(1)},${y(value).toFixed(1)}`).join(" ");
    const lane = svg("g", { class: `curve ${one.name}`, role: "img", "aria-label": curveText(one) });
    lane.append(svg("line", { x1: 0, x2: width, y1: high - 18, y2: high - 18, class: "edge" }));
    if (one.behind) lane.append(svg("polyline", { points: points(one.behind), class: "behind" }));
    lane.append(svg("polyline", { points: points(one.values) }));
    if (one.limit !== undefined && one.limit <= one.top) lane.append(svg("line", { x1: 0, x2: width, y1: y(one.limit), y2: y(one.limit), class: "limit" }));
    lane.append(text(4, high - 5, `${one.name}, ${one.unit} (to ${figure(one.top)})${found.assumed.includes(one.name) ? ", assumed" : ""}`, "lane"));
    drawn.append(lane);
  });
}

function sunText() {
  const share = BANDS.map(([name], band) => [name, found.sun_elevation_deg.filter((value) => bandOf(value) === band).length / found.time_s.length]);
  return `Sun elevation below the spacecraft: ${share.filter(([, part]) => part).map(([name, part]) => `${name} ${Math.round(100 * part)} %`).join(", ")}`;
}

function curveText({ name, unit, values, limit, below }) {
  const words = `${name}: ${figure(Math.min(...values))} to ${figure(Math.max(...values))} ${unit}`;
  return limit === undefined ? words : `${words}, ${below ? "at least" : "at most"} ${figure(limit)}`;
}

// Values at a time, as text; null outside of the forecast.
export function valuesAt(time) {
  if (!found?.time_s.length) return null;
  const index = Math.floor((time - found.time_s[0]) / found.step_s + 0.5);
  if (index < 0 || index >= found.time_s.length) return null;
  const at = (name, digits) => figure(found[name][index], digits);
  const shadow = found.sunlit[index] < 0.5 ? ", spacecraft in shadow" : "";
  return (
    `${timeText(isoText(time))}: Sun elevation ${at("sun_elevation_deg")} deg${shadow}, altitude ${at("altitude_km")} km, ` +
    `latitude ${at("latitude_deg")}, longitude ${at("longitude_deg")} deg, battery ${figure(100 * found.battery_share[index])} %, ` +
    `${figure(found.stored_octets[index] / 1024)} KiB on board, downlink ${figure((found.sent_octets[index] * 8) / found.step_s / 1000)} of ${figure((found.downlink_octets[index] * 8) / found.step_s / 1000)} kbit/s`
  );
}

let map = null;
let drawnFor = null; // spacecraft of the map
let tracks = null;

// The map of a spacecraft: its terrain, and the density of the craters of its catalogue.
export async function showMap(spacecraft, document) {
  if (drawnFor === spacecraft.spacecraft_id) return;
  drawnFor = spacecraft.spacecraft_id;
  const density = await get("plan/crater-density", { spacecraft_id: spacecraft.spacecraft_id });
  const over = terrain(document);
  map?.remove();
  map = moonMap(byId("map"), over);
  show("map-legend");
  if (density.rows.length) {
    const { layer, most } = densityLayer(map, density, style("--purple"));
    byId("map-legend").append(layerItem(map, layer, `craters of ${density.diameter_km.min} to ${density.diameter_km.max} km: 0 to ${figure(most)} per 10 000 km²`, style("--purple")));
  }
  byId("map-legend").append(legendItem("track by day", style("--orange")), legendItem("track at night", style("--sky")), legendItem("windows", style("--vermillion")), legendItem("chosen window", style("--ink")));
  byId("map-text").textContent = `${over.text} ${density.rows.length ? `Catalogue: ${density.source}.` : `No crater density: ${density.reason}.`}`;
  tracks = L.layerGroup().addTo(map);
  drawTrack([], null);
}

// The ground track of the forecast in its shown colours, with the windows over it.
export function drawTrack(windows, chosen) {
  if (!tracks) return;
  tracks.clearLayers();
  if (!found?.time_s.length) return;
  const piece = (from, to, options) => tracks.addLayer(track(map, found.latitude_deg.slice(from, to), found.longitude_deg.slice(from, to), options).remove());
  const last = found.time_s.length;
  for (const [day, from, to] of runs(found.sun_elevation_deg.map((value) => value >= 0))) {
    piece(from, Math.min(to + 1, last), { color: style(day ? "--orange" : "--sky"), weight: 1.5 });
  }
  for (const one of windows) {
    const from = found.time_s.findIndex((time) => time >= one.start - found.step_s / 2);
    const after = found.time_s.findIndex((time) => time > one.stop + found.step_s / 2);
    if (from < 0 || after === 0) continue;
    piece(from, after < 0 ? last : after, { color: style(one.id === chosen ? "--ink" : "--vermillion"), weight: one.id === chosen ? 6 : 4 });
  }
  const now = Math.floor((missionNow() - found.time_s[0]) / found.step_s + 0.5);
  if (now >= 0 && now < last) tracks.addLayer(L.circleMarker([found.latitude_deg[now], found.longitude_deg[now]], { radius: 5, color: style("--ink"), interactive: false }));
}

export const bandLegend = () => BANDS.map(([name], band) => element("li", {}, element("span", { class: `mark band band${band}` }), name === "night" ? "Sun below the horizon" : `Sun ${name}`));
