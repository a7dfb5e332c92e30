// Standing requests on the planner: their windows, their last plan with its reasons, and changes of them.
import { state, stated } from "./address.js";
import { get, send } from "./api.js";
import { entered, property } from "./forms.js";
import { button, buttons, byId, element, figure, notice, on, schemas, show, showTable, table, timeText } from "./page.js";

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

const change = (label, ...request) =>
  button(label, async () => {
    await send(...request);
    await loadRequests(spacecraft);
  });

function actions(row) {
  const path = `requests/${row.id}`;
  const next = row.state === "active" ? "paused" : "active";
  return buttons(button("Plan", () => showPlan(row.id), { needs: null }), change(next === "paused" ? "Pause" : "Resume", "PATCH", path, { state: next }), change("Delete", "DELETE", path));
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

const FIELDS = ["name", "windows", "period_days", "horizon_days", "sun_elevation_deg", "altitude_km", "minimum_duration_s", "maximum_duration_s", "priority"];
const { properties, required } = schemas.StandingRequestIn;
show(
  "add-request",
  FIELDS.map((name) => property(`request-${name}`, name, properties[name], { required: required.includes(name) })),
  element("button", { class: "primary" }, "Add"),
);
on("add-request", "submit", async () => {
  const made = await send("POST", "requests", { ...entered(byId("add-request"), properties), ...spacecraft });
  notice(`Standing request ${made.name} is added as number ${made.id}`);
  await loadRequests(spacecraft);
});
