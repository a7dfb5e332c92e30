import { state, stated } from "./address.js";
import { get, send } from "./api.js";
import { acting, byId, element, figure, pager, parameterName, show, stateMark, table, timeText, trouble, unitText, watch } from "./page.js";

const OPEN = ["raised", "acknowledged", "shelved"];
const HOUR_MS = 3600e3;
const nameOf = (alarm) => parameterName(alarm.name, alarm.unit);

async function showHistory(id) {
  const alarm = await get(`alarms/${id}`);
  byId("history-section").hidden = false;
  state({ alarm: id });
  byId("history-title").textContent = `History of alarm ${id}: ${nameOf(alarm)}`;
  show(
    "history",
    table(
      "History",
      [["Time", (row) => timeText(row.time)], ["By", (row) => row.actor], ["Change", (row) => row.change], ["Comment", (row) => row.comment]],
      alarm.history,
      "None.",
    ),
  );
}

const change = (path, id, body) => acting(async () => {
  await send("POST", `alarms/${id}/${path}`, body);
  await reload();
  if (!byId("history-section").hidden) await showHistory(id);
});

function actions(alarm) {
  const button = (label, listener) => element("button", { type: "button", onclick: listener, "data-needs": label === "History" ? null : "operator", "aria-label": `${label} alarm ${alarm.id}` }, label);
  const until = (hours) => new Date(Date.now() + hours * HOUR_MS).toISOString();
  return element(
    "span",
    { class: "actions" },
    alarm.state === "raised" ? button("Acknowledge", change("acknowledge", alarm.id, {})) : null,
    alarm.state === "shelved" ? button("Unshelve", change("shelve", alarm.id, { until: until(-1) })) : null,
    ["raised", "acknowledged"].includes(alarm.state) ? button("Shelve 8 h", change("shelve", alarm.id, { until: until(8) })) : null,
    button("History", acting(() => showHistory(alarm.id))),
  );
}

const reload = pager(async (limit, offset) => {
  const chosen = byId("state").value;
  const page = await get("alarms", { limit, offset, state: chosen === "open" ? OPEN : chosen || null, severity: byId("severity").value || null });
  show(
    "alarms",
    table(
      "Alarms",
      [
        ["Alarm", nameOf],
        ["Severity", (row) => stateMark(row.severity)],
        ["State", (row) => stateMark(row.state)],
        ["Condition", (row) => (row.active ? "continues" : "has ended")],
        ["Count", (row) => figure(row.count), "num"],
        ["Last value", (row) => (row.value === null ? "" : `${figure(row.value)} ${unitText(row.unit)}, limits ${row.limits}`)],
        ["First", (row) => timeText(row.first)],
        ["Last", (row) => timeText(row.last)],
        ["Spacecraft", (row) => `${row.spacecraft_id}, ${row.instance}`],
        ["Acknowledged", (row) => (row.acknowledged_by ? `${row.acknowledged_by}, ${timeText(row.acknowledged)}` : "")],
        ["", actions],
      ],
      page.items,
      "No alarms.",
    ),
  );
  return page;
});

for (const name of ["state", "severity"]) {
  byId(name).addEventListener("change", acting(async () => {
    state({ [name]: byId(name).value || "any" });
    await reload.first();
  }));
}
watch((message) => message.kind === "alarm" && reload().catch(trouble), reload);
byId("state").value = stated("state") === "any" ? "" : (stated("state") ?? "open");
byId("severity").value = stated("severity") === "any" ? "" : (stated("severity") ?? "");
reload().catch((error) => error.status === 401 || trouble(error));
if (stated("alarm")) showHistory(stated("alarm")).catch((error) => error.status === 401 || trouble(error));
