// What every page shares: elements, tables, notices, sign-in, clock.
import { state, stated } from "./address.js";
import { follow, get, send } from "./api.js";
import { parameterName, unitText } from "./units.js";

export { parameterName, unitText };

// Labels are pairs of code and name in the dictionary.
const embedded = (id) => JSON.parse(document.getElementById(id).textContent, (key, value) => (key === "labels" && Array.isArray(value) ? Object.fromEntries(value) : value));
export const dictionary = embedded("dictionary");
export const schemas = embedded("schemas"); // of what the page lists and enters

export const byId = (id) => document.getElementById(id);

// A date stays in one line.
const DATE = /(\d{4}-\d\d-\d\d(?:T\d\d:\d\d)?)/;
const unbroken = (child) => (typeof child === "string" ? child.split(DATE).map((part, index) => (index % 2 ? element("span", { class: "keep" }, part) : part)) : child);

// element("a", {href: "/"}, "text", child...); properties that start with "on" are listeners.
export function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (value === null || value === undefined || value === false) continue;
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else made.setAttribute(key, value === true ? "" : value);
  }
  const parts = ["a", "h1", "p", "td"].includes(name) ? children.flat().flatMap(unbroken) : children.flat();
  made.append(...parts.filter((child) => child !== null && child !== undefined));
  return made;
}

const SVG = "http://www.w3.org/2000/svg";
export function svg(name, attributes = {}, ...children) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else made.setAttribute(key, value);
  }
  made.append(...children);
  return made;
}

// What the user has in hand in a place that is drawn again: keyboard focus, scroll positions, and what was typed or ticked.
const FOCUSABLE = "a[href], button, input, select, textarea, summary, [tabindex]";
const HELD = "input:not([type=radio], [type=file]), textarea";
const rowOf = (one) => one.closest("[data-row]")?.dataset.row ?? "";
const nameOf = (one) => [rowOf(one), one.tagName, one.id, one.name ?? "", one.getAttribute("aria-label") ?? one.textContent].join("\n");
// The property that the user changes, and the value with which it was made.
const heldBy = (one) => (one.type === "checkbox" ? ["checked", one.defaultChecked] : ["value", one.defaultValue]);

function inHand(place) {
  const active = document.activeElement;
  const focused = active !== place && place.contains(active) ? { name: nameOf(active), row: rowOf(active), isRow: active.matches("[data-row]") } : null;
  const scrolled = [...place.querySelectorAll(".scroll")].map((one) => [one.getAttribute("aria-label"), one.scrollLeft, one.scrollTop]);
  const changed = [...place.querySelectorAll(HELD)].map((one) => [one, ...heldBy(one)]).filter(([one, key, made]) => one[key] !== made);
  return { focused, scrolled, held: changed.map(([one, key, made]) => [nameOf(one), made, one[key]]) };
}

function giveBack(place, { focused, scrolled, held }) {
  for (const [label, left, top] of scrolled) place.querySelector(`.scroll[aria-label="${CSS.escape(label)}"]`)?.scrollTo(left, top);
  for (const one of held.length ? place.querySelectorAll(HELD) : []) {
    const [key, made] = heldBy(one);
    const kept = held.find(([name, before]) => name === nameOf(one) && before === made);
    if (kept) one[key] = kept[2];
  }
  if (!focused) return;
  const row = focused.row && [...place.querySelectorAll("[data-row]")].find((one) => one.dataset.row === focused.row);
  const same = focused.isRow ? [row].filter(Boolean) : [...place.querySelectorAll(FOCUSABLE)].filter((one) => nameOf(one) === focused.name);
  // Two controls with one name may do different things. Without the control, the next Tab continues from its row or place.
  const next = same.length === 1 ? same[0] : row || place;
  if (next.tabIndex < 0) next.tabIndex = -1;
  next.focus({ preventScroll: true });
}

export function show(id, ...children) {
  const place = typeof id === "string" ? byId(id) : id;
  const kept = inHand(place);
  place.replaceChildren(...children.flat().filter((child) => child !== null && child !== undefined));
  giveBack(place, kept);
}

// A value of an entity by the name of its field, as every table shows it.
const LINKS = { pass_id: "/passes/", window_id: "/planner?window=", revision: "/missions/" };
const STATES = ["state", "severity", "verdict", "outcome"];
const MOST = 160; // characters of an object

export const words = (name) => name.replaceAll("_", " ");

export function textOf(value) {
  if (Array.isArray(value)) return value.map(textOf).join(", ");
  if (typeof value === "object" && value !== null) return Object.entries(value).map(([key, one]) => `${words(key)} ${textOf(one)}`).join(", ");
  return typeof value === "boolean" ? (value ? "yes" : "no") : String(value);
}

