import { keep, restore, state, statedAll } from "./address.js";
import { get, send } from "./api.js";
import { acting, byId, element, figure, lengthText, notice, pager, seconds, show, stateMark, table, timeText, trouble } from "./page.js";

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

// Spacecraft of the list: of the address until the list of them has come.
async function showSpacecraft() {
  const { items } = await get("spacecraft");
  const keys = [...new Set(items.map((one) => `${one.spacecraft_id} ${one.instance}`))];
  show("of-spacecraft", element("option", { value: "" }, "all"), keys.map((key) => element("option", { value: key }, key.replace(" ", ", "))));
  restore("of-spacecraft");
}

const filtered = () => ["search", "verdict", "of-spacecraft"].some((id) => byId(id).value);

const load = pager(async (limit, offset) => {
  const [spacecraft, ...instance] = byId("of-spacecraft").value.split(" ");
  const page = await get("passes", {
    limit,
    offset,
    search: byId("search").value || null,
    verdict: byId("verdict").value || null,
    spacecraft_id: spacecraft || null,
    instance: instance.join(" ") || null,
  });
  const ids = page.items.map((one) => one.id);
  const found = ids.length ? (await get("reports", { pass_id: ids })).items : [];
  const report = Object.fromEntries(found.map((one) => [one.pass_id, one]));
  show(
    "passes",
    table(
      "Passes",
      [
        ["Compare", choice],
        ["Pass", (row) => element("a", { href: `/passes/${row.id}` }, row.name)],
        ["Verdict", (row) => verdict(report[row.id])],
        ["Spacecraft", (row) => `${row.spacecraft_id}, ${row.instance}`],
        ["Start", (row) => timeText(row.start)],
        ["Length", (row) => lengthText(seconds(row.stop) - seconds(row.start)), "num"],
        ["Median error, m", (row) => figure(report[row.id]?.median_error_m), "num"],
        ["Recall", (row) => figure(report[row.id]?.recall), "num"],
        ["Evidence", (row) => (report[row.id] ? `level ${report[row.id].evidence_level || "not stated"}` : "")],
        ["Report", (row) => (report[row.id] ? element("a", { href: `/reports/${report[row.id].id}`, target: "_blank" }, "open") : "none")],
      ],
      page.items,
      filtered() ? "No pass matches." : "No pass yet.",
    ),
  );
  return page;
});

// The whole verdict is a sentence: the list shows its level, and the sentence when pointed at.
const verdict = (report) => (report ? stateMark(report.verdict_level, report.verdict) : "no report");

byId("find").addEventListener(
  "submit",
  acting(async () => {
    keep("search", "verdict", "of-spacecraft");
    await load.first();
  }),
);
for (const id of ["verdict", "of-spacecraft"]) byId(id).addEventListener("change", () => byId("find").requestSubmit());
byId("define").addEventListener(
  "submit",
  acting(async () => {
    const made = await send("POST", "passes", {
      name: byId("name").value,
      start: byId("start").value,
      stop: byId("stop").value,
      spacecraft_id: byId("spacecraft").valueAsNumber,
    });
    notice(`${made.name} is kept as pass ${made.id}`);
    await load();
  }),
);

const METRICS = { recall: ["Recall", ""], drift_percent: ["Drift", "% of path"], median_error_m: ["Median error", "m"] };
const metricName = (metric) => METRICS[metric].filter(Boolean).join(", ");
const between = (low, high) => (low == null || high == null ? "unknown" : `${figure(low)} to ${figure(high)}`);

async function showPerformance() {
  const spacecraft = byId("of").valueAsNumber;
  const [found, monthly] = await Promise.all([
    get(`spacecraft/${spacecraft}/performance`, { window_days: byId("days").value }),
    get("monthly-reports", { spacecraft_id: spacecraft, limit: 24 }),
  ]);
  show(
    "groups",
    table(
      "Mean of the passes by condition",
      [
        ["Condition", (row) => row.factor],
        ["Group", (row) => row.group],
        ["Metric", (row) => metricName(row.metric)],
        ["Passes", (row) => figure(row.passes), "num"],
        ["Mean", (row) => figure(row.mean), "num"],
        ["95 % interval", (row) => between(row.low, row.high), "num"],
      ],
      found.groups,
      "No pass has a report.",
    ),
  );
  show(
    "changes",
    table(
      "Changes of level",
      [
        ["Metric", (row) => metricName(row.metric)],
        ["First pass", (row) => element("a", { href: `/passes/${row.pass_id}` }, row.pass_id)],
        ["Time", (row) => timeText(row.time)],
        ["Before", (row) => figure(row.before), "num"],
        ["After", (row) => figure(row.after), "num"],
        ["p", (row) => figure(row.p_value), "num"],
      ],
      found.changes,
      "No metric changed significantly.",
    ),
  );
  show(
    "requirements",
    table(
      `Requirements over the last ${figure(found.window_days)} days`,
      [
        ["Requirement", (row) => row.name],
        ["Limit", (row) => (row.limit == null ? "not stated" : `${figure(row.limit)} ${row.unit}`), "num"],
        ["Met", (row) => figure(row.met), "num"],
        ["Not met", (row) => figure(row.not_met), "num"],
        ["Unknown", (row) => figure(row.unknown), "num"],
        ["Share met, 95 % interval", (row) => (row.share_met == null ? "not judged" : `${figure(row.share_met)} (${between(row.low, row.high)})`)],
      ],
      found.requirements,
      "No report has requirements.",
    ),
  );
  show(
    "monthly",
    table(
      "Monthly reports",
      [
        ["Month", (row) => row.month],
        ["Instance", (row) => row.instance],
        ["Passes", (row) => figure(row.passes), "num"],
        ["Verdict", (row) => row.verdict],
        ["Report", (row) => element("a", { href: `/monthly-reports/${row.id}`, target: "_blank" }, "open")],
      ],
      monthly.items,
      "There is no monthly report.",
    ),
  );
}

byId("performance").addEventListener("toggle", () => byId("performance").open && showPerformance().catch(trouble));
byId("trend").addEventListener("submit", acting(showPerformance));

showSpacecraft().then(load).catch((error) => error.status === 401 || trouble(error));
