import { bind, state, stated } from "./address.js";
import { get, request, send } from "./api.js";
import { acting, button, byId, element, figure, inTurn, isoText, later, lengthText, loading, mayOperate, missionNow, notice, on, plural, seconds, session, show, showTable, stateMark, svg, table, timeText, trouble, watch } from "./page.js";
import { bandLegend, conflictsOf, drawLanes, drawTrack, lanesHeight, loadForecast, showMap, valuesAt } from "./forecast.js";
import { loadRequests } from "./requests.js";
import { approve, sequenceTable, takeBack, uplink } from "./chain.js";

const ROW_PX = 34;
const HEAD_PX = 24;
const LABEL_PX = 16; // name of a section, above its bars
const LETTER_PX = 7; // of a name, which is left out where it would cover the next one
const DAY_S = 86400;
let windows = [];
let candidates = [];
let rejected = []; // spans of the search
let contacts = []; // of the search
let linked = []; // of the links
let ephemerides = [];
let chosen = null;
let view = [0, 1]; // seconds of UTC [from, to]
let viewChosen = false; // else the view follows what there is to see
let dragging = false; // what is in the hand is not drawn again

const LENGTH = ["Length", (row) => lengthText(seconds(row.stop) - seconds(row.start)), "num"];
const selectable = (row) => ({ start: seconds(row.start), stop: seconds(row.stop) });

// From now to the end of what is planned; without any to come, all windows.
function whole() {
  const now = 600 * Math.floor(missionNow() / 600);
  const all = [...windows, ...candidates].map(selectable);
  const coming = all.filter((one) => one.stop > now);
  const spans = coming.length ? coming : all;
  if (!spans.length) return emptyView();
  const first = Math.min(...spans.map((one) => one.start));
  const from = first - now < 7 * DAY_S ? Math.min(now, first) : first;
  const to = Math.max(...spans.map((one) => one.stop));
  const margin = Math.max(600, 0.05 * (to - from));
  return [from - margin, to + margin];
}

// Without windows: the next day of the mission; of an ephemeris that does not cover it, its first day.
function emptyView() {
  const now = 600 * Math.floor(missionNow() / 600); // in whole steps, so that the view stands still
  const covers = ephemerides.find((one) => seconds(one.start) <= now && now < seconds(one.stop));
  const shown = byId("ephemeris").value ? chosenEphemeris() : (covers ?? chosenEphemeris());
  const { start, stop } = shown ? selectable(shown) : { start: now, stop: now + DAY_S };
  const from = start <= now && now < stop ? now : start;
  return [from, Math.min(from + DAY_S, Math.max(stop, from + 3600))];
}

const chosenEphemeris = () => ephemerides.find((one) => String(one.id) === byId("ephemeris").value) ?? ephemerides[0];

const spacecraftChosen = () => {
  const [id, instance] = byId("spacecraft").value.split(" ");
  return { spacecraft_id: Number(id), instance };
};

function tickStep(span) {
  const most = Math.max(3, Math.min(12, Math.floor(byId("timeline").clientWidth / 90)));
  return [60, 300, 600, 1800, 3600, 3 * 3600, 6 * 3600, DAY_S, 2 * DAY_S, 7 * DAY_S].find((step) => span / step <= most) ?? 30 * DAY_S;
}

// Windows that share time stand below each other.
function lanes(rows) {
  const ends = [];
  return rows.map((row) => {
    const { start, stop } = selectable(row);
    let lane = ends.findIndex((end) => end <= start);
    if (lane < 0) lane = ends.push(0) - 1;
    ends[lane] = stop;
    return lane;
  });
}