export function shown(name, value) {
  if (value === null || value === undefined) return "";
  const hash = /(^|_)(sha256|revision|digest)$/.test(name) ? element("code", { title: value }, value.slice(0, 12)) : null;
  if (LINKS[name]) return element("a", { href: LINKS[name] + value }, hash ?? String(value));
  if (hash) return hash;
  if (STATES.includes(name)) return stateMark(value);
  if (typeof value === "number") return /(^|_)id$|^number$/.test(name) ? String(value) : figure(value);
  if (/^\d{4}-\d\d-\d\dT[\d:.]+Z$/.test(value)) return timeText(value);
  const text = textOf(value);
  return typeof value === "object" && text.length > MOST ? element("span", { title: text.slice(0, 2000) }, `${text.slice(0, MOST - 1)}…`) : text;
}

// Columns: the name of a field, or [heading, name of a field or row => text or node, "num" for right-aligned numbers].
export function table(caption, given, rows, empty) {
  if (!rows.length) return element("p", { class: "hint" }, empty);
  const columns = given.map((one) => {
    const [heading, cell, kind] = typeof one === "string" ? [labelled(one), one] : one;
    const named = typeof cell === "string";
    const numeric = named && rows.some((row) => typeof row[cell] === "number") ? "num" : null;
    return { heading, cell: named ? (row) => shown(cell, row[cell]) : cell, kind: kind ?? numeric };
  });
  const head = columns.map(({ heading, kind }) => element("th", { scope: "col", class: kind }, heading));
  const body = rows.map((row) =>
    element("tr", { "data-row": row.id ?? row.name ?? row.start }, columns.map(({ cell, kind }) => element("td", { class: kind }, cell(row) ?? ""))),
  );
  return element(
    "div",
    { class: "scroll", tabindex: "0", role: "group", "aria-label": caption },
    element(
      "table",
      // Many columns do not fit on a telephone: its table scrolls rather than break words.
      { class: columns.length > 4 ? "wide" : null },
      element("caption", { class: "hidden" }, caption),
      element("thead", {}, element("tr", {}, head)),
      element("tbody", {}, body),
    ),
  );
}

export const showTable = (place, ...given) => show(place, table(...given));

export function notice(text, kind = "good") {
  const shown = element(
    "p",
    { class: `notice ${kind}` },
    text,
    element("button", { type: "button", class: "quiet", "aria-label": "dismiss", onclick: () => shown.remove() }, "×"),
  );
  byId("notices").append(shown);
  if (kind === "good") setTimeout(() => shown.remove(), 8000);
}

// Ask before something leaves the service: the lines say what. Returns the deed that the person chooses, or null.
export function confirmed(title, lines, ...deeds) {
  const dialog = byId("confirm");
  byId("confirm-title").textContent = title;
  show("confirm-text", lines.map((line) => (line instanceof Node ? line : element("p", {}, line))));
  show("confirm-deeds", deeds.map((deed) => element("button", { class: deed === deeds.at(-1) ? "primary" : null, value: deed }, deed)));
  dialog.returnValue = "";
  dialog.showModal();
  return new Promise((resolve) => dialog.addEventListener("close", () => resolve(deeds.find((deed) => deed === dialog.returnValue) ?? null), { once: true }));
}

export const trouble = (error) => notice(error.message, "bad");

// A listener whose failure is shown, and which keeps its button from being pressed twice. A disabled button loses the focus.
export function acting(task) {
  return async (event) => {
    event?.preventDefault?.();
    const button = event?.submitter ?? (event?.currentTarget instanceof HTMLButtonElement ? event.currentTarget : null);
    if (button?.ariaDisabled === "true") return;
    if (button) button.ariaDisabled = "true";
    try {
      await task(event);
    } catch (error) {
      trouble(error);
    } finally {
      if (button) button.ariaDisabled = null;
    }
  };
}

// A button for operators, unless `needs` states another role or none; `name` is what it is called outside of its row.
export const button = (label, task, { name, needs = "operator", kind, disabled } = {}) =>
  element("button", { type: "button", class: kind, disabled, "data-needs": needs, "aria-label": name, onclick: acting(task) }, label);
export const buttons = (...all) => element("span", { class: "actions" }, ...all);

export const on = (id, event, task) => byId(id).addEventListener(event, acting(task));

export const seconds = (text) => (text ? Date.parse(`${text.slice(0, 23).replace(/Z$/, "")}Z`) / 1000 : NaN);
export const timeText = (text) => (text ? `${text.slice(0, 10)} ${text.slice(11, 19)}` : "");
export const isoText = (unix) => `${new Date(1000 * unix).toISOString().slice(0, 19)}Z`;

