import { get, request } from "./api.js";
import { entered, property } from "./forms.js";
import { acting, button, buttons, byId, confirmed, element, figure, labelled, loading, mayOperate, on, plural, schemas, session, show, table, timeText, trouble, words } from "./page.js";
import { tables, without, written } from "./toml.js";

const revision = location.pathname.split("/").at(-1);
const TYPED_MS = 400;
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

const reasons = (lines) => element("ul", { class: "reasons" }, lines.map((one) => element("li", {}, one)));

const showUnknown = (unknown) => show("unknown", unknown.length ? codes(unknown) : element("p", { class: "hint" }, "Every value is stated."));

const changes = (lines) => element("pre", { tabindex: "0", "aria-label": "difference to the revision in force" }, lines.join("\n"));

// Links and stations as forms. The text is the truth: a form reads a table of it and writes it back.
const STATION = "link.stations.";
const quoted = (name) => (/^[\w-]+$/.test(name) ? name : JSON.stringify(name));
const PARTS = {
  link: {
    caption: "Links",
    schema: schemas.StationConnection,
    shown: ["name", "kind", "station", "downlink", "uplink", "send"],
    isOne: ({ header }) => header === "links",
    valuesOf: ({ values }) => values,
    header: () => "[[links]]",
    inline: /^\s*links\s*=/m,
  },
  station: {
    caption: "Stations",
    schema: { properties: { name: { type: "string", maxLength: 64 }, ...schemas.StationLink.properties }, required: ["name"] },
    shown: ["name", "latitude_deg", "longitude_deg", "height_m", "minimum_elevation_deg"],
    isOne: ({ header }) => header.startsWith(STATION),
    valuesOf: ({ header, values }) => ({ name: header.slice(STATION.length).replace(/^["'](.*)["']$/, "$1"), ...values }),
    header: ({ name }) => `[${STATION}${quoted(name)}]`,
    inline: /^\s*stations\s*=/m,
  },
};

const stated = (part) => tables(byId("document").value).filter(part.isOne).map((one) => ({ table: one, ...part.valuesOf(one) }));

function change(text) {
  byId("document").value = text;
  showParts();
  check().catch(trouble);
}

function edit(kind, row = null) {
  const part = PARTS[kind];
  const { properties, required } = part.schema;
  const fields = kind === "link" ? { ...properties, station: { enum: stated(PARTS.station).map(({ name }) => name) } } : properties;
  const write = () => {
    const { name, ...values } = entered(byId("part"), fields);
    const text = byId("document").value;
    change(written(text, row?.table, row?.name === name ? null : part.header({ name }), kind === "link" ? { name, ...values } : values));
  };
  show(
    "part",
    element("h3", {}, row ? `Change ${kind} ${row.name}` : `Add a ${kind}`),
    element(
      "form",
      { onsubmit: acting(write) },
      element("div", { class: "row" }, Object.entries(fields).map(([name, schema]) => property(`part-${name}`, name, schema, { required: required.includes(name), value: row?.[name] }))),
      element("p", { class: "actions" }, element("button", { class: "primary" }, "Write into the text"), button("Cancel", () => show("part"))),
    ),
  );
  byId("part").querySelector("input").focus();
}

function showParts() {
  show("part");
  const act = (label, kind, row, deed) => button(label, deed, { name: `${label} ${kind} ${row.name}` });
  for (const [kind, part] of Object.entries(PARTS)) {
    const rows = stated(part);
    const [first, ...others] = part.shown;
    const changes = (row) => buttons(act("Change", kind, row, () => edit(kind, row)), act("Remove", kind, row, () => change(without(byId("document").value, row.table))));
    const cell = (name) => [labelled(name), (row) => (typeof row[name] === "number" ? figure(row[name], 8) : row[name])];
    const elsewhere = !rows.length && part.inline.test(byId("document").value);
    show(
      `${kind}s`,
      table(part.caption, [cell(first), ["", changes], ...others.map(cell)], rows, elsewhere ? "Stated as an inline table: change it in the text." : "None stated."),
      element("p", {}, button(`Add a ${kind}`, () => edit(kind))),
    );
  }
}

// What the planner would do with the text: windows, or what excludes all of them.
async function dryRun() {
  const { faults, windows, contradictions } = await post("missions/check?plan=true");
  if (faults.length) return show("flight", element("p", { class: "hint" }, "The text has faults: it cannot be planned."));
  show(
    "flight",
    element("p", {}, element("strong", {}, plural(windows.length, "window")), contradictions.length ? ", and what contradicts the flight:" : ", nothing contradicts the flight."),
    contradictions.length ? reasons(contradictions) : null,
    windows.length ? table("Windows of the dry run", [["Start", "0"], ["Stop", "1"]], windows, "") : null,
  );
}

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
  show("faults", found.faults.length ? reasons(found.faults) : found.changes.length ? changes(found.changes) : same);
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
  typed = setTimeout(() => {
    showParts();
    check().catch(trouble);
  }, TYPED_MS);
});
on("dry-run", "click", dryRun);
on("editor", "submit", enter);

async function load() {
  await session;
  byId("document").readOnly = byId("enter").hidden = !mayOperate();
  byId("enter").disabled = true;
  byId("read").hidden = revision === "new";
  if (revision === "new") return showParts();
  const description = await get(`missions/${revision}`);
  document.title = `${description.mission} · LINNA`;
  document.querySelector("h1").textContent = description.mission;
  byId("entered").replaceChildren(
    `Spacecraft ${description.spacecraft_id ?? "not stated"}, entered ${timeText(description.entered)} by ${description.entered_by}, revision `,
    element("code", { class: "breakable" }, description.revision),
  );
  show(
    "sections",
    Object.entries(description.document)
      .filter(([, value]) => value !== null && typeof value === "object")
      .map(([key, value]) => element("details", { open: key === "requirements" }, element("summary", {}, words(key)), values(words(key), value))),
  );
  showUnknown(description.unknown);
  byId("document").value = description.text;
  showParts();
}

loading(load);