function drawTimeline() {
  if (dragging) return;
  const place = byId("timeline");
  const width = Math.max(240, place.clientWidth);
  if (!viewChosen && String(whole()) !== String(view)) {
    view = whole();
    if (contactsOf) soonConditions();
  }
  const scale = width / (view[1] - view[0]);
  const x = (time) => (time - view[0]) * scale;
  const ordered = [...windows].sort((a, b) => seconds(a.start) - seconds(b.start));
  const lane = lanes(ordered);
  const rows = Math.max(1, ...lane.map((one) => one + 1));
  const sections = [
    { name: "candidates", height: LABEL_PX + ROW_PX },
    { name: "windows", height: LABEL_PX + rows * ROW_PX },
    { name: "contacts", height: LABEL_PX + ROW_PX },
  ];
  let lanesTop = HEAD_PX;
  for (const one of sections) {
    one.top = lanesTop;
    one.bars = one.top + LABEL_PX;
    lanesTop += one.height;
  }
  const height = lanesTop + lanesHeight();
  const drawn = svg("svg", { width, height, viewBox: `0 0 ${width} ${height}`, role: "group", "aria-label": "timeline of windows" });
  const step = tickStep(view[1] - view[0]);
  let day = null; // the first tick of a day states its date
  for (let time = Math.ceil(view[0] / step) * step; time < view[1]; time += step) {
    drawn.append(svg("line", { x1: x(time), x2: x(time), y1: HEAD_PX - 6, y2: height, class: "tick" }));
    const iso = isoText(time);
    const text = step >= DAY_S ? iso.slice(0, 10) : day === iso.slice(0, 10) ? iso.slice(11, 16) : `${iso.slice(5, 10)} ${iso.slice(11, 16)}`;
    day = iso.slice(0, 10);
    drawn.append(svg("text", { x: x(time) + 3, y: 13, class: "when" }, text));
  }
  for (const { name, top } of sections) {
    drawn.append(svg("line", { x1: 0, x2: width, y1: top, y2: top, class: "edge" }), svg("text", { x: 4, y: top + 12, class: "lane" }, name));
  }
  drawLanes(drawn, x, width, lanesTop);
  for (const one of linked) {
    drawn.append(bar(x(seconds(one.start)), x(seconds(one.stop ?? one.predicted_stop ?? isoText(missionNow()))), sections[2].bars, `contact ${one.state}`, `link ${one.link}, ${one.station}, ${one.state}, ${timeText(one.start)} to ${timeText(one.stop)}`));
  }
  for (const one of contacts) {
    drawn.append(bar(x(seconds(one.start)), x(seconds(one.stop)), sections[2].bars, "contact", `${one.station} ${timeText(one.start)} to ${timeText(one.stop)}`));
  }
  for (const one of rejected) {
    drawn.append(bar(x(seconds(one.start)), x(seconds(one.stop)), sections[0].bars, "candidate rejected", `rejected ${timeText(one.start)}, ${lengthText(seconds(one.stop) - seconds(one.start))}: ${one.reason}`));
  }
  for (const one of candidates) {
    const made = bar(x(seconds(one.start)), x(seconds(one.stop)), sections[0].bars, "candidate", `candidate ${timeText(one.start)}, ${lengthText(seconds(one.stop) - seconds(one.start))}${mayOperate() ? ": plan it" : ""}`);
    if (mayOperate()) pressable(made, acting(() => plan(one)));
    drawn.append(made);
  }
  ordered.forEach((row, index) => {
    const next = ordered.find((_, other) => other > index && lane[other] === lane[index]);
    const room = scale * ((next ? seconds(next.start) : view[1]) - seconds(row.start));
    drawn.append(windowBar(row, x, sections[1].bars + lane[index] * ROW_PX, scale, room));
  });
  drawn.addEventListener("pointermove", (event) => readAt(view[0] + (event.clientX - drawn.getBoundingClientRect().left) / scale));
  const cursor = svg("line", { y1: HEAD_PX - 6, y2: height, class: "cursor" });
  drawn.append(cursor, svg("line", { y1: HEAD_PX - 6, y2: height, class: "now" }), svg("text", { y: height - 4, class: "now" }, "now"));
  show(place, drawn);
  markNow();
  const follows = readShare === null;
  readAt(follows ? missionNow() : view[0] + readShare * (view[1] - view[0]));
  if (follows) readShare = null;
  drawTrack(windows.map((row) => ({ id: row.id, ...selectable(row) })), chosen);
}

