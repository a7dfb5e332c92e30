import { keep, restore } from "./address.js";
import { get, send } from "./api.js";
import { acting, byId, element, figure, lengthText, notice, pager, seconds, show, table, timeText, trouble } from "./page.js";

restore("search");

const load = pager(async (limit, offset) => {
  const page = await get("passes", { limit, offset, search: byId("search").value || null });
  const ids = page.items.map((one) => one.id);
  const found = ids.length ? (await get("reports", { pass_id: ids })).items : [];
  const report = Object.fromEntries(found.map((one) => [one.pass_id, one]));
  show(
    "passes",
    table(
      "Passes",
      [
        ["Pass", (row) => element("a", { href: `/passes/${row.id}` }, row.name)],
        ["Spacecraft", (row) => `${row.spacecraft_id}, ${row.instance}`],
        ["Start", (row) => timeText(row.start)],
        ["Length", (row) => lengthText(seconds(row.stop) - seconds(row.start)), "num"],
        ["Verdict", (row) => verdict(report[row.id])],
        ["Median error, m", (row) => figure(report[row.id]?.median_error_m), "num"],
        ["Recall", (row) => figure(report[row.id]?.recall), "num"],
        ["Evidence", (row) => (report[row.id] ? `level ${report[row.id].evidence_level || "not stated"}` : "")],
        ["Report", (row) => (report[row.id] ? element("a", { href: `/reports/${report[row.id].id}`, target: "_blank" }, "open") : "none")],
      ],
      page.items,
      byId("search").value ? "No pass matches." : "No pass yet.",
    ),
  );
  return page;
});

// The whole verdict is a sentence: the list shows its level, and the sentence when pointed at.
const verdict = (report) => (report ? element("span", { class: `state ${report.verdict_level}`, title: report.verdict }, report.verdict_level || "none") : "");

byId("find").addEventListener(
  "submit",
  acting(async () => {
    keep("search");
    await load.first();
  }),
);
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

load().catch((error) => error.status === 401 || trouble(error));
