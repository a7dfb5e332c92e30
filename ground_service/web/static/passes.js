import { keep, restore, state, statedAll } from "./address.js";
import { get, send } from "./api.js";
import { list, spacecraftOf, spacecraftOptions } from "./lists.js";
import { byId, element, figure, lengthText, notice, on, seconds, showTable, stateMark, trouble } from "./page.js";

restore("search", "verdict");

// Passes chosen for the comparison, over all pages of the list.
const MOST_COMPARED = 7; // colours of a chart
const compared = new Set(statedAll("compare"));

function showChosen() {
  state({ compare: [...compared] });
  byId("compare").disabled = compared.size < 2;
  byId("chosen").textContent = compared.size ? `${compared.size} chosen` : "Choose two or more passes to compare them.";
  byId("choose-none").hidden = !compared.size;
}

function choice(row) {
  const key = String(row.id);
  const choose = (event) => {
    if (event.target.checked && compared.size >= MOST_COMPARED) {
      event.target.checked = false;
      notice(`At most ${MOST_COMPARED} passes are compared.`, "bad");
    } else if (event.target.checked) compared.add(key);
    else compared.delete(key);
    showChosen();
  };
  return element("input", { type: "checkbox", checked: compared.has(key), "aria-label": `compare ${row.name}`, onchange: choose });
}

byId("compare").addEventListener("click", () => location.assign(`/comparison?${[...compared].map((key) => `pass=${encodeURIComponent(key)}`).join("&")}`));
byId("choose-none").addEventListener("click", () => {
  compared.clear();
  for (const box of byId("passes").querySelectorAll("input")) box.checked = false;
  showChosen();
});
showChosen();

const filtered = () => ["search", "verdict", "of-spacecraft"].some((id) => byId(id).value);

// The whole verdict is a sentence: the list shows its level, and the sentence when pointed at.
const verdict = ({ report }) => (report ? stateMark(report.verdict_level, report.verdict) : "no report");

const load = list("/passes", {
  place: "passes",
  columns: [
    ["Compare", choice],
    ["Pass", (row) => element("a", { href: `/passes/${row.id}` }, row.name)],
    ["Report", ({ report }) => (report ? element("a", { href: `/reports/${report.id}`, target: "_blank" }, "open") : "none")],
    ["Median error, m", ({ report }) => figure(report?.median_error_m), "num"],
    ["Verdict", verdict],
    ["Spacecraft", (row) => `${row.spacecraft_id}, ${row.instance}`],
    "start",
    ["Length", (row) => lengthText(seconds(row.stop) - seconds(row.start)), "num"],
    ["Recall", ({ report }) => figure(report?.recall), "num"],
    ["Evidence", ({ report }) => (report ? `level ${report.evidence_level || "not stated"}` : "")],
  ],
  query: () => ({ search: byId("search").value || null, verdict: byId("verdict").value || null, ...spacecraftOf("of-spacecraft") }),
  async rows(items) {
    const found = items.length ? (await get("reports", { pass_id: items.map((one) => one.id) })).items : [];
    return items.map((one) => ({ ...one, report: found.find((report) => report.pass_id === one.id) }));
  },
  empty: () => (filtered() ? "No pass matches." : "No pass yet."),
  ready: spacecraftOptions("of-spacecraft", element("option", { value: "" }, "all")),
});

on("find", "submit", async () => {
  keep("search", "verdict", "of-spacecraft");
  await load.first();
});
for (const id of ["verdict", "of-spacecraft"]) byId(id).addEventListener("change", () => byId("find").requestSubmit());
on("define", "submit", async () => {
  const made = await send("POST", "passes", {
    name: byId("name").value,
    start: byId("start").value,
    stop: byId("stop").value,
    spacecraft_id: byId("spacecraft").valueAsNumber,
  });
  notice(`${made.name} is kept as pass ${made.id}`);
  await load();
});

const METRICS = { recall: ["Recall", ""], drift_percent: ["Drift", "% of path"], median_error_m: ["Median error", "m"] };
const metricName = (metric) => METRICS[metric].filter(Boolean).join(", ");
const between = (low, high) => (low == null || high == null ? "unknown" : `${figure(low)} to ${figure(high)}`);

async function showPerformance() {
  const spacecraft = byId("of").valueAsNumber;
  const [found, monthly] = await Promise.all([
    get(`spacecraft/${spacecraft}/performance`, { window_days: byId("days").value }),
    get("monthly-reports", { spacecraft_id: spacecraft, limit: 24 }),
  ]);
  const metric = ["Metric", (row) => metricName(row.metric)];
  const interval = (row) => between(row.low, row.high);
  showTable("groups", "Mean of the passes by condition", [["Condition", "factor"], "group", metric, "passes", "mean", ["95 % interval", interval, "num"]], found.groups, "No pass has a report.");
  showTable("changes", "Changes of level", [metric, ["First pass", "pass_id"], "time", "before", "after", ["p", "p_value"]], found.changes, "No metric changed significantly.");
  showTable(
    "requirements",
    `Requirements over the last ${figure(found.window_days)} days`,
    [
      ["Requirement", "name"],
      ["Limit", (row) => (row.limit == null ? "not stated" : `${figure(row.limit)} ${row.unit}`), "num"],
      "met",
      "not_met",
      "unknown",
      ["Share met, 95 % interval", (row) => (row.share_met == null ? "not judged" : `${figure(row.share_met)} (${interval(row)})`)],
      ["Remark", "remark"],
    ],
    found.requirements,
    "No report has requirements.",
  );
  const opened = (row) => element("a", { href: `/monthly-reports/${row.id}`, target: "_blank" }, "open");
  showTable("monthly", "Monthly reports", ["month", "instance", "passes", ["Verdict", (row) => row.verdict], ["Report", opened]], monthly.items, "There is no monthly report.");
}

byId("performance").addEventListener("toggle", () => byId("performance").open && showPerformance().catch(trouble));
on("trend", "submit", showPerformance);