function markNow() {
  const share = (missionNow() - view[0]) / (view[1] - view[0]);
  const x = share * Math.max(240, byId("timeline").clientWidth);
  for (const one of byId("timeline").querySelectorAll(".now")) {
    for (const end of one.matches("text") ? ["x"] : ["x1", "x2"]) one.setAttribute(end, x + (end === "x" ? 3 : 0));
    one.toggleAttribute("hidden", share < 0 || share > 1);
  }
}
setInterval(markNow, 5000);

// The values of the forecast at the pointer, or at the time of the slider.
let readShare = null; // of the view; null: it follows the mission time
function readAt(time) {
  readShare = Math.min(Math.max((time - view[0]) / (view[1] - view[0]), 0), 1);
  const readTime = view[0] + readShare * (view[1] - view[0]);
  byId("at").value = Math.round(1000 * readShare);
  const words = valuesAt(readTime) ?? `${timeText(isoText(readTime))}: no forecast`;
  byId("at").setAttribute("aria-valuetext", words);
  byId("values").textContent = words;
  const cursor = byId("timeline").querySelector(".cursor");
  const x = readShare * Math.max(240, byId("timeline").clientWidth);
  for (const end of ["x1", "x2"]) cursor?.setAttribute(end, x);
}

function bar(left, right, top, kind, label) {
  const rect = svg("rect", { x: left, y: top, width: Math.max(6, right - left), height: ROW_PX - 8, rx: 3 });
  return svg("g", { class: `span ${kind}` }, rect, svg("title", {}, label));
}

function pressable(made, deed) {
  made.setAttribute("tabindex", "0");
  made.setAttribute("role", "button");
  made.setAttribute("aria-label", made.querySelector("title").textContent);
  made.addEventListener("click", deed);
  made.addEventListener("keydown", (event) => {
    if (event.key !== "Enter" && event.key !== " ") return;
    event.preventDefault(); // the space bar would scroll the page
    deed(event);
  });
}

// Steps of the start and of the stop by key.
const KEYS = { ArrowLeft: [-1, -1], ArrowRight: [1, 1], ArrowUp: [0, 1], ArrowDown: [0, -1], "[": [-1, 0], "]": [1, 0] };

function windowBar(row, x, top, scale, room) {
  const { start, stop } = selectable(row);
  const made = bar(x(start), x(stop), top, `window ${row.state}${chosen === row.id ? " chosen" : ""}${conflictsOf(row.id).length ? " conflict" : ""}`, `${row.name}, ${row.state}, ${timeText(row.start)} to ${timeText(row.stop)}${conflictsOf(row.id).map((reason) => `; conflict: ${reason}`).join("")}`);
  if (room > LETTER_PX * row.name.length) made.append(svg("text", { x: x(start) + 5, y: top + 17, class: "name" }, row.name));
  made.dataset.window = row.id;
  made.dataset.row = row.id;
  pressable(made, () => choose(row.id));
  if (row.state !== "draft" || !mayOperate()) return made;
  made.addEventListener("keydown", (event) => {
    const [first, last] = KEYS[event.key] ?? [0, 0];
    if (!(first || last) || event.altKey || event.ctrlKey || event.metaKey) return;
    event.preventDefault();
    const by = event.shiftKey ? 10 : 60;
    acting(() => move(row, start + by * first, stop + by * last))();
  });
  made.addEventListener("pointerdown", (down) => drag(down, row, made, start, stop, scale));
  return made;
}

