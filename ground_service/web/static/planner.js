import { bind, state, stated } from "./address.js";
import { get, request, send } from "./api.js";
import { acting, byId, element, figure, isoText, lengthText, mayOperate, missionNow, notice, seconds, session, show, stateMark, svg, table, timeText, trouble, watch } from "./page.js";
import { loadRequests } from "./requests.js";

const ROW_PX = 34;
const HEAD_PX = 24;
const DAY_S = 86400;
let windows = [];
let candidates = [];
let contacts = []; // of the search
let linked = []; // of the links
let ephemerides = [];
let chosen = null;
let view = [0, 1]; // seconds of UTC [from, to]
let viewChosen = false; // else the view follows what there is to see
let dragging = false; // what is in the hand is not drawn again

const selectable = (row) => ({ start: seconds(row.start), stop: seconds(row.stop) });

function whole() {
  const spans = [...windows, ...candidates].map(selectable);
  if (!spans.length) return emptyView();
  const from = Math.min(...spans.map((one) => one.start));
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
  const most = Math.max(3, Math.min(12, Math.floor(byId("timeline").clientWidth / 70)));
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
    if (contactsOf) soonContacts();
  }
  const scale = width / (view[1] - view[0]);
  const x = (time) => (time - view[0]) * scale;
  const ordered = [...windows].sort((a, b) => seconds(a.start) - seconds(b.start));
  const lane = lanes(ordered);
  const rows = Math.max(1, ...lane.map((one) => one + 1));
  const sections = [
    { name: "candidates", top: HEAD_PX, height: ROW_PX },
    { name: "windows", top: HEAD_PX + ROW_PX, height: rows * ROW_PX },
    { name: "contacts", top: HEAD_PX + ROW_PX + rows * ROW_PX, height: ROW_PX },
  ];
  const height = sections[2].top + ROW_PX;
  const drawn = svg("svg", { width, height, viewBox: `0 0 ${width} ${height}`, role: "group", "aria-label": "timeline of windows" });
  const step = tickStep(view[1] - view[0]);
  for (let time = Math.ceil(view[0] / step) * step; time < view[1]; time += step) {
    drawn.append(svg("line", { x1: x(time), x2: x(time), y1: HEAD_PX - 6, y2: height, class: "tick" }));
    const text = svg("text", { x: x(time) + 3, y: 13, class: "when" });
    const iso = isoText(time);
    text.textContent = step >= DAY_S || time % DAY_S === 0 ? iso.slice(5, 10) : iso.slice(11, 16);
    drawn.append(text);
  }
  for (const { name, top, height: tall } of sections) {
    drawn.append(svg("line", { x1: 0, x2: width, y1: top, y2: top, class: "edge" }));
    const text = svg("text", { x: 4, y: top + tall - 5, class: "lane" });
    text.textContent = name;
    drawn.append(text);
  }
  for (const one of linked) {
    drawn.append(bar(x(seconds(one.start)), x(seconds(one.stop ?? one.start)), sections[2].top + 6, `contact ${one.state}`, `link ${one.link}, ${one.station}, ${one.state}, ${timeText(one.start)} to ${timeText(one.stop)}`));
  }
  for (const one of contacts) {
    drawn.append(bar(x(seconds(one.start)), x(seconds(one.stop)), sections[2].top + 6, "contact", `${one.station} ${timeText(one.start)} to ${timeText(one.stop)}`));
  }
  for (const one of candidates) {
    const made = bar(x(seconds(one.start)), x(seconds(one.stop)), sections[0].top + 4, "candidate", `candidate ${timeText(one.start)}, ${lengthText(seconds(one.stop) - seconds(one.start))}${mayOperate() ? ": plan it" : ""}`);
    if (mayOperate()) pressable(made, acting(() => plan(one)));
    drawn.append(made);
  }
  ordered.forEach((row, index) => drawn.append(windowBar(row, x, sections[1].top + 4 + lane[index] * ROW_PX, scale)));
  show(place, drawn);
}

function bar(left, right, top, kind, label) {
  const made = svg("g", { class: `span ${kind}` });
  made.append(svg("rect", { x: left, y: top, width: Math.max(3, right - left), height: ROW_PX - 8, rx: 3 }));
  const title = svg("title");
  title.textContent = label;
  made.append(title);
  return made;
}

