// Layouts that every spacecraft has: for a pass shift, and for a payload engineer.
import { addExtra, extraIdentifier, parameterIdentifier, parametersOf } from "./dictionary.js";
import { newest } from "./feed.js";

const HIDDEN = { type: true, WARNING: true, CRITICAL: true }; // columns
// Colours of lines, with a contrast of 3 on the backgrounds of both themes.
const COLOURS = ["#1b83c4", "#cf5f1a", "#16905a"];
const FAULTS = { namespace: "faults.taxonomy", key: "faultManagement.view" };

// Identifiers of the parameters that a spacecraft has; names: a list, or a function of the spacecraft that gives one.
async function values(spacecraft, given) {
  const known = await parametersOf(spacecraft);
  const names = typeof given === "function" ? await given(spacecraft) : given;
  return names.filter((name) => known.has(name)).map((name) => parameterIdentifier(spacecraft, name));
}

function addTable(kind, name, names) {
  addExtra(kind, async (spacecraft) => ({ type: "LadTable", name, configuration: { hiddenColumns: HIDDEN, isFixedLayout: false }, composition: await values(spacecraft, names) }), false);
}

function addPlot(kind, name, names) {
  const make = async (spacecraft) => {
    const composition = await values(spacecraft, names);
    return { type: "telemetry.plot.stacked", name, composition, configuration: { series: composition.map((identifier, index) => ({ identifier, series: { color: COLOURS[index % COLOURS.length] } })), yAxis: {}, xAxis: {} } };
  };
  addExtra(kind, make, false);
}

// rows: [height in percent, [[object, width in percent], ...]]
function addLayout(kind, name, rows) {
  const place = (spacecraft, one) => (typeof one === "string" ? extraIdentifier(one, spacecraft) : one);
  addExtra(kind, (spacecraft) => ({
    type: "flexible-layout",
    name,
    composition: rows.flatMap(([, frames]) => frames.map(([one]) => place(spacecraft, one))),
    configuration: {
      rowsLayout: true,
      containers: rows.map(([size, frames], row) => ({
        id: `${kind}-${row}`,
        size,
        frames: frames.map(([one, width], column) => ({
          id: `${kind}-${row}-${column}`,
          domainObjectIdentifier: place(spacecraft, one),
          size: width,
          noFrame: false,
        })),
      })),
    },
  }));
}

// Estimator of the newest state; the anchored one before the first.
async function estimatorOf(spacecraft) {
  const found = (await newest(spacecraft)).find((one) => one.packet === "navigation_state" && one.name === "estimator");
  return found ? found.text.replaceAll(" ", "_") : "anchored";
}

async function matchingNames(spacecraft) {
  return ["frames_processed", "detections_total", `navigation_state.${await estimatorOf(spacecraft)}.matched`];
}

async function navigationNames(spacecraft) {
  const estimator = await estimatorOf(spacecraft);
  return ["altitude_m", "sigma_r_m", "nis"].map((value) => `navigation_state.${estimator}.${value}`);
}

export const SHIFT = "pass-shift";

export function installLayouts(openmct) {
  openmct.install(openmct.plugins.LADTable());
  addTable("shift-values", "Spacecraft state", ["mode", "temperature_c", "bus_voltage_v", "power_w", "storage_used_permille", "queue_depth", "clock_status", "boot_count", "telecommands_accepted", "telecommands_rejected", "packets_sent", "events_sent"]);
  addPlot("shift-plot", "Temperature, bus voltage, power", ["temperature_c", "bus_voltage_v", "power_w"]);
  addTable("payload-values", "Payload state", ["mode", "frames_processed", "frames_bad", "last_image_quality", "detections_total", "anchor_reads", "memory_used_kib", "model_hash", "parameters_hash", "catalogue_hash", "anchor_table_hash"]);
  addPlot("payload-plot", "Frames and detections", matchingNames);
  addPlot("payload-navigation", "On-board estimator", navigationNames);
  addLayout(SHIFT, "Layout: pass shift", [
    [64, [["shift-values", 36], ["shift-plot", 34], [FAULTS, 30]]],
    [36, [["plan", 55], ["events", 45]]],
  ]);
  addLayout("payload-engineer", "Layout: payload engineer", [
    [60, [["payload-values", 30], ["payload-navigation", 38], ["payload-plot", 32]]],
    [40, [["detections", 50], ["events", 50]]],
  ]);
}
