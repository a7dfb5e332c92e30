import { get, send } from "./api.js";
import { list } from "./lists.js";
import { acting, element, shown, showTable, words } from "./page.js";

const columns = [
  "id",
  ["Time", "created"],
  ["Action", (row) => words(row.action)],
  ["On", (row) => (row.pass_id ? element("a", { href: `/passes/${row.pass_id}` }, row.subject) : row.subject)],
  "state",
  "rule",
  ["Cause", (row) => `event ${row.event}: ${row.text}`],
];

const button = (row, label, decision) =>
  element(
    "button",
    {
      type: "button",
      "data-needs": "operator",
      "aria-label": `${label} action ${row.id}`,
      onclick: acting(async () => {
        await send("POST", `automation/actions/${row.id}/${decision}`);
        await load();
      }),
    },
    label,
  );

const decisions = (row) => element("span", { class: "actions" }, button(row, "Approve", "approve"), button(row, "Refuse", "refuse"));
const result = (row) => [row.error || shown("result", row.result), row.state === "failed" ? button(row, "Repeat", "repeat") : ""].flatMap((one) => [one, " "]);

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