// Moves the window, or one of its ends where it was taken hold of there.
function drag(down, row, made, start, stop, scale) {
  const box = made.querySelector("rect").getBoundingClientRect();
  const end = box.width > 24 && down.clientX < box.left + 8 ? "start" : box.width > 24 && down.clientX > box.right - 8 ? "stop" : "both";
  const left = Number(made.querySelector("rect").getAttribute("x"));
  let shift = 0;
  dragging = true;
  made.setPointerCapture(down.pointerId);
  const moved = (event) => {
    shift = Math.round((event.clientX - down.clientX) / scale);
    made.setAttribute("transform", end === "both" ? `translate(${event.clientX - down.clientX} 0)` : "");
    if (end !== "both") {
      const rect = made.querySelector("rect");
      const by = event.clientX - down.clientX;
      const rest = Math.max(3, box.width + (end === "stop" ? by : -by));
      rect.setAttribute("width", rest);
      if (end === "start") rect.setAttribute("x", left + box.width - rest);
    }
  };
  made.addEventListener("pointermove", moved);
  const letGo = (event) => {
    dragging = false;
    made.removeEventListener("pointermove", moved);
    made.removeEventListener("pointerup", letGo);
    made.removeEventListener("pointercancel", letGo);
    if (shift && event.type === "pointerup") {
      acting(() => move(row, start + (end === "stop" ? 0 : shift), stop + (end === "start" ? 0 : shift)))();
    } else choose(row.id);
  };
  made.addEventListener("pointerup", letGo);
  made.addEventListener("pointercancel", letGo);
}

// Reasons why a change of a window was refused, until the next one.
let refusal = null;

async function move(row, start, stop) {
  refusal = null;
  try {
    await send("PATCH", `windows/${row.id}`, { start: isoText(start), stop: isoText(stop) });
  } catch (error) {
    const reasons = (error.document?.errors ?? []).map((one) => one.detail).filter(Boolean);
    refusal = { id: row.id, what: `${timeText(isoText(start))} to ${timeText(isoText(stop))}`, reasons: reasons.length ? reasons : [error.message] };
    throw error;
  } finally {
    chosen = row.id;
    await load();
  }
}

function choose(id) {
  chosen = id;
  state({ window: id });
  drawTimeline();
  showChosen();
}

const deed = (name, task, kind) => button(name, () => task().then(load), { kind });

function showChosen() {
  const row = windows.find((one) => one.id === chosen);
  if (!row) {
    show("selected", element("p", { class: "hint" }, "Choose a window on the timeline or in the list."));
    return;
  }
  const path = `windows/${row.id}`;
  const deeds = {
    draft: [deed("Approve…", () => approve(row), "primary"), deed("Delete", () => send("DELETE", path))],
    approved: [deed(row.telecommands.length ? "Send now…" : "Uplink…", () => uplink(row), "primary"), deed("Back to draft", () => send("PATCH", path, { state: "draft" })), deed("Take back…", () => takeBack(row))],
    uplinked: [deed("Take back…", () => takeBack(row))],
  }[row.state] ?? [];
  const span = (value, unit) => (value ? `${figure(value.min)} to ${figure(value.max)} ${unit}` : "–");
  const predicted = row.predicted ?? {};
  const facts = [
    ["State", stateMark(row.state)],
    ["Start", timeText(row.start)],
    ["Stop", timeText(row.stop)],
    ["Length", lengthText(seconds(row.stop) - seconds(row.start))],
    ["Frames", figure(Math.floor((seconds(row.stop) - seconds(row.start)) / row.cadence_s) + 1)],
    ["Data", `${figure(row.data_octets / 1024)} KiB`],
    ["Altitude", span(predicted.altitude_km, "km")],
    ["Sun elevation", span(predicted.sun_elevation_deg, "deg")],
    ["Telecommands", row.telecommands.length ? element("a", { href: "/commands" }, row.telecommands.join(", ")) : "none yet"],
    ["Pass", row.pass_id ? element("a", { href: `/passes/${row.pass_id}` }, String(row.pass_id)) : "none yet"],
    ["Reason", row.reason ?? "–"],
  ];
  show(
    "selected",
    element("h3", {}, row.name),
    element("dl", { class: "facts" }, facts.map(([name, value]) => element("div", {}, element("dt", {}, name), element("dd", {}, value)))),
    refusal?.id === row.id ? reasonList(`Not changed to ${refusal.what}:`, refusal.reasons) : null,
    conflictsOf(row.id).length ? reasonList("Conflicts of the plan:", conflictsOf(row.id)) : null,
    row.state === "draft" ? timesForm(row) : null,
    element("p", { class: "actions" }, deeds, button("Telecommands", () => showSequence(row), { needs: null })),
    listed?.id === row.id ? sequenceTable(listed.items) : null,
  );
}

