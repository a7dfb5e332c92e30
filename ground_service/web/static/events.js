import { keep, restore } from "./address.js";
import { get } from "./api.js";
import { acting, byId, element, pager, show, stateMark, table, timeText, trouble, watch } from "./page.js";

const FILTERS = ["spacecraft", "severity", "name", "start", "stop"];
const LEVELS = ["info", "low", "medium", "high"];

const load = pager(async (limit, offset) => {
  const [spacecraft, instance] = byId("spacecraft").value.split(" ");
  const least = byId("severity").value;
  const page = instance
    ? await get("events", {
        limit,
        offset,
        spacecraft_id: spacecraft,
        instance,
        severity: least ? LEVELS.slice(LEVELS.indexOf(least)) : null,
        name: byId("name").value.trim() || null,
        start: byId("start").value.trim() || null,
        stop: byId("stop").value.trim() || null,
      })
    : { items: [], total: 0 };
  show(
    "events",
    table(
      "Events",
      [
        ["Time", (row) => timeText(row.time)],
        ["Severity", (row) => stateMark(row.severity)],
        ["Event", (row) => row.name.replaceAll("_", " ")],
        ["Detail", (row) => row.detail],
        ["Pass", (row) => (row.pass_id === null ? "none" : element("a", { href: `/passes/${row.pass_id}` }, String(row.pass_id)))],
      ],
      page.items,
      instance ? "No event matches." : "No telemetry has been received.",
    ),
  );
  return page;
}, 50);

async function choose() {
  keep(...FILTERS);
  await load.first();
}

async function start() {
  const { items } = await get("spacecraft");
  show("spacecraft", items.map((one) => element("option", { value: `${one.spacecraft_id} ${one.instance}` }, `${one.spacecraft_id}, ${one.instance}`)));
  restore(...FILTERS);
  await load();
}

for (const id of ["spacecraft", "severity"]) byId(id).addEventListener("change", acting(choose));
byId("filter").addEventListener("submit", acting(choose));
let pending = null;
watch((message) => {
  if (message.kind !== "telemetry") return;
  clearTimeout(pending);
  pending = setTimeout(() => load().catch(trouble), 400);
});
start().catch((error) => error.status === 401 || trouble(error));
