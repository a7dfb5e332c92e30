import { get, request } from "./api.js";
import { acting, byId, confirmed, element, figure, mayOperate, session, show, table, timeText, trouble } from "./page.js";

const revision = location.pathname.split("/").at(-1);
const TYPED_MS = 400;
const words = (name) => name.replaceAll("_", " ");
// Names end in their unit: "median error, m" for median_error_m.
const UNITS = { m: "m", km: "km", s: "s", deg: "°", px: "px", percent: "%", mib: "MiB", c: "°C", days: "days" };
const labelled = (name) => {
  const [, stem, unit] = name.match(/^(.+)_([a-z]+)$/) ?? [];
  return UNITS[unit] ? `${words(stem)}, ${UNITS[unit]}` : words(name);
};

function text(value) {
  if (value === null || value === undefined) return "not stated";
  if (Array.isArray(value)) return value.length ? value.map(text).join(", ") : "none";
  if (typeof value === "boolean") return value ? "yes" : "no";
  if (typeof value === "object") return Object.entries(value).map(([key, one]) => `${key}: ${text(one)}`).join(", ");
  return typeof value === "number" ? figure(value, 12) : value;
}

function values(caption, section) {
  return table(
    caption,
    [
      ["Value", ([key]) => labelled(key)],
      ["Stated", ([, value]) => (value === null ? element("span", { class: "hint" }, "not stated") : text(value))],
    ],
    Object.entries(section),
    "Nothing.",
  );
}

const codes = (lines) => element("ul", { class: "plain" }, lines.map((one) => element("li", {}, element("code", { class: "breakable" }, one))));

const showUnknown = (unknown) => show("unknown", unknown.length ? codes(unknown) : element("p", { class: "hint" }, "Every value is stated."));

const changes = (lines) => element("pre", { tabindex: "0", "aria-label": "difference to the revision in force" }, lines.join("\n"));

async function post(path) {
  const headers = { "Content-Type": "application/octet-stream" };
  return (await request(path, { method: "POST", body: byId("document").value, headers })).json();
}

// Check the text in the editor; a check that a later one has overtaken shows nothing.
let asked = 0;
async function check() {
  const number = ++asked;
  const found = await post("missions/check");
  if (number !== asked) return found;
  const same = element("p", { class: "hint" }, "Nothing differs from the revision in force.");
  show("faults", found.faults.length ? codes(found.faults) : found.changes.length ? changes(found.changes) : same);
  byId("faults").classList.toggle("bad", found.faults.length > 0);
  byId("enter").disabled = found.faults.length > 0 || !found.changes.length;
  if (!found.faults.length) showUnknown(found.unknown);
  return found;
}

async function enter() {
  const found = await check();
  if (found.faults.length || !(await confirmed("Enter this mission description?", [changes(found.changes)], "Enter"))) return;
  location.assign(`/missions/${(await post("missions")).revision.slice(0, 16)}`);
}

let typed = 0;
byId("document").addEventListener("input", () => {
  clearTimeout(typed);
  typed = setTimeout(() => check().catch(trouble), TYPED_MS);
});
byId("editor").addEventListener("submit", acting(enter));

async function load() {
  await session;
  byId("document").readOnly = byId("enter").hidden = !mayOperate();
  byId("enter").disabled = true;
  byId("read").hidden = revision === "new";
  if (revision === "new") return;
  const found = await get(`missions/${revision}`);
  document.title = `${found.mission} · LINNA`;
  document.querySelector("h1").textContent = found.mission;
  byId("entered").replaceChildren(
    `Spacecraft ${found.spacecraft_id ?? "not stated"}, entered ${timeText(found.entered)} by ${found.entered_by}, revision `,
    element("code", { class: "breakable" }, found.revision),
  );
  show(
    "sections",
    Object.entries(found.document)
      .filter(([, value]) => value !== null && typeof value === "object")
      .map(([key, value]) => element("details", { open: key === "requirements" }, element("summary", {}, words(key)), values(words(key), value))),
  );
  showUnknown(found.unknown);
  byId("document").value = found.text;
}

load().catch((error) => error.status === 401 || trouble(error));