function pressable(made, deed) {
  made.setAttribute("tabindex", "0");
  made.setAttribute("role", "button");
  made.setAttribute("aria-label", made.querySelector("title").textContent);
  made.addEventListener("click", deed);
  made.addEventListener("keydown", (event) => {
    if (event.key === "Enter" || event.key === " ") deed(event);
  });
}

function windowBar(row, x, top, scale) {
  const { start, stop } = selectable(row);
  const made = bar(x(start), x(stop), top, `window ${row.state}${chosen === row.id ? " chosen" : ""}`, `${row.name}, ${row.state}, ${timeText(row.start)} to ${timeText(row.stop)}`);
  const text = svg("text", { x: x(start) + 5, y: top + 17, class: "name" });
  text.textContent = row.name;
  made.append(text);
  made.dataset.window = row.id;
  pressable(made, () => choose(row.id));
  if (row.state !== "draft" || !mayOperate()) return made;
  made.addEventListener("keydown", (event) => {
    const by = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
    if (!by) return;
    event.preventDefault();
    const shift = by * (event.shiftKey ? 10 : 60);
    acting(() => move(row, start + shift, stop + shift))();
  });
  made.addEventListener("pointerdown", (down) => drag(down, row, made, start, stop, scale));
  return made;
}

// Moves the window, or one of its ends where it was taken hold of there.
function drag(down, row, made, start, stop, scale) {
  const box = made.querySelector("rect").getBoundingClientRect();
  const end = box.width > 24 && down.clientX < box.left + 8 ? "start" : box.width > 24 && down.clientX > box.right - 8 ? "stop" : "both";
  let shift = 0;
  dragging = true;
  made.setPointerCapture(down.pointerId);
  const moved = (event) => {
    shift = Math.round((event.clientX - down.clientX) / scale);
    made.setAttribute("transform", end === "both" ? `translate(${event.clientX - down.clientX} 0)` : "");
    if (end !== "both") {
      const rect = made.querySelector("rect");
      const by = event.clientX - down.clientX;
      if (end === "stop") rect.setAttribute("width", Math.max(3, box.width + by));
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

async function move(row, start, stop) {
  try {
    await send("PATCH", `windows/${row.id}`, { start: isoText(start), stop: isoText(stop) });
  } finally {
    chosen = row.id;
    await load();
    byId("timeline").querySelector(`[data-window="${row.id}"]`)?.focus();
  }
}

function choose(id) {
  chosen = id;
  state({ window: id });
  drawTimeline();
  showChosen();
}

const deed = (name, task, kind) => element("button", { type: "button", class: kind, "data-needs": "operator", onclick: acting(async () => { await task(); await load(); }) }, name);

function showChosen() {
  const row = windows.find((one) => one.id === chosen);
  if (!row) {
    show("selected", element("p", { class: "hint" }, "Choose a window on the timeline or in the list."));
    return;
  }
  const path = `windows/${row.id}`;
  const deeds = {
    draft: [deed("Approve", () => send("PATCH", path, { state: "approved" }), "primary"), deed("Delete", () => send("DELETE", path))],
    approved: [deed("Uplink", () => uplink(row), "primary"), deed("Back to draft", () => send("PATCH", path, { state: "draft" }))],
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
    element("p", { class: "actions" }, deeds),
  );
}

async function uplink(row) {
  const released = await send("POST", `windows/${row.id}/uplink`);
  notice(`${row.name}: ${released.items.length} telecommands released`);
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
  contacts = found.contacts;
  showAll();
  const refused = Object.entries(found.refused).map(([reason, count]) => `${count} ${reason.replaceAll("_", " ")}`).join(", ");
  show(
    "candidates",
    element("p", { class: "hint" }, `${candidates.length} candidates${refused ? `; left out: ${refused}` : ""}. Data: ${found.data.join(", ") || "built in"}.`),
    table(
      "Candidates",
      [
        ["Start", (row) => timeText(row.start)],
        ["Length", (row) => lengthText(seconds(row.stop) - seconds(row.start)), "num"],
        ["Frames", (row) => figure(row.frames), "num"],
        ["Altitude, km", (row) => `${figure(row.altitude_km.min)} to ${figure(row.altitude_km.max)}`, "num"],
        ["Sun, deg", (row) => `${figure(row.sun_elevation_deg.min)} to ${figure(row.sun_elevation_deg.max)}`, "num"],
        ["Craters a frame", (row) => (row.craters_per_frame ? `${figure(row.craters_per_frame.min)} to ${figure(row.craters_per_frame.max)}` : "–"), "num"],
        ["Battery left", (row) => `${Math.round(100 * row.battery_minimum)} %`, "num"],
        ["Data down by", (row) => (row.downlinked_by ? timeText(row.downlinked_by) : "not within the span")],
        ["", (row) => element("button", { type: "button", "data-needs": "operator", onclick: acting(() => plan(row)) }, "Plan")],
      ],
      candidates,
      "No span fulfils all constraints.",
    ),
  );
}

async function load() {
  windows = (await get("windows", { limit: 500 })).items;
  drawTimeline();
  showChosen();
  show(
    "windows",
    table(
      "Windows",
      [
        ["Window", (row) => element("button", { type: "button", class: "link", onclick: () => choose(row.id) }, row.name)],
        ["Start", (row) => timeText(row.start)],
        ["Length", (row) => lengthText(seconds(row.stop) - seconds(row.start)), "num"],
        ["State", (row) => stateMark(row.state)],
        ["By", (row) => row.created_by],
      ],
      windows,
      "No window planned: find some above.",
    ),
  );
}

const zoom = (factor, shift = 0) => () => {
  const half = ((view[1] - view[0]) / 2) * factor;
  const middle = (view[0] + view[1]) / 2 + shift * half;
  view = [middle - half, middle + half];
  viewChosen = true;
  state({ view: view.map(isoText).join("~") });
  drawTimeline();
  soonContacts();
};

function showAll() {
  viewChosen = false;
  state({ view: null });
  drawTimeline();
  soonContacts();
}

// Contacts of the links in the shown time; they are predicted for at most a month.
const CONTACTS_S = 31 * DAY_S;
let contactsPending = null;
let contactsOf = false; // contacts of a view have been asked for
function soonContacts() {
  clearTimeout(contactsPending);
  contactsPending = setTimeout(() => loadContacts().catch(trouble), 300);
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
    table(
      "Contacts",
      [
        ["Link", (row) => row.link],
        ["Station", (row) => row.station],
        ["Spacecraft", (row) => String(row.spacecraft_id), "num"],
        ["Start", (row) => timeText(row.start)],
        ["Stop", (row) => timeText(row.stop)],
        ["State", (row) => stateMark(row.state)],
        ["Telecommands", (row) => figure(row.telecommands), "num"],
        ["Octets", (row) => figure(row.octets), "num"],
        ["Reason", (row) => row.reason ?? ""],
      ],
      linked,
      "No contact of a link in the shown time.",
    ),
  );
}
byId("earlier").addEventListener("click", zoom(1, -1));
byId("later").addEventListener("click", zoom(1, 1));
byId("nearer").addEventListener("click", zoom(0.5));
byId("farther").addEventListener("click", zoom(2));
byId("whole").addEventListener("click", showAll);
byId("search").addEventListener("submit", acting(search));
byId("export").addEventListener(
  "click",
  acting(async () => {
    const body = await (await request("plan")).blob();
    element("a", { href: URL.createObjectURL(body), download: "linna-plan.json" }).click();
  }),
);
byId("import").addEventListener(
  "change",
  acting(async () => {
    const made = await send("POST", "plan", JSON.parse(await byId("import").files[0].text()));
    notice(`${Object.keys(made.windows).length} windows of the plan are here`);
    await load();
  }),
);
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
  const camera = mission && (await get(`missions/${mission.revision.slice(0, 16)}`)).document.camera;
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
  byId("ephemeris").addEventListener("change", () => {
    showSpan();
    showAll();
  });
  byId("spacecraft").addEventListener("change", acting(() => Promise.all([showDaylight(missions), loadRequests(spacecraftChosen())])));
  const [from, to] = (stated("view") ?? "").split("~").map((text) => Date.parse(text) / 1000);
  if (from < to) [view, viewChosen] = [[from, to], true];
  await Promise.all([load(), showDaylight(missions), loadRequests(spacecraftChosen())]);
  const asked = stated("window") ?? location.hash.match(/^#window-(\d+)$/)?.[1];
  if (asked) choose(Number(asked));
  await loadContacts();
}

let pending = null;
watch(() => {
  clearTimeout(pending);
  pending = setTimeout(() => Promise.all([load(), loadRequests(spacecraftChosen())]).catch(trouble), 400);
});
start().catch((error) => error.status === 401 || trouble(error));
