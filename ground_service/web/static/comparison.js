// Two or more passes side by side: figures, position error over the time since their start, requirements.
import { bind, restore, statedAll } from "./address.js";
import { get } from "./api.js";
import { chart, errorColumns } from "./charts.js";
import { byId, element, figure, lengthText, loading, on, seconds, show, stateMark, table, timeText } from "./page.js";

const asked = [...new Set(statedAll("pass"))];
let compared = [];

async function read(id) {
  const [pass, reports, completeness] = await Promise.all([
    get(`passes/${encodeURIComponent(id)}`),
    get("reports", { pass_id: id }),
    get(`passes/${encodeURIComponent(id)}/completeness`),
  ]);
  const report = reports.items[0] ?? null;
  if (!report) return { pass, completeness, report };
  const [overview, figures] = await Promise.all([get(`reports/${report.id}/overview`), get(`reports/${report.id}/summary`)]);
  return { pass, completeness, report, overview, figures };
}

const solutionsOf = ({ figures }) => (figures ? { ...figures.baselines, ...figures.smoothed, ...figures.navigation } : {});
// Passes can have the same name.
const nameOf = ({ pass }) => `${pass.name} (${pass.id})`;
const known = (value, unit = "") => (value === null || value === undefined ? "unknown" : `${figure(value)} ${unit}`.trim());

// With two passes, the difference of the second from the first; 0 below the figures that are shown.
const SHOWN = 1e-3;
function difference(values) {
  const [first, second] = values;
  if (values.length !== 2 || typeof first !== "number" || typeof second !== "number") return "";
  const change = second - first;
  if (Math.abs(change) <= SHOWN * Math.max(Math.abs(first), Math.abs(second))) return "±0";
  return `${change > 0 ? "+" : "−"}${figure(Math.abs(change))}`;
}

// A row of the table: its name, and a cell or a number for each pass.
const text = (name, cell) => ({ name, cells: compared.map(cell), change: "" });
function number(name, value, unit = "") {
  const values = compared.map(value);
  return { name: unit ? `${name}, ${unit}` : name, cells: values.map((one) => known(one)), change: difference(values) };
}

function sideBySide(caption, rows) {
  const heading = (one) => element("a", { href: `/passes/${one.pass.id}` }, nameOf(one));
  return table(
    caption,
    [
      ["Figure", "name"],
      ...compared.map((one, index) => [heading(one), (row) => row.cells[index]]),
      ...(compared.length === 2 ? [["Difference", (row) => row.change, "num"]] : []),
    ],
    rows,
    "Nothing to compare.",
  );
}

const missionOf = ({ pass }) =>
  pass.mission_revision ? element("a", { href: `/missions/${pass.mission_revision.slice(0, 16)}` }, `${pass.mission}, ${pass.mission_revision.slice(0, 8)}`) : "not stated";

function verdictOf({ report }) {
  if (!report) return "no report";
  return element("span", {}, stateMark(report.verdict_level), ` ${report.verdict}`);
}

function showFigures() {
  const solution = byId("solution").value;
  const navigation = (name) => (one) => solutionsOf(one)[solution]?.[name];
  const detector = (name) => (one) => one.figures?.detector[name];
  show(
    "figures",
    sideBySide("Figures of the passes", [
      text("Verdict", verdictOf),
      text("Report", ({ report }) => (report ? element("a", { href: `/reports/${report.id}`, target: "_blank" }, timeText(report.created)) : "none")),
      text("Evidence", ({ report }) => (report ? `level ${report.evidence_level || "not stated"}` : "unknown")),
      text("Spacecraft", ({ pass }) => `${pass.spacecraft_id}, ${pass.instance}`),
      text("Mission description", missionOf),
      text("Build", ({ figures }) => figures?.conditions?.build || "unknown"),
      text("Start", ({ pass }) => timeText(pass.start)),
      text("Length", ({ pass }) => lengthText(seconds(pass.stop) - seconds(pass.start))),
      number("Altitude", ({ figures }) => figures?.conditions?.altitude_km, "km"),
      number("Sun elevation", ({ figures }) => figures?.conditions?.sun_elevation_deg, "deg"),
      number("Frames", ({ figures }) => figures?.frames),
      number("Packets received", ({ completeness }) => completeness.packets),
      number("Packets lost", ({ completeness }) => completeness.lost),
      number("Precision", detector("precision")),
      number("Recall", detector("recall")),
      number("Localisation error", detector("loc_px"), "px"),
      number(`Median error, ${solution}`, navigation("median_3d_m"), "m"),
      number(`95 % error, ${solution}`, navigation("p95_3d_m"), "m"),
      number(`Largest error, ${solution}`, navigation("max_3d_m"), "m"),
      number(`Error at the end, ${solution}`, navigation("end_of_pass_m"), "m"),
      number(`Drift, ${solution}`, navigation("drift_percent"), "% of path"),
    ]),
  );
}

function showDrift() {
  const solution = byId("solution").value;
  const series = compared.flatMap((one) => {
    const { pass, overview } = one;
    const found = overview?.navigation.find((each) => each.name === solution);
    if (!found?.time_s.length) return [];
    return [{ label: nameOf(one), ...errorColumns(found, seconds(pass.start)) }];
  });
  show("drift");
  if (series.length) chart(byId("drift"), `error of ${solution}`, "m", series, { logarithmic: true, elapsed: true, group: "comparison", height: 320 });
  else show("drift", element("p", { class: "hint" }, "No report of these passes has errors of this solution."));
}

function showRequirements() {
  const named = new Map(compared.flatMap(({ overview }) => (overview?.requirements ?? []).map((one) => [one.key, one])));
  const cell = (key) => ({ overview }) => {
    const found = overview?.requirements.find((one) => one.key === key);
    if (!found) return "not judged";
    const limit = found.limit === null ? "" : ` (${found.at_most ? "≤" : "≥"} ${figure(found.limit)} ${found.unit})`;
    return `${found.status}: ${known(found.value, found.unit)}${limit}`;
  };
  show("requirements", sideBySide("Requirements of the passes", [...named].map(([key, one]) => text(one.name, cell(key)))));
}

function draw() {
  showFigures();
  showDrift();
}

async function load() {
  if (asked.length < 2) {
    show("figures", element("p", { class: "hint" }, "Choose two or more passes on the ", element("a", { href: "/passes" }, "list of passes"), "."));
    return;
  }
  compared = await Promise.all(asked.map(read));
  byId("span").textContent = compared.map(nameOf).join(" · ");
  document.title = `${compared.length} passes compared · LINNA`;
  const solutions = [...new Set(compared.flatMap((one) => Object.keys(solutionsOf(one))))];
  show("solution", solutions.map((name) => element("option", { value: name }, name)));
  byId("solution").value = compared.map(({ report }) => report?.estimator).find(Boolean) ?? solutions[0] ?? "";
  restore("solution");
  bind("solution");
  on("solution", "change", draw);
  draw();
  showRequirements();
}

loading(load);
