// Standing requests on the planner: their windows, their last plan with its reasons, and changes of them.
import { state, stated } from "./address.js";
import { get, send } from "./api.js";
import { acting, byId, element, figure, notice, on, show, showTable, table, timeText } from "./page.js";

let spacecraft = null;

const pair = ({ min, max }, unit) => `${figure(min)} to ${figure(max)} ${unit}`;

function termsText(terms) {
  return [
    `${figure(terms.windows)} windows in ${figure(terms.period_days)} days`,
    terms.sun_elevation_deg ? `Sun ${pair(terms.sun_elevation_deg, "deg")}` : null,
    terms.altitude_km ? `altitude ${pair(terms.altitude_km, "km")}` : null,
    terms.regions ? `${figure(terms.regions.length)} regions` : null,
    `priority ${figure(terms.priority)}`,
  ]
    .filter(Boolean)
    .join(", ");
}

const windowsText = (counts) => Object.entries(counts).map(([name, count]) => `${count} ${name}`).join(", ") || "none";

const changing = (task) =>
  acting(async () => {
    await task();
    await loadRequests(spacecraft);
  });

function actions(row) {
  const path = `requests/${row.id}`;
  const next = row.state === "active" ? "paused" : "active";
  return element(
    "span",
    { class: "actions" },
    element("button", { type: "button", onclick: acting(() => showPlan(row.id)) }, "Plan"),
    element("button", { type: "button", "data-needs": "operator", onclick: changing(() => send("PATCH", path, { state: next })) }, next === "paused" ? "Pause" : "Resume"),
    element("button", { type: "button", "data-needs": "operator", onclick: changing(() => send("DELETE", path)) }, "Delete"),
  );
}

async function showPlan(id) {
  const plan = await get(`requests/${id}/plan`);
  state({ request: id });
  show(
    "request-plan",
    element("h3", {}, `Last plan of request ${id}`),
    element("p", { class: "hint" }, plan.planned ? `Made at ${timeText(plan.planned)}, until ${timeText(plan.until)}.${plan.reason ? ` ${plan.reason}.` : ""}` : (plan.reason ?? "Not planned yet.")),
    table("Candidates of the plan", ["start", "stop", "outcome", "window_id", "reason"], plan.candidates, "No candidates."),
  );
}

export async function loadRequests(chosen) {
  spacecraft = chosen;
  const { items } = await get("requests", { limit: 200 });
  showTable(
    "requests",
    "Standing requests",
    [
      ["Request", "name"],
      ["Spacecraft", (row) => `${row.spacecraft_id}, ${row.instance}`],
      "state",
      ["Terms", (row) => termsText(row.terms)],
      ["Windows", (row) => windowsText(row.windows)],
      ["Planned", (row) => timeText(row.planned) || "not yet"],
      ["By", "created_by"],
      ["", actions],
    ],
    items,
    "No standing request.",
  );
  const asked = items.find((one) => String(one.id) === stated("request"));
  if (asked) await showPlan(asked.id);
  else show("request-plan");
}

function limits(name) {
  const [min, max] = ["min", "max"].map((end) => byId(`request-${name}-${end}`).valueAsNumber);
  if (Number.isNaN(min) && Number.isNaN(max)) return null;
  if (Number.isNaN(min) || Number.isNaN(max)) throw new Error(`State both limits of the ${name === "sun" ? "Sun elevation" : name}, or none.`);
  return { min, max };
}

on("add-request", "submit", async () => {
  const number = (name) => byId(`request-${name}`).valueAsNumber;
  const made = await send("POST", "requests", {
    name: byId("request-name").value,
    ...spacecraft,
    windows: number("windows"),
    period_days: number("period"),
    horizon_days: number("horizon"),
    sun_elevation_deg: limits("sun"),
    altitude_km: limits("altitude"),
    minimum_duration_s: number("shortest"),
    maximum_duration_s: number("longest"),
    priority: number("priority"),
  });
  notice(`Standing request ${made.name} is added as number ${made.id}`);
  await loadRequests(spacecraft);
});
