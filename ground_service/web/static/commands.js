import { bind } from "./address.js";
import { get, send } from "./api.js";
import { acting, byId, dictionary, element, notice, pager, show, stateMark, table, timeText, trouble, watch } from "./page.js";

const words = (name) => name.replaceAll("_", " ");
const definition = Object.fromEntries(dictionary.telecommands.map((one) => [one.name, one]));
const STAGES = ["accepted", "started", "completed"];

function input(field, id) {
  const labels = Object.entries(field.labels);
  const about = [field.description, field.unit && `[${field.unit}]`].filter(Boolean).join(" ");
  if (labels.length) {
    return element("label", { title: about }, words(field.name), element("select", { id }, labels.map(([, label]) => element("option", { value: label }, words(label)))));
  }
  return element(
    "label",
    { title: about },
    `${words(field.name)}${field.unit ? `, ${field.unit}` : ""}`,
    element("input", { id, type: "number", step: field.type[0] === "f" ? "any" : "1", min: field.minimum ?? (field.type[0] === "u" ? 0 : null), max: field.maximum, value: Math.max(0, field.minimum ?? 0), required: true }),
  );
}

function showArguments() {
  const chosen = definition[byId("name").value];
  byId("description").textContent = `${chosen.description.replace(/\.?$/, ".")} Service ${chosen.service}, subtype ${chosen.subtype}.${chosen.critical ? " Critical: somebody else has to release it." : ""}`;
  const fields = chosen.fields.filter((field) => field.name !== chosen.count);
  const inputs = fields.map((field) => input(field, `argument-${field.name}`));
  if (chosen.repeats.length) {
    inputs.push(
      element("label", { title: "One item a line, values in order, separated by spaces" }, `${words(chosen.group)}: ${chosen.repeats.map((field) => field.name).join(" ")}`, element("textarea", { id: "argument-items", rows: 3 })),
    );
  }
  show("arguments", inputs.length ? inputs : element("p", { class: "hint" }, "No arguments."));
}

// Arguments as words: octets of a packet by their number, items by their values, one after the other.
function plain(value) {
  if (typeof value === "number") return Number(value.toPrecision(9));
  if (!Array.isArray(value)) return value !== null && typeof value === "object" ? Object.values(value).join(" ") : value;
  if (value.length && value.every((item) => Object.keys(item).join() === "octet")) return `${value.length} octets`;
  const text = value.map((item) => plain(item)).join("; ");
  return text.length > 80 ? `${text.slice(0, 79)}…` : text;
}

// A time-tagged telecommand names its time and the telecommand that it carries, not ticks and octets.
function argumentText(row, listed) {
  const carried = row.release && listed.find((one) => one.carrier_id === row.id);
  const texts = Object.entries(row.arguments).map(([key, value]) => {
    if (key === "release_ticks" && row.release) return `release at ${timeText(row.release)} of the on-board clock`;
    if (key === "items" && carried) return `carries telecommand ${carried.id}`;
    return `${words(key)} ${plain(value)}`;
  });
  return texts.join(", ");
}

function argumentsOf(chosen) {
  const given = {};
  for (const field of chosen.fields) {
    if (field.name === chosen.count) continue;
    const { value } = byId(`argument-${field.name}`);
    given[field.name] = Object.keys(field.labels).length ? value : Number(value);
  }
  if (chosen.repeats.length) {
    const lines = byId("argument-items").value.split("\n").filter((line) => line.trim());
    given[chosen.group] = lines.map((line) => {
      const values = line.trim().split(/\s+/);
      return Object.fromEntries(chosen.repeats.map((field, index) => [field.name, Number(values[index])]));
    });
  }
  return given;
}

function lights(command) {
  const reached = new Set(command.reports.map((report) => report.stage));
  const bad = command.timed_out || command.state === "failed";
  const text = [...STAGES.filter((stage) => reached.has(stage)), bad ? command.remark : null].filter(Boolean).join(", ") || "no report yet";
  return element(
    "span",
    { class: "lights", role: "img", "aria-label": text, title: text },
    STAGES.map((stage) => element("span", { class: `light${reached.has(stage) ? " on" : bad ? " bad" : ""}` })),
    element("span", { class: "after" }, command.remark),
  );
}

const act = (command, deed, json) =>
  acting(async () => {
    await send("POST", `telecommands/${command.id}/${deed}`, json);
    await load();
  });

function deeds(command) {
  if (command.state !== "queued") return "";
  return element(
    "span",
    { class: "actions" },
    element("button", { type: "button", "data-needs": "operator", onclick: act(command, "release") }, "Release"),
    element("button", { type: "button", "data-needs": "operator", onclick: act(command, "reject", { reason: "rejected on the page" }) }, "Reject"),
  );
}