const reasonList = (heading, reasons) => element("div", { class: "conflicts" }, element("strong", {}, heading), element("ul", { class: "reasons" }, reasons.map((reason) => element("li", {}, reason))));

const UTC_PATTERN = "\\d{4}-\\d\\d-\\d\\dT\\d\\d:\\d\\d:\\d\\d(\\.\\d+)?Z";

// Start and stop of a draft, typed.
function timesForm(row) {
  const field = (name, value) => element("input", { name, required: true, value: `${value.slice(0, 19)}Z`, pattern: UTC_PATTERN, title: "UTC, such as 2029-08-07T06:00:00Z" });
  const [start, stop] = [field("start", row.start), field("stop", row.stop)];
  const change = acting(() => move(row, seconds(start.value), seconds(stop.value)));
  return element("form", { class: "row", "data-needs": "operator", "data-row": row.id, onsubmit: change }, element("label", {}, "Start, UTC ", start), element("label", {}, "Stop, UTC ", stop), element("button", {}, "Change"));
}

// The window whose telecommands are shown, and these; they stay through messages of the live feed.
let listed = null;

async function showSequence({ id }) {
  listed = { id, items: (await get(`windows/${id}/telecommands`)).items };
  showChosen();
}

async function enter() {
  const row = await send("POST", "windows", { name: byId("enter-name").value, start: byId("enter-start").value, stop: byId("enter-stop").value, cadence_s: byId("cadence").valueAsNumber, ...spacecraftChosen() });
  chosen = row.id;
  await load();
  choose(row.id);
}

async function plan(candidate) {
  const ephemeris = Number(byId("ephemeris").value) || null;
  const row = await send("POST", "windows", {
    name: `observation ${timeText(candidate.start).slice(5, 16)}`,
    start: candidate.start,
    stop: candidate.stop,
    cadence_s: byId("cadence").valueAsNumber,
    ...spacecraftChosen(),
    ephemeris_id: ephemeris,
  });
  candidates = candidates.filter((one) => one !== candidate);
  chosen = row.id;
  await load();
}

const limits = (name) => {
  const [min, max] = [byId(`${name}-min`).valueAsNumber, byId(`${name}-max`).valueAsNumber];
  return Number.isNaN(min) && Number.isNaN(max) ? null : { min: Number.isNaN(min) ? -1e9 : min, max: Number.isNaN(max) ? 1e9 : max };
};

