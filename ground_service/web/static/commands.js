import { bind } from "./address.js";
import { get, send } from "./api.js";
import { order } from "./chain.js";
import { control } from "./forms.js";
import { list } from "./lists.js";
import { button, buttons, byId, dictionary, element, figure, inTurn, loading, notice, on, show, showTable, timeText, words } from "./page.js";

const definition = Object.fromEntries(dictionary.telecommands.map((one) => [one.name, one]));
const STAGES = ["accepted", "started", "completed"];

// A field of the dictionary as an input with its unit, range and names.
function input(field) {
  const labels = Object.values(field.labels);
  const range = field.minimum !== null && field.maximum !== null ? `${figure(field.minimum)} to ${figure(field.maximum)}` : null;
  const unit = field.unit.replaceAll("/", "_");
  const name = field.name.replace(/_id$/, "").replace(unit && new RegExp(`_${unit}$`), "");
  return control({
    id: `argument-${field.name}`,
    name: field.name,
    label: `${words(name)}${field.unit ? `, ${field.unit}` : ""}${range ? ` (${range})` : ""}`,
    title: [field.description, field.unit && `[${field.unit}]`, range].filter(Boolean).join(", "),
    ...(labels.length
      ? { options: labels.map((label) => [label, words(label)]) }
      : { type: "number", step: field.type[0] === "f" ? "any" : "1", min: field.minimum ?? (field.type[0] === "u" ? 0 : null), max: field.maximum, value: field.default ?? Math.max(0, field.minimum ?? 0), required: true }),
  });
}

// Fields to enter: a function has its own in place of numbers, and a parameter its unit and range.
function fieldsOf(chosen, value) {
  const parameters = dictionary.onboard_parameters;
  const parameter = parameters.find((one) => one.name === value) ?? parameters[0];
  const own = { parameter_id: { labels: Object.fromEntries(parameters.map((one) => [one.number, one.name])) }, ...(chosen.fields.some((one) => one.name === "parameter_id") && { value: parameter }) };
  const functions = chosen.fields.find((one) => one.name === "function_id");
  if (functions) return [functions, ...(dictionary.functions[value ?? functions.labels[1]] ?? [])];
  return chosen.fields.filter((field) => field.name !== chosen.group?.count).map((field) => ({ ...field, ...own[field.name], name: field.name }));
}

function showArguments(value = null) {
  const chosen = definition[byId("name").value];
  byId("description").textContent = `${chosen.description.replace(/\.?$/, ".")} Service ${chosen.service}, subtype ${chosen.subtype}.${chosen.critical ? " Critical: somebody else has to release it." : ""}`;
  const inputs = fieldsOf(chosen, value).map(input);
  if (chosen.group) {
    inputs.push(
      element("label", { title: "One item a line, values in order, separated by spaces" }, `${words(chosen.group.name)}: ${chosen.group.fields.map((field) => field.name).join(" ")}`, element("textarea", { id: "argument-items", rows: 3 })),
    );
  }
  show("arguments", inputs.length ? inputs : element("p", { class: "hint" }, "No arguments."));
  const deciding = ["function_id", "parameter_id"].map((name) => byId(`argument-${name}`)).find(Boolean);
  if (!deciding) return;
  if (value !== null) deciding.value = value;
  deciding.addEventListener("change", () => showArguments(deciding.value));
}

function argumentsOf(chosen) {
  const given = Object.fromEntries([...byId("arguments").querySelectorAll("select, input")].map((one) => [one.name, one.type === "number" ? one.valueAsNumber : one.value]));
  if (chosen.group) {
    const lines = byId("argument-items").value.split("\n").filter((line) => line.trim());
    given[chosen.group.name] = lines.map((line) => {
      const values = line.trim().split(/\s+/);
      return Object.fromEntries(chosen.group.fields.map((field, index) => [field.name, Number(values[index])]));
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

const act = (label, command, json) =>
  button(label, async () => {
    await send("POST", `telecommands/${command.id}/${label.toLowerCase()}`, json);
    await load();
  });

const deeds = (command) => (command.state === "queued" ? buttons(act("Release", command), act("Reject", command, { reason: "rejected on the page" })) : "");

const loadLinks = inTurn(async () => {
  const { items } = await get("links");
  await loadReceivers(items);
  const sendNow = (row) => button("Send now", () => order(row).then(loadLinks), { disabled: row.unsent === 0 });
  showTable(
    "links",
    "Links",
    [
      ["Link", "name", "keep"],
      ["", sendNow],
      ["Waiting", "unsent"],
      "state",
      ["Spacecraft", (row) => `${row.spacecraft_id}, ${row.instance}`],
      ["Station", (row) => row.station ?? "not stated"],
      "reason",
      ["Last reception", (row) => (row.heard ? timeText(row.heard) : "none")],
      ["Sends", (row) => (row.send === "automatic" ? "in each contact" : "on request")],
    ],
    items,
    "No mission description in force declares a link. Without one, linna command uplink writes the octets to a file.",
  );
});

// State of the telecommand receiver of each linked spacecraft, by its newest telemetry.
const FLAGS = ["no_rf_available", "no_bit_lock", "lockout", "wait", "retransmit"];
async function loadReceivers(links) {
  const spacecraft = [...new Map(links.map((one) => [`${one.spacecraft_id} ${one.instance}`, one])).values()];
  const answers = await Promise.all(spacecraft.map((one) => get(`spacecraft/${one.spacecraft_id}/uplink`, { instance: one.instance }).catch(() => null)));
  const channels = answers.filter(Boolean).flatMap((one) => one.channels.map((channel) => ({ ...channel, spacecraft: `${one.spacecraft_id}, ${one.instance}` })));
  const flags = (row) => FLAGS.filter((flag) => row[flag]).map(words).join(", ") || "ready";
  const columns = ["spacecraft", ["Channel", "virtual_channel"], ["State", flags], ["Next frame", "report_value"], ["Frames seen", "frames"], "received"];
  showTable("receivers", "Receivers", columns, channels, "No telemetry with the state of a telecommand receiver.");
}

const load = list("/telecommands", {
  place: "commands",
  columns: [
    "id",
    ["Telecommand", (row) => element("span", {}, words(row.name), row.critical ? element("b", { class: "critical" }, " critical") : null)],
    "state",
    ["", deeds],
    ["Verification", lights],
    ["Arguments", "text"],
    ["Entered", (row) => `${timeText(row.requested)} by ${row.requested_by}`],
    ["Decided", (row) => (row.decided_by ? `${timeText(row.decided)} by ${row.decided_by}` : "")],
    "sent",
  ],
  query: () => ({ state: byId("state").value || null }),
  empty: () => (byId("state").value ? "No telecommand in this state." : "No telecommand yet."),
  concerns: () => true,
});

show("name", dictionary.telecommands.map((one) => element("option", { value: one.name }, words(one.name))));
byId("name").value = "test_connection";
bind("name", "state");
on("state", "change", () => load.first());
byId("name").addEventListener("change", () => showArguments());
showArguments();
on("enter", "submit", async () => {
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
});

loading(loadLinks, () => true);