async function loadLinks() {
  const { items } = await get("links");
  const sending = (row) =>
    acting(async () => {
      await send("POST", `links/${encodeURIComponent(row.name)}/send`);
      notice(`Link ${row.name} sends what is released.`);
      await loadLinks();
    });
  await loadReceivers(items);
  show(
    "links",
    table(
      "Links",
      [
        ["Link", (row) => row.name],
        ["Spacecraft", (row) => `${row.spacecraft_id}, ${row.instance}`],
        ["Station", (row) => row.station ?? "not stated"],
        ["State", (row) => stateMark(row.state)],
        ["Reason", (row) => row.reason ?? ""],
        ["Last reception", (row) => (row.heard ? timeText(row.heard) : "none")],
        ["Sends", (row) => (row.send === "automatic" ? "in each contact" : "on request")],
        ["Waiting", (row) => String(row.unsent), "num"],
        ["", (row) => element("button", { type: "button", "data-needs": "operator", disabled: row.unsent === 0, onclick: sending(row) }, "Send now")],
      ],
      items,
      "No mission description in force declares a link. Without one, linna command uplink writes the octets to a file.",
    ),
  );
}

// State of the telecommand receiver of each linked spacecraft, by its newest telemetry.
const FLAGS = ["no_rf_available", "no_bit_lock", "lockout", "wait", "retransmit"];
async function loadReceivers(links) {
  const spacecraft = [...new Map(links.map((one) => [`${one.spacecraft_id} ${one.instance}`, one])).values()];
  const answers = await Promise.all(spacecraft.map((one) => get(`spacecraft/${one.spacecraft_id}/uplink`, { instance: one.instance }).catch(() => null)));
  const channels = answers.filter(Boolean).flatMap((one) => one.channels.map((channel) => ({ ...channel, spacecraft: `${one.spacecraft_id}, ${one.instance}` })));
  show(
    "receivers",
    table(
      "Receivers",
      [
        ["Spacecraft", (row) => row.spacecraft],
        ["Channel", (row) => String(row.virtual_channel), "num"],
        ["State", (row) => FLAGS.filter((flag) => row[flag]).map(words).join(", ") || "ready"],
        ["Next frame", (row) => String(row.report_value), "num"],
        ["Frames seen", (row) => String(row.frames), "num"],
        ["Received", (row) => timeText(row.received)],
      ],
      channels,
      "No telemetry with the state of a telecommand receiver.",
    ),
  );
}

const load = pager(async (limit, offset) => {
  const page = await get("telecommands", { limit, offset, state: byId("state").value || null });
  show(
    "commands",
    table(
      "Telecommands",
      [
        ["No", (row) => String(row.id), "num"],
        ["Telecommand", (row) => element("span", {}, words(row.name), row.critical ? element("b", { class: "critical" }, " critical") : null)],
        ["State", (row) => stateMark(row.state)],
        ["Verification", lights],
        ["Arguments", (row) => argumentText(row, page.items)],
        ["Entered", (row) => `${timeText(row.requested)} by ${row.requested_by}`],
        ["Decided", (row) => (row.decided_by ? `${timeText(row.decided)} by ${row.decided_by}` : "")],
        ["Sent", (row) => (row.sent ? timeText(row.sent) : "")],
        ["", deeds],
      ],
      page.items,
      byId("state").value ? "No telecommand in this state." : "No telecommand yet.",
    ),
  );
  return page;
});

show("name", dictionary.telecommands.map((one) => element("option", { value: one.name }, words(one.name))));
byId("name").value = "test_connection";
bind("name", "state");
byId("state").addEventListener("change", acting(() => load.first()));
byId("name").addEventListener("change", showArguments);
showArguments();
byId("enter").addEventListener(
  "submit",
  acting(async () => {
    const chosen = definition[byId("name").value];
    const made = await send("POST", "telecommands", {
      name: chosen.name,
      arguments: argumentsOf(chosen),
      spacecraft_id: byId("spacecraft").valueAsNumber,
      instance: byId("instance").value,
      timeout_s: byId("timeout").valueAsNumber,
    });
    notice(`${words(made.name)} is queued as number ${made.id}`);
    await load();
  }),
);

let pending = null;
watch(() => {
  clearTimeout(pending);
  pending = setTimeout(() => Promise.all([load(), loadLinks()]).catch(trouble), 300);
}, () => Promise.all([load(), loadLinks()]));
loadLinks().catch((error) => error.status === 401 || trouble(error));
load().catch((error) => error.status === 401 || trouble(error));
