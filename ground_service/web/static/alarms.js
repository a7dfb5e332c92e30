import { state, stated } from "./address.js";
import { get, send } from "./api.js";
import { chart } from "./charts.js";
import { list } from "./lists.js";
import { acting, button, buttons, byId, dictionary, element, figure, isoText, limitText, loading, missionNow, notice, on, parameterName, plural, seconds, show, showTable, table, timeText, unitText, words } from "./page.js";
import { seriesOf } from "./parameters.js";

const OPEN = ["raised", "acknowledged", "shelved"];
const HOUR_MS = 3600e3;
const nameOf = (alarm) => parameterName(alarm.name, alarm.unit);

const AROUND_S = 1800;
const parameter = (name) => dictionary.parameters.find((one) => one.name === name);

// What the packets around an alarm say: the series of its parameter with the limits, or its event reports.
async function evidence(alarm) {
  const span = { start: isoText(seconds(alarm.first) - AROUND_S), stop: isoText(seconds(alarm.last) + AROUND_S) };
  const craft = { spacecraft_id: alarm.spacecraft_id, instance: alarm.instance };
  if (alarm.source === "operations") return [element("p", {}, "A condition of the ground: see the ", element("a", { href: "/status" }, "status of the service"), ".")];
  const query = new URLSearchParams({ spacecraft: `${craft.spacecraft_id} ${craft.instance}`, ...span });
  const [{ items }, passes] = await Promise.all([get("events", { ...craft, ...span, name: alarm.source === "event" ? alarm.name : null, limit: 5 }), get("passes", { limit: 200 })]);
  const pass = passes.items.find((one) => one.spacecraft_id === alarm.spacecraft_id && seconds(one.start) <= seconds(alarm.last) && seconds(alarm.last) <= seconds(one.stop));
  const place = element("div");
  const about = alarm.source === "parameter" ? parameter(alarm.name) : null;
  if (about) {
    byId("detail").append(place); // a chart is as wide as its place
    const answer = await get(`spacecraft/${alarm.spacecraft_id}/telemetry/${encodeURIComponent(alarm.name)}`, { instance: alarm.instance, ...span, max_points: 600 });
    chart(place, nameOf(alarm), unitText(alarm.unit), [seriesOf(about, answer)]);
  }
  const limits = about && [about.warning && `warning ${limitText(about.warning)}`, about.alarm && `alarm ${limitText(about.alarm)}`].filter(Boolean).join(", ");
  return [
    element("p", {}, about ? `${about.description}: ${limits} ${unitText(alarm.unit)}. ` : `Event ${words(alarm.name)}. `, `${plural(alarm.count, "packet")} from ${timeText(alarm.first)} to ${timeText(alarm.last)}. `, pass ? element("a", { href: `/passes/${pass.id}` }, `Pass ${pass.name}`) : "No pass has this time.", " ", element("a", { href: `/events?${query}` }, "Events around it")),
    place,
    table("Event reports", ["time", ["Event", (row) => words(row.name)], "detail"], items, "No event report around it."),
  ];
}

async function showDetail(id) {
  const alarm = await get(`alarms/${id}`);
  byId("detail-section").hidden = false;
  state({ alarm: id });
  byId("detail-title").textContent = `Alarm ${id}: ${nameOf(alarm)}`;
  show("procedure", alarm.procedure ?? "The mission description states no procedure for this alarm (procedures).");
  showTable("history", "History", ["time", ["By", "actor"], "change", "comment"], alarm.history, "None.");
  show("detail", await evidence(alarm));
}

const comment = () => ({ comment: byId("comment").value.trim() });
const change = (path, id, body) => async () => {
  await send("POST", `alarms/${id}/${path}`, { ...comment(), ...body });
  await reload();
  if (!byId("detail-section").hidden) await showDetail(id);
};

async function acknowledgeChosen() {
  const ids = [...byId("alarms").querySelectorAll("input:checked")].map((box) => box.value);
  if (!ids.length) throw new Error("Choose raised alarms in the table.");
  try {
    for (const id of ids) await send("POST", `alarms/${id}/acknowledge`, comment());
    notice(`${plural(ids.length, "alarm")} acknowledged`);
  } finally {
    await reload();
  }
}

function actions(alarm) {
  const act = (label, task, needs) => button(label, task, { needs, name: `${label} alarm ${alarm.id}` });
  const until = (hours) => new Date(1000 * missionNow() + hours * HOUR_MS).toISOString();
  return buttons(
    alarm.state === "raised" ? act("Acknowledge", change("acknowledge", alarm.id, {})) : null,
    alarm.state === "shelved" ? act("Unshelve", change("shelve", alarm.id, { until: until(-1) })) : null,
    ["raised", "acknowledged"].includes(alarm.state) ? act("Shelve 8 h", change("shelve", alarm.id, { until: until(8) })) : null,
    act("Detail", () => showDetail(alarm.id), null),
  );
}

function restoreFilters() {
  for (const [id, usual] of [["state", "open"], ["severity", ""]]) byId(id).value = stated(id) === "any" ? "" : (stated(id) ?? usual);
}

const chosenBox = (row) => element("input", { type: "checkbox", value: row.id, "data-needs": "operator", "aria-label": `choose alarm ${row.id}` });
const reload = list("/alarms", {
  place: "alarms",
  columns: [
    ["", (row) => (row.state === "raised" ? chosenBox(row) : "")],
    ["Alarm", nameOf, "keep"],
    ["", actions],
    "severity",
    "state",
    ["Condition", (row) => `${row.active ? "continues" : "has ended"}${row.acknowledged_by ? `, acknowledged by ${row.acknowledged_by}, ${timeText(row.acknowledged)}` : ""}`],
    "count",
    ["Last value", (row) => (row.value === null ? "" : `${figure(row.value)} ${unitText(row.unit)}, limits ${row.limits}`)],
    "first",
    "last",
    ["Spacecraft", (row) => `${row.spacecraft_id}, ${row.instance}`],
  ],
  query: () => ({ state: byId("state").value === "open" ? OPEN : byId("state").value || null, severity: byId("severity").value || null }),
  empty: "No alarms.",
  ready: Promise.resolve().then(restoreFilters),
  concerns: (message) => message.kind === "alarm",
});

for (const name of ["state", "severity"]) {
  byId(name).addEventListener("change", acting(async () => {
    state({ [name]: byId(name).value || "any" });
    await reload.first();
  }));
}
on("acknowledge", "click", acknowledgeChosen);
if (stated("alarm")) loading(() => showDetail(stated("alarm")));
