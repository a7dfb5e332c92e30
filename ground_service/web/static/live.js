// A payload flown live: what its camera sees, what it finds, where it believes to be.
import { chart, solutionStyle } from "./charts.js";
import { dot, legendItem, moonMap, track, wrapped } from "./moon.js";
import { byId, element, figure, notice, show, timeText, words } from "./page.js";

const KEPT = 600;
const REFRESH_MS = 250; // pictures come as fast as they can; numbers, map and charts are read by eye
const context = byId("frame").getContext("2d");
const history = { times: [], names: [], errors: {}, altitude: [] };
let socket = null;
let ended = false; // stays on the page until another payload answers
let map = null;
let lines = {};
let paths = {};
let dots = {};
let plots = [];
let waiting = []; // frames that numbers, map and charts do not show yet
let refreshing = null;
let shown = 0;
let shownSince = performance.now();

function connect() {
  const url = `${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/api/v1/payload`;
  socket = new WebSocket(url);
  let ready = true; // until a refusal says why
  socket.onopen = () => ended || say("connecting");
  socket.onmessage = (event) => {
    const message = JSON.parse(event.data);
    ready = message.kind !== "error";
    take(message);
  };
  socket.onclose = () => {
    if (ready && !ended) say("not connected");
    setTimeout(connect, 5000);
  };
}

const say = (text) => {
  byId("state").textContent = text;
};

function take(message) {
  if (message.kind === "error") return ended || say(message.text);
  ended = message.kind === "end";
  if (ended) return say("the scenario has ended");
  if (message.kind === "connected") return say("connected");
  if (message.kind === "fault") log(`${timeText(message.utc)} ${message.text}`);
  if (message.kind !== "frame" && message.kind !== "turn") return;
  say(message.paused ? "paused" : "running");
  for (const event of message.events) {
    log(`${timeText(message.utc)} ${event.severity}: ${words(event.event)}${event.text ? `: ${event.text}` : ""}`);
  }
  if (message.kind === "frame") drawFrame(message);
}

function drawFrame(message) {
  const picture = new Image();
  picture.onload = () => {
    if (byId("frame").width !== picture.width) byId("frame").width = picture.width;
    if (byId("frame").height !== picture.height) byId("frame").height = picture.height;
    context.drawImage(picture, 0, 0);
    rings(message);
    count();
  };
  if (message.image_jpeg) picture.src = `data:image/jpeg;base64,${message.image_jpeg}`;
  for (const [name, one] of Object.entries(message.estimates ?? {})) {
    if (one.reset_trigger && one.reset_trigger !== "none") log(`${timeText(message.utc)} ${name}: reset, ${words(one.reset_trigger)}`);
  }
  waiting.push(message);
  refreshing ??= setTimeout(refresh, REFRESH_MS);
}

function refresh() {
  refreshing = null;
  numbers(waiting.at(-1));
  waiting.splice(0).forEach(remember);
  for (const [name, line] of Object.entries(lines)) line.setLatLngs(paths[name]);
  for (const [name, one] of Object.entries(dots)) one.setLatLng(paths[name].at(-1).at(-1));
  const here = paths.reference?.at(-1).at(-1);
  if (here && !map.getBounds().pad(-0.15).contains(here)) map.panTo(here, { animate: false });
  plots[0]?.setData([history.times, ...history.names.map((name) => history.errors[name])]);
  plots[1]?.setData([history.times, history.altitude]);
}

// A detection is matched if the payload reported the crater that it took it for.
function rings({ catalogue = [], detections = [] }) {
  const circles = (ones, css, dash) => {
    context.beginPath();
    context.setLineDash(dash);
    context.strokeStyle = css;
    for (const one of ones) {
      const [u, v, angle] = [one.u_px + 0.5, one.v_px + 0.5, one.angle_rad ?? 0];
      const [major, minor] = [(one.major_px ?? one.diameter_px) / 2, (one.minor_px ?? one.diameter_px) / 2];
      context.moveTo(u + major * Math.cos(angle), v + major * Math.sin(angle));
      context.ellipse(u, v, major, minor, angle, 0, 2 * Math.PI);
    }
    context.stroke();
  };
  const matched = (one) => one.crater_id !== undefined;
  context.lineWidth = 1.5;
  circles(catalogue, "#ffd400", [3, 3]);
  circles(detections.filter((one) => !matched(one)), "#00e5ff", []);
  circles(detections.filter(matched), "#5dff5d", []);
}

