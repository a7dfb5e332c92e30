// Windows and contacts of a spacecraft as a plan.
import { get } from "../api.js";
import { addExtra } from "./dictionary.js";
import { milliseconds } from "./feed.js";

const DAY_MS = 86_400_000;
const COLOURS = {
  draft: "#9a9a9a",
  approved: "#0072b2",
  uplinked: "#56b4e9",
  executing: "#e69f00",
  executed: "#009e73",
  downlinked: "#009e73",
  processed: "#009e73",
  failed: "#d55e00",
  predicted: "#9a9a9a",
  open: "#e69f00",
  ended: "#009e73",
  missed: "#d55e00",
};

function activity(name, group, one, stop) {
  const color = COLOURS[one.state] ?? "#9a9a9a";
  return { name, type: group, start: milliseconds(one.start), end: milliseconds(stop), color, textColor: "#000000", description: [one.state, one.reason].filter(Boolean).join(": ") };
}

async function planOf(openmct, spacecraft) {
  const { start, end } = openmct.time.getBounds();
  const span = { since: new Date(start - DAY_MS).toISOString(), until: new Date(end + 2 * DAY_MS).toISOString() };
  const [windows, { contacts }] = await Promise.all([get("windows", { limit: 1000 }), get("contacts", span)]);
  const own = windows.items.filter((one) => one.spacecraft_id === spacecraft.spacecraft_id && one.instance === spacecraft.instance);
  const body = { Windows: own.map((one) => activity(`${one.name}, ${one.state}`, "Windows", one, one.stop)) };
  for (const one of contacts) {
    const stop = one.stop ?? one.predicted_stop;
    if (one.spacecraft_id !== spacecraft.spacecraft_id || spacecraft.instance !== "flight" || !stop) continue;
    const group = `Contacts, ${one.station || one.link}`;
    (body[group] ??= []).push(activity(`${one.station || one.link}, ${one.state}`, group, one, stop));
  }
  return body;
}

export function installPlan(openmct) {
  openmct.install(openmct.plugins.PlanLayout());
  openmct.install(openmct.plugins.Timelist());
  openmct.install(openmct.plugins.Timeline());
  addExtra("plan", async (spacecraft) => {
    const body = await planOf(openmct, spacecraft);
    // Open MCT would store groups that are not in its configuration.
    const swimlaneVisibility = Object.fromEntries(Object.keys(body).map((group) => [group, true]));
    return { type: "plan", name: "Windows and contacts", configuration: { clipActivityNames: true, swimlaneVisibility }, selectFile: { name: "plan.json", body } };
  });
}