async function search() {
  const found = await send("POST", "windows/search", {
    ...spacecraftChosen(),
    ephemeris_id: Number(byId("ephemeris").value) || null,
    start: byId("from").value || null,
    stop: byId("to").value || null,
    cadence_s: byId("cadence").valueAsNumber,
    altitude_km: limits("altitude"),
    sun_elevation_deg: limits("sun"),
    latitude_deg: limits("latitude"),
    sunlit: byId("sunlit").checked,
    needs_contact: byId("contact").checked,
  });
  candidates = found.candidates;
  ({ contacts, rejected } = found);
  showAll();
  show(
    "candidates",
    element("p", { class: "hint" }, `${plural(candidates.length, "candidate")}, ${plural(rejected.length, "span")} rejected. Data: ${found.data.join(", ") || "built in"}.`),
    table(
      "Candidates",
      [
        "start",
        LENGTH,
        "frames",
        ["Altitude, km", (row) => `${figure(row.altitude_km.min)} to ${figure(row.altitude_km.max)}`, "num"],
        ["Sun, deg", (row) => `${figure(row.sun_elevation_deg.min)} to ${figure(row.sun_elevation_deg.max)}`, "num"],
        ["Craters a frame", (row) => (row.craters_per_frame ? `${figure(row.craters_per_frame.min)} to ${figure(row.craters_per_frame.max)}` : "–"), "num"],
        ["Battery left", (row) => `${Math.round(100 * row.battery_minimum)} %`, "num"],
        ["Data down by", (row) => (row.downlinked_by ? timeText(row.downlinked_by) : "not within the span")],
        ["", (row) => button("Plan", () => plan(row))],
      ],
      candidates,
      `${found.reason ?? "No span fulfils all constraints"}.`,
    ),
  );
  const spans = () => table("Rejected spans", ["start", LENGTH, "reason"], rejected, "None.");
  show("rejected", rejected.length ? element("details", {}, element("summary", {}, `${plural(rejected.length, "rejected span")} with reasons`), spans()) : null);
}

const load = inTurn(async () => {
  windows = (await get("windows", { limit: 500 })).items;
  drawTimeline();
  if (windows.some((one) => one.id === listed?.id)) await showSequence(listed);
  else showChosen();
  const link = (row) => button(row.name, () => choose(row.id), { kind: "link", needs: null });
  showTable("windows", "Windows", [["Window", link], "start", LENGTH, "state", ["By", "created_by"]], windows, "No window planned: find some above.");
});

const zoom = (factor, shift = 0) => () => {
  const half = ((view[1] - view[0]) / 2) * factor;
  const middle = (view[0] + view[1]) / 2 + shift * half;
  view = [middle - half, middle + half];
  viewChosen = true;
  state({ view: view.map(isoText).join("~") });
  drawTimeline();
  soonConditions();
};

function showAll() {
  viewChosen = false;
  state({ view: null });
  drawTimeline();
  soonConditions();
}

// Contacts of the links in the shown time; they are predicted for at most a month.
const CONTACTS_S = 31 * DAY_S;
let contactsPending = null;
let contactsOf = false; // contacts of a view have been asked for
function soonConditions() {
  clearTimeout(contactsPending);
  contactsPending = setTimeout(() => Promise.all([loadContacts(), loadConditions()]).catch(trouble), 300);
}

let conditionsOf = 0; // number of the last request: answers of former ones are not drawn
async function loadConditions() {
  conditionsOf += 1;
  const mine = conditionsOf;
  await loadForecast(view, spacecraftChosen(), Number(byId("ephemeris").value) || null);
  if (mine !== conditionsOf) return;
  drawTimeline();
  if (!byId("selected").contains(document.activeElement)) showChosen();
}

async function loadContacts() {
  contactsOf = true;
  const found = await get("contacts", { since: isoText(view[0]), until: isoText(Math.min(view[1], view[0] + CONTACTS_S)) });
  linked = found.contacts;
  drawTimeline();
  const reasons = Object.entries(found.unpredicted).map(([link, reason]) => element("p", { class: "hint" }, `Contacts of link ${link} cannot be predicted: ${reason}.`));
  show(
    "contacts",
    reasons,
    table("Contacts", ["link", "station", "spacecraft_id", "start", "stop", "state", "telecommands", "octets", "reason"], linked, "No contact of a link in the shown time."),
  );
}
byId("earlier").addEventListener("click", zoom(1, -1));
byId("later").addEventListener("click", zoom(1, 1));
byId("nearer").addEventListener("click", zoom(0.5));
byId("farther").addEventListener("click", zoom(2));
byId("whole").addEventListener("click", showAll);
byId("week").addEventListener("click", () => {
  const from = whole()[0] + 600;
  viewChosen = true;
  view = [from, from + 7 * DAY_S];
  zoom(1)();
});
on("search", "submit", search);
on("enter", "submit", enter);
on("export", "click", async () => {
  const body = await (await request("plan")).blob();
  element("a", { href: URL.createObjectURL(body), download: "linna-plan.json" }).click();
});
on("import", "change", async () => {
  const made = await send("POST", "plan", JSON.parse(await byId("import").files[0].text()));
  notice(`${Object.keys(made.windows).length} windows of the plan are here`);
  await load();
});
new ResizeObserver(drawTimeline).observe(byId("timeline"));

