import { get, send } from "./api.js";
import { list } from "./lists.js";
import { button, buttons, element, shown, showTable, words } from "./page.js";

const columns = [
  "id",
  ["Time", "created"],
  ["Action", (row) => words(row.action)],
  ["On", (row) => (row.pass_id ? element("a", { href: `/passes/${row.pass_id}` }, row.subject) : row.subject)],
  "state",
  "rule",
  ["Cause", (row) => `event ${row.event}: ${row.text}`],
];

function decide(row, label) {
  const decision = async () => {
    await send("POST", `automation/actions/${row.id}/${label.toLowerCase()}`);
    await load();
  };
  return button(label, decision, { name: `${label} action ${row.id}` });
}

const decisions = (row) => buttons(decide(row, "Approve"), decide(row, "Refuse"));
const result = (row) => [row.error || shown("result", row.result), row.state === "failed" ? decide(row, "Repeat") : ""].flatMap((one) => [one, " "]);

// The other tables of the page are brought with each page of the list.
async function query() {
  const [waiting, rules] = await Promise.all([get("automation/actions", { state: "waiting" }), get("automation/rules")]);
  showTable("waiting", "Actions that wait for approval", [...columns, ["Decision", decisions]], waiting.items, "None.");
  const spacecraft = (row) => (row.spacecraft_id === null ? "all others" : `${row.spacecraft_id} (${row.mission})`);
  const conditions = (row) => Object.entries(row.when).map(([name, value]) => `${words(name)} ${[value].flat().join(" or ")}`).join(", ");
  showTable(
    "rules",
    "Rules in force",
    [
      ["Spacecraft", spacecraft],
      ["Rule", (row) => row.name + (row.default ? " (default)" : "")],
      ["Event", "on"],
      ["Conditions", conditions],
      ["Actions", (row) => row.do.join(", ").replaceAll("_", " ")],
      ["Approval", (row) => (row.approval ? "required" : "")],
      ["Channels", "notify"],
    ],
    rules.items,
    "No rule.",
  );
}

const load = list("/automation/actions", { place: "actions", caption: "Actions", columns: [...columns, ["Result", result]], query, empty: "No action yet." });
