// Open MCT with the telemetry, alarms, events and plans of this service; own layouts are kept in the browser.
import { get } from "../api.js";
import { installClocks } from "./clocks.js";
import { addressOf, allSpacecraft, installDictionary } from "./dictionary.js";
import { installEvents } from "./events.js";
import { installFaults } from "./faults.js";
import { onState, startFeed } from "./feed.js";
import { installImagery } from "./imagery.js";
import { installLayouts, SHIFT } from "./layouts.js";
import { installPlan } from "./plan.js";
import { installTelemetry } from "./telemetry.js";

const MINUTE_MS = 60_000;
const HOUR_MS = 60 * MINUTE_MS;
const openmct = window.openmct;

window.addEventListener("linna-sign-in", () => location.assign(`/?next=${encodeURIComponent(`/mct${location.hash}`)}`));

function installConductor(last) {
  const recent = (clock) => ({ name: clock, timeSystem: "utc", clock, clockOffsets: { start: -30 * MINUTE_MS, end: MINUTE_MS } });
  openmct.install(openmct.plugins.UTCTimeSystem());
  openmct.install(
    openmct.plugins.Conductor({
      menuOptions: [
        recent("newest"),
        recent("mission"),
        { name: "Fixed", timeSystem: "utc", bounds: { start: last - HOUR_MS, end: last + 5 * MINUTE_MS }, zoomOutLimit: 366 * 24 * HOUR_MS, zoomInLimit: 1000 },
      ],
    }),
  );
}

// Objects and entries of notebooks name the user who made them.
function installUser(session) {
  const user = new openmct.user.User(session.name, session.name);
  openmct.user.setProvider({ isLoggedIn: () => true, getCurrentUser: async () => user, hasRole: async () => false, getPossibleRoles: async () => [] });
}

function installIndicators(session) {
  const feed = openmct.indicators.simpleIndicator();
  feed.iconClass("icon-connectivity");
  onState((connected) => {
    feed.text(connected ? "Live feed connected" : "Live feed not connected");
    feed.statusClass(connected ? "s-status-on" : "s-status-off");
  });
  openmct.indicators.add(feed);
  // The name of the user has an indicator of Open MCT itself.
  if (session.browser) {
    const role = openmct.indicators.simpleIndicator();
    role.iconClass("icon-people");
    role.text(session.role);
    openmct.indicators.add(role);
  }
  const home = openmct.indicators.simpleIndicator();
  home.iconClass("icon-arrow-left");
  home.text("LINNA pages");
  home.on?.("click", () => location.assign("/"));
  openmct.indicators.add(home);
}

// Open MCT 4.2 multiplies the opacity of its colours twice, so that translucent marks of annotations are pale on a light
// background. Opacity adds up with its own factor.
function correctOpacity() {
  WebGLRenderingContext.prototype.blendFunc = function (source, destination) {
    this.blendFuncSeparate(source, destination, this.ONE, destination);
  };
}

// Labels of marked ranges of plots.
const TAGS = { anomaly: ["Anomaly", "#b3261e"], gap: ["Data gap", "#5f6368"], manoeuvre: ["Manoeuvre", "#7b4ba8"], check: ["To check", "#a15c00"], observation: ["Observation", "#1a73a8"], reference: ["Reference", "#2e7d32"] };

async function start() {
  const session = await get("session");
  const spacecraft = (await allSpacecraft())[0];
  openmct.setAssetPath(document.getElementById("plugin").dataset.assets);
  const { plugins } = openmct;
  openmct.install(matchMedia("(prefers-color-scheme: light)").matches ? plugins.Snow() : plugins.Espresso());
  openmct.install(plugins.DisplayLayout({ showAsView: [] }));
  openmct.install(plugins.Notebook());
  openmct.install(plugins.LocalStorage());
  openmct.install(plugins.MyItems("My layouts"));
  installUser(session);
  installDictionary(openmct);
  installTelemetry(openmct);
  installLayouts(openmct);
  installPlan(openmct);
  installEvents(openmct);
  installImagery(openmct);
  installFaults(openmct, session);
  for (const [key, [label, backgroundColor]] of Object.entries(TAGS)) openmct.annotation.defineTag(key, { label, backgroundColor, foregroundColor: "#ffffff" });
  startFeed();
  const last = await installClocks(openmct, spacecraft, session);
  // The time system is needed before the conductor.
  installConductor(last);
  installIndicators(session);
  // Without an object in the address: the layout of a shift.
  if (spacecraft && !location.hash) location.hash = `${addressOf(spacecraft, SHIFT)}?hideInspector=true`;
  correctOpacity();
  openmct.on("start", () => performance.mark("linna-started"));
  openmct.start(document.body.firstElementChild);
}

start().catch((error) => {
  if (error.status === 401) return;
  const text = document.createElement("p");
  text.textContent = `The displays could not be started: ${error.message}`;
  document.body.replaceChildren(text);
});
