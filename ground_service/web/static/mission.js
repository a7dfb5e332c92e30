import { get } from "./api.js";
import { byId, element, figure, show, table, timeText, trouble } from "./page.js";

const revision = location.pathname.split("/").at(-1);
const FIRST = ["requirements", "approval", "frames"];
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

async function load() {
  const found = await get(`missions/${revision}`);
  document.title = `${found.mission} · LINNA`;
  document.querySelector("h1").textContent = found.mission;
  byId("entered").replaceChildren(
    `Spacecraft ${found.spacecraft_id ?? "not stated"}, entered ${timeText(found.entered)} by ${found.entered_by}, revision `,
    element("code", { class: "breakable" }, found.revision),
  );
  show("limits", values("Limits of the verdict", found.document.requirements));
  show("approval", values("Approval", found.document.approval));
  show("frames", values("Reference frames and gravity", found.document.frames));
  show(
    "other",
    Object.entries(found.document)
      .filter(([key, value]) => !FIRST.includes(key) && value !== null && typeof value === "object")
      .map(([key, value]) => element("details", {}, element("summary", {}, words(key)), values(words(key), value))),
  );
  show(
    "unknown",
    found.unknown.length
      ? element("ul", { class: "plain" }, found.unknown.map((one) => element("li", {}, element("code", {}, one))))
      : element("p", { class: "hint" }, "Every value is stated."),
  );
  byId("document").textContent = found.text;
}

load().catch((error) => error.status === 401 || trouble(error));
