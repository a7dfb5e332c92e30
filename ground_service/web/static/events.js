import { keep, restore } from "./address.js";
import { list, spacecraftOf, spacecraftOptions } from "./lists.js";
import { acting, byId, words } from "./page.js";

const FILTERS = ["spacecraft", "severity", "name", "start", "stop"];
const LEVELS = ["info", "low", "medium", "high"];

const text = (id) => byId(id).value.trim() || null;
const levels = () => (text("severity") ? LEVELS.slice(LEVELS.indexOf(text("severity"))) : null);

const load = list("/events", {
  place: "events",
  columns: ["time", "severity", ["Event", (row) => words(row.name)], "detail", "pass_id"],
  query: () => text("spacecraft") && ({ ...spacecraftOf("spacecraft"), severity: levels(), name: text("name"), start: text("start"), stop: text("stop") }),
  empty: () => (text("spacecraft") ? "No event matches." : "No telemetry has been received."),
  size: 50,
  ready: spacecraftOptions("spacecraft").then(() => restore(...FILTERS)),
  concerns: (message) => message.kind === "telemetry",
});

const choose = acting(async () => {
  keep(...FILTERS);
  await load.first();
});
for (const id of ["spacecraft", "severity"]) byId(id).addEventListener("change", choose);
byId("filter").addEventListener("submit", choose);