// Spacecraft that telemetry or a mission description names, flown ones first.
async function loadSpacecraft() {
  const [found, missions] = await Promise.all([get("spacecraft"), get("missions", { limit: 200 })]);
  const declared = missions.items.filter((one) => one.spacecraft_id !== null).map((one) => `${one.spacecraft_id} flight`);
  const keys = [...new Set([...declared, ...found.items.map((one) => `${one.spacecraft_id} ${one.instance}`)])];
  show("spacecraft", (keys.length ? keys : ["76 flight"]).map((key) => element("option", { value: key }, key.replace(" ", ", "))));
  return missions.items;
}

// A camera needs daylight: the search applies it unless other limits are stated.
async function showDaylight(missions) {
  const mission = missions.find((one) => one.spacecraft_id === spacecraftChosen().spacecraft_id);
  const described = mission && (await get(`missions/${mission.revision.slice(0, 16)}`)).document;
  await showMap(spacecraftChosen(), described);
  drawTimeline();
  const camera = described?.camera;
  const needed = camera?.fov_deg !== null && camera?.fov_deg !== undefined;
  byId("sun-min").placeholder = needed ? "0" : "";
  byId("sun-max").placeholder = needed ? "90" : "";
  byId("daylight").textContent = needed ? "The mission description states a camera: without other limits, candidates have the Sun above the horizon throughout." : "No mission description of this spacecraft states a camera: candidates may be at night.";
}

function showSpan() {
  const one = chosenEphemeris();
  byId("from").placeholder = one ? one.start.slice(0, 19) + "Z" : "";
  byId("to").placeholder = one ? one.stop.slice(0, 19) + "Z" : "";
}

const FIELDS = ["ephemeris", "from", "to", "altitude-min", "altitude-max", "sun-min", "sun-max", "latitude-min", "latitude-max", "cadence", "sunlit", "contact"];

async function start() {
  await session;
  const [found, missions] = await Promise.all([get("ephemerides", { limit: 100 }), loadSpacecraft()]);
  ephemerides = found.items;
  show("ephemeris", element("option", { value: "" }, "the newest"), ephemerides.map((one) => element("option", { value: one.id }, `${one.name}, ${timeText(one.start)}`)));
  bind("spacecraft", ...FIELDS);
  showSpan();
  show("bands", bandLegend());
  byId("at").addEventListener("input", () => readAt(view[0] + ((view[1] - view[0]) * byId("at").valueAsNumber) / 1000));
  byId("ephemeris").addEventListener("change", () => {
    showSpan();
    showAll();
  });
  byId("spacecraft").addEventListener("change", soonConditions);
  on("spacecraft", "change", () => Promise.all([showDaylight(missions), loadRequests(spacecraftChosen())]));
  const [from, to] = (stated("view") ?? "").split("~").map((text) => Date.parse(text) / 1000);
  if (from < to) [view, viewChosen] = [[from, to], true];
  await Promise.all([load(), showDaylight(missions), loadRequests(spacecraftChosen())]);
  const asked = stated("window") ?? location.hash.match(/^#window-(\d+)$/)?.[1];
  if (asked) choose(Number(asked));
  await Promise.all([loadContacts(), loadConditions()]);
}

loading(start);
watch(later(() => Promise.all([load(), loadRequests(spacecraftChosen())]).then(loadConditions)));
