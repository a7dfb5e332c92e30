// Windows and contacts of a spacecraft as a plan.
import { get } from "../api.js";
import { addExtra, refreshObjects } from "./dictionary.js";
import { listen, milliseconds, onState } from "./feed.js";

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
  return { name, type: group, start: milliseconds(one.start), end: milliseconds(stop), color, textColor: one.state === "approved" ? "#ffffff" : "#000000", description: [one.state, one.reason].filter(Boolean).join(": ") };
}

const groupOf = (one) => `Contacts, ${one.station || one.link}`;
const isOf = (spacecraft) => (one) => one.spacecraft_id === spacecraft.spacecraft_id && one.instance === spacecraft.instance;

// Activities by group. Groups are there without activities, so that none is added while the plan is shown.
async function planOf(spacecraft, { start, end }) {
  const span = { since: new Date(start).toISOString(), until: new Date(end).toISOString() };
  const [windows, links, { contacts }] = await Promise.all([get("windows", { limit: 1000 }), get("links"), get("contacts", span)]);
  const own = windows.items.filter(isOf(spacecraft));
  const body = { Windows: own.map((one) => activity(`${one.name}, ${one.state}`, "Windows", one, one.stop)) };
  for (const one of links.items.filter(isOf(spacecraft))) body[groupOf(one)] = [];
  for (const one of contacts) {
    const group = groupOf(one);
    const stop = one.stop ?? one.predicted_stop;
    if (stop && body[group] && one.spacecraft_id === spacecraft.spacecraft_id) {
      body[group].push(activity(`${one.station || one.link}, ${one.state}`, group, one, stop));
    }
  }
  return body;
}

const AGAIN_MS = 500; // shortest time between two requests
const CHANGES = ["window", "link", "contact started", "contact ended", "contact missed"];

export function installPlan(openmct) {
  openmct.install(openmct.plugins.PlanLayout());
  openmct.install(openmct.plugins.Timelist());
  openmct.install(openmct.plugins.Timeline());
  let span = null; // time that was read
  let pending = null;
  // Plans are read again after changes of windows and links, and when the shown time leaves the time that was read.
  function soon() {
    pending ??= setTimeout(() => {
      pending = null;
      refreshObjects("plan").catch((error) => console.warn(`Windows and contacts: ${error.message}`));
    }, AGAIN_MS);
  }
  for (const kind of CHANGES) listen(kind, soon);
  onState((connected) => connected && soon());
  openmct.time.on("boundsChanged", ({ start, end }) => (start < span?.start || end > span?.end) && soon());
  addExtra("plan", async (spacecraft) => {
    const { start, end } = openmct.time.getBounds();
    span = { start: start - DAY_MS, end: end + 2 * DAY_MS };
    const body = await planOf(spacecraft, span);
    // Open MCT would store groups that are not in its configuration.
    const swimlaneVisibility = Object.fromEntries(Object.keys(body).map((group) => [group, true]));
    return { type: "plan", name: "Windows and contacts", configuration: { clipActivityNames: true, swimlaneVisibility }, selectFile: { name: "plan.json", body } };
  });
}
