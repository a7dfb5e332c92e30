import { get, send } from "./api.js";
import { acting, element, pager, show, table, timeText, trouble } from "./page.js";

function outcome(row) {
  if (row.error) return row.error;
  const text = Object.entries(row.result ?? {})
    .map(([key, value]) => `${key.replaceAll("_", " ")} ${value !== null && typeof value === "object" ? JSON.stringify(value) : value}`)
    .join(", ");
  return text.length > 160 ? element("span", { title: text.slice(0, 2000) }, `${text.slice(0, 159)}…`) : text;
}

const columns = [
  ["No", (row) => String(row.id), "num"],
  ["Time", (row) => timeText(row.created)],
  ["Action", (row) => row.action.replaceAll("_", " ")],
  ["On", (row) => (row.pass_id ? element("a", { href: `/passes/${row.pass_id}` }, row.subject) : row.subject)],
  ["State", (row) => row.state],
  ["Rule", (row) => row.rule],
  ["Cause", (row) => `event ${row.event}: ${row.text}`],
];

function conditions(when) {
  return Object.entries(when)
    .map(([name, value]) => `${name.replaceAll("_", " ")} ${Array.isArray(value) ? value.join(" or ") : value}`)
    .join(", ");
}

function button(row, label, decision) {
  const made = element(
    "button",
    { type: "button", "data-needs": "operator", "aria-label": `${label} action ${row.id}` },
    label,
  );
  made.addEventListener(
    "click",
    acting(async () => {
      await send("POST", `automation/actions/${row.id}/${decision}`);
      await load();
    }),
  );
  return made;
}

function decisions(row) {
  return element("span", {}, button(row, "Approve", "approve"), " ", button(row, "Refuse", "refuse"));
}

function result(row) {
  if (row.state !== "failed") return outcome(row);
  return element("span", {}, outcome(row), " ", button(row, "Repeat", "repeat"));
}

const load = pager(async (limit, offset) => {
  const [page, waiting, rules] = await Promise.all([
    get("automation/actions", { limit, offset }),
    get("automation/actions", { state: "waiting" }),
    get("automation/rules"),
  ]);
  show("waiting", table("Actions that wait for approval", [...columns, ["Decision", decisions]], waiting.items, "None."));
  show("actions", table("Actions", [...columns, ["Result", result]], page.items, "No action yet."));
  show(
    "rules",
    table(
      "Rules in force",
      [
        ["Spacecraft", (row) => (row.spacecraft_id === null ? "all others" : `${row.spacecraft_id} (${row.mission})`)],
        ["Rule", (row) => row.name + (row.default ? " (default)" : "")],
        ["Event", (row) => row.on],
        ["Conditions", (row) => conditions(row.when)],
        ["Actions", (row) => row.do.join(", ").replaceAll("_", " ")],
        ["Approval", (row) => (row.approval ? "required" : "")],
        ["Channels", (row) => row.notify.join(", ")],
      ],
      rules.items,
      "No rule.",
    ),
  );
  return page;
});

load().catch((error) => error.status === 401 || trouble(error));