function count() {
  shown += 1;
  byId("frame").dataset.shown = 1 + Number(byId("frame").dataset.shown ?? 0);
  const elapsed = (performance.now() - shownSince) / 1000;
  if (elapsed < 2) return;
  byId("frame").dataset.rate = (shown / elapsed).toFixed(1);
  shown = 0;
  shownSince = performance.now();
}

function numbers(message) {
  const fact = (name, value) => element("div", {}, element("dt", {}, name), element("dd", {}, value));
  const estimates = Object.entries(message.estimates ?? {});
  show(
    "numbers",
    fact("Time", timeText(message.utc)),
    fact("Frame", figure(message.frame)),
    fact("Mode", message.mode),
    fact("Altitude", `${figure(message.altitude_km, 4)} km`),
    fact("Detections", `${figure((message.detections ?? []).length)}, ${figure((message.detections ?? []).filter((one) => one.crater_id !== undefined).length)} matched`),
    estimates.map(([name, one]) => fact(name, `${one.outcome ?? "–"}${one.error_m === undefined ? "" : `, error ${figure(one.error_m)} m`}`)),
    fact("Shown", `${byId("frame").dataset.rate ?? "–"} frames/s`),
  );
}

function log(text) {
  byId("log").prepend(element("li", {}, text));
  while (byId("log").children.length > 100) byId("log").lastChild.remove();
}

function remember(message) {
  const { reference, estimates = {} } = message;
  const time = Date.parse(message.utc) / 1000;
  if (history.times.length && time <= history.times.at(-1)) return;
  history.times.push(time);
  history.altitude.push(message.altitude_km);
  const names = Object.keys(estimates);
  if (names.join() !== history.names.join()) begin(names, reference, message.terrain);
  for (const name of history.names) (history.errors[name] ??= []).push(estimates[name]?.error_m || null);
  if (history.times.length > KEPT) {
    for (const column of [history.times, history.altitude, ...Object.values(history.errors)]) column.shift();
  }
  for (const [name, place] of [["reference", reference], ...Object.entries(estimates)]) {
    if (place?.latitude_deg === undefined || place.latitude_deg === null || !paths[name]) continue;
    const here = [place.latitude_deg, wrapped(place.longitude_deg)];
    // No line goes across the whole map where a track passes 180 degrees.
    if (Math.abs(here[1] - paths[name].at(-1).at(-1)[1]) > 180) paths[name].push([]);
    paths[name].at(-1).push(here);
  }
}

// Map, legend and charts, once it is known which estimators fly.
function begin(names, reference, terrain) {
  history.names = names;
  for (const name of names) history.errors[name] = history.times.slice(1).map(() => null);
  map?.remove();
  map = moonMap(byId("map"), { albedo: terrain?.real === true });
  byId("terrain").textContent = terrain ? `Terrain: ${terrain.name}.` : "Terrain: not stated by the payload.";
  // White is seen on the picture of the Moon only.
  const over = terrain?.real === true ? "#ffffff" : getComputedStyle(document.documentElement).getPropertyValue("--ink").trim();
  lines = {};
  paths = {};
  dots = {};
  show("map-legend");
  for (const [index, name] of ["reference", ...names].entries()) {
    const css = name === "reference" ? over : solutionStyle(name, "estimate", index).colour;
    const first = [[reference.latitude_deg], [wrapped(reference.longitude_deg)]];
    paths[name] = [[first.flat()]];
    lines[name] = track(map, ...first, { color: css, weight: name === "reference" ? 2 + 3 * names.length : 2 + 3 * (names.length - index), lineCap: "butt" });
    dots[name] = dot(map, ...first.flat(), { color: css });
    byId("map-legend").append(legendItem(name, css));
  }
  map.setView([reference.latitude_deg, ((reference.longitude_deg + 180) % 360) - 180], 4);
  show("charts");
  const times = history.times;
  plots = [
    chart(byId("charts"), "distance from the reference", "m", names.map((name, index) => ({ label: name, ...solutionStyle(name, "estimate", index + 1), times, mean: times.map(() => null) })), { logarithmic: true }).plot,
    chart(byId("charts"), "altitude", "km", [{ label: "altitude", times, mean: history.altitude }], { height: 160 }).plot,
  ];
}

const steer = (words) => () => {
  if (socket?.readyState === WebSocket.OPEN) socket.send(words);
  else notice("No payload is connected.", "bad");
};
byId("run").addEventListener("click", steer("run"));
byId("pause").addEventListener("click", steer("pause"));
byId("step").addEventListener("click", steer("step"));
byId("rate").addEventListener("change", () => steer(`rate ${byId("rate").value}`)());
connect();