export function lengthText(totalSeconds) {
  const whole = Math.round(totalSeconds);
  const [hours, minutes, rest] = [Math.floor(whole / 3600), Math.floor((whole % 3600) / 60), whole % 60];
  if (hours >= 48) return `${Math.floor(hours / 24)} d ${hours % 24} h`;
  return hours ? `${hours} h ${minutes} min` : minutes ? `${minutes} min ${rest} s` : `${rest} s`;
}

const SUPERSCRIPTS = { "-": "⁻", ...Object.fromEntries([..."⁰¹²³⁴⁵⁶⁷⁸⁹"].map((sign, digit) => [digit, sign])) };
function powerOfTen(value, digits) {
  const [mantissa, exponent] = value.toExponential(digits - 1).split("e");
  return `${Number(mantissa)} × 10${[...exponent].map((sign) => SUPERSCRIPTS[sign]).join("")}`;
}

// A number stays in one line.
export function figure(value, digits = 3) {
  if (value === null || value === undefined || Number.isNaN(value)) return "–";
  if (typeof value !== "number") return String(value);
  if (Number.isInteger(value)) return value.toLocaleString("en").replaceAll(",", "\u00a0");
  if (Math.abs(value) < 1e-4) return powerOfTen(value, digits);
  return Math.abs(value) >= 1000 ? Math.round(value).toLocaleString("en").replaceAll(",", "\u00a0") : String(+value.toPrecision(digits));
}

// Names end in their unit: "Median error, m" for median_error_m.
const UNITS = { m: "m", km: "km", s: "s", ms: "ms", deg: "°", px: "px", percent: "%", mib: "MiB", c: "°C", bps: "bit/s", days: "days", octets: "octets" };
const NAMES = { id: "No", number: "No", sha256: "Hash" };
export function labelled(name) {
  if (NAMES[name]) return NAMES[name];
  const [, stem, unit] = name.replace(/_id$/, "").match(/^(.+)_([a-z]+)$/) ?? [];
  const text = (UNITS[unit] ? `${stem}, ${UNITS[unit]}` : name.replace(/_id$/, "")).replaceAll("_", " ");
  return text[0].toUpperCase() + text.slice(1);
}

export const plural = (count, noun) => `${figure(count)} ${noun}${count === 1 ? "" : "s"}`;

// Options of a list of parameters, in groups by packet.
export function parameterOptions(parameters) {
  const option = (one) => element("option", { value: one.name }, parameterName(one.name, one.unit));
  const packets = [...new Set(parameters.map((one) => one.packet))];
  return packets.map((packet) => element("optgroup", { label: packet }, parameters.filter((one) => one.packet === packet).map(option)));
}

export function limitText([least, greatest]) {
  if (least === null) return `above ${greatest}`;
  return greatest === null ? `below ${least}` : `outside ${least} to ${greatest}`;
}

// Name of a state as a class of the style sheet: "not met" must not be shown as "met".
export const stateClass = (state) => (state || "unknown").replaceAll(" ", "-");
export const stateMark = (state, title) => element("span", { class: `state ${stateClass(state)}`, title }, state || "unknown");

// A task that never runs beside itself, so that no older answer is shown over a newer one: calls while it runs are one more run.
export function inTurn(task) {
  let last = Promise.resolve();
  let next = null;
  const run = () => {
    next = null;
    return task();
  };
  return () => (next ??= last = last.then(run, run));
}

export function pager(load, size = 25) {
  let offset = Math.max(0, Math.floor(Number(stated("offset")) || 0));
  const fill = inTurn(async () => {
    const pressed = [byId("previous"), byId("next")].find((one) => one === document.activeElement);
    const page = await load(size, offset);
    byId("range").textContent = page.total
      ? `${offset + 1} to ${Math.min(offset + size, page.total)} of ${page.total}`
      : "none";
    const [previous, next] = [byId("previous"), byId("next")];
    previous.disabled = offset === 0;
    next.disabled = offset + size >= page.total;
    if (pressed?.disabled) (pressed === next ? previous : next).focus(); // a disabled button loses the focus
  });
  function go(to) {
    offset = Math.max(0, to);
    state({ offset: offset || null });
    return fill();
  }
  on("previous", "click", () => go(offset - size));
  on("next", "click", () => go(offset + size));
  const again = () => go(offset);
  again.first = () => go(0);
  return again;
}

// Sign-in, clock and feed of every page.
const dialog = byId("sign-in");
// Only pages of this service. The browser's own parser decides, which skips control characters in addresses.
function wantedPage() {
  const next = new URLSearchParams(location.search).get("next") ?? "";
  const wanted = new URL(next || "/", location.origin);
  if (!wanted.hash) wanted.hash = location.hash; // browsers keep it when they are sent to the sign-in
  return next.startsWith("/") && wanted.origin === location.origin ? wanted : null;
}
byId("provider")?.addEventListener("click", () => {
  const page = wantedPage() ?? location;
  byId("provider").search = new URLSearchParams({ next: page.pathname + page.search + page.hash });
});
window.addEventListener("linna-sign-in", () => {
  if (!dialog.open) dialog.showModal();
});
dialog.querySelector("[data-close]").addEventListener("click", () => dialog.close("cancel"));
dialog.addEventListener("close", async () => {
  if (dialog.returnValue !== "sign-in") return;
  const given = byId("token").value.trim();
  byId("token").value = "";
  try {
    await send("POST", "session", { token: given });
    const wanted = wantedPage();
    if (wanted) location.assign(wanted.href);
    else location.reload();
  } catch (error) {
    trouble(error);
  }
});

// Who is signed in: adapts the page to the role and returns the session.
async function signedIn() {
  const session = await get("session");
  setClock(session);
  byId("user").textContent = session.browser ? `${session.name}, ${session.role}` : "";
  byId("user").title = session.browser && session.expires ? `The session ends ${timeText(session.expires)} UTC` : "";
  byId("caller").textContent = session.browser ? "Sign out" : "Sign in";
  byId("caller").hidden = session.name === "local";
  byId("caller").dataset.signedIn = session.browser;
  byId("caller").dataset.provider = session.provider;
  document.body.dataset.role = session.role;
  return session;
}
byId("caller").addEventListener("click", async () => {
  if (byId("caller").dataset.signedIn !== "true") {
    dialog.showModal();
    return;
  }
  await send("DELETE", "session");
  if (byId("caller").dataset.provider === "true") location.assign("/sign-in/ended");
  else location.reload();
});

// Mission time: the clock of the service, which a simulated mission sets and which may then run at any speed.
const SIMULATED_MS = 60_000; // further from the clock of the browser, the time is simulated
const ASK_AGAIN_MS = 10_000;
let clock = null; // time of the service and of the browser at the last answer, and speed between the last two
const missionMs = () => (clock ? clock.time + clock.speed * (Date.now() - clock.at) : Date.now());
export const missionNow = () => missionMs() / 1000;

function setClock({ time: text, recorded }) {
  const [time, at] = [Date.parse(text), Date.now()];
  const simulated = Math.abs(time - at) > SIMULATED_MS;
  const speed = simulated && clock && at > clock.at ? (time - clock.time) / (at - clock.at) : recorded ? 0 : 1;
  // The second answer tells the speed.
  if (simulated) setTimeout(() => get("session").then(setClock, () => {}), clock ? ASK_AGAIN_MS : 1000);
  clock = { time, at, speed, simulated, recorded };
  tick();
}

function tick() {
  if (!clock) return;
  const now = new Date(missionMs()).toISOString();
  byId("clock").textContent = clock.recorded ? `data of ${now.slice(0, 10)}, recorded` : `${now.slice(0, 10)} ${now.slice(11, 19)} UTC${clock.simulated ? ", simulated" : ""}`;
  byId("clock").dateTime = now;
}
setInterval(tick, 1000);

byId("menu").addEventListener("click", () => {
  const open = byId("menu").getAttribute("aria-expanded") !== "true";
  byId("menu").setAttribute("aria-expanded", open);
});

// `again` reads the contents of a page again: no message reports changes from before the feed connected.
// A page that watches `values` gets the newest values of all spacecraft as messages.
const watchers = [];
const readers = [];
let valuesWatched = false;
export function watch(onMessage, again = null, { values = false } = {}) {
  watchers.push(onMessage);
  valuesWatched ||= values;
  if (again) readers.push(again);
}

// A task some time after the last of several messages.
export function later(task, concerns = () => true, afterMs = 400) {
  let pending = null;
  return (message) => {
    if (!concerns(message)) return;
    clearTimeout(pending);
    pending = setTimeout(() => task().catch(trouble), afterMs);
  };
}

// What fills a page: now, and again after messages that concern it.
export function loading(load, concerns = null) {
  if (concerns) watch(later(load, concerns), load);
  load().catch((error) => error.status === 401 || trouble(error));
}

// The session of the user; pages that differ by role wait for it.
export const session = signedIn();
export const mayOperate = () => ["operator", "admin"].includes(document.body.dataset.role);

// Only after a first answer: a socket that is refused tells nothing, an answer tells that a token is needed.
session
  .then(() =>
    follow(
      (message) => watchers.forEach((onMessage) => onMessage(message)),
      (connected) => {
        byId("feed-light").classList.toggle("on", connected);
        if (connected) readers.forEach((again) => Promise.resolve(again()).catch(trouble));
        byId("feed-light").setAttribute("aria-label", `live feed: ${connected ? "connected" : "not connected"}`);
      },
      valuesWatched,
    ),
  )
  .catch((error) => {
    if (error.status !== 401) trouble(error);
  });
