import { bind } from "./address.js";
import { finished, get, request, send } from "./api.js";
import { chart, columns, errorColumns, solutionStyle } from "./charts.js";
import { craterRims, layerItem, moonMap, terrain, track } from "./moon.js";
import { drawParameters } from "./parameters.js";
import { button, byId, dictionary, element, figure, lengthText, loading, notice, on, parameterName, parameterOptions, seconds, show, showTable, stateClass, stateMark, table, timeText, unitText, words } from "./page.js";

const passId = Number(location.pathname.split("/").at(-1));
const STATES = ["latitude_deg", "longitude_deg", "altitude_m"];

async function save(path, name, options) {
  const answer = await request(path, options);
  const link = URL.createObjectURL(await answer.blob());
  element("a", { href: link, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(link), 60_000);
}

async function showExports() {
  const formats = await get("exports/formats");
  show("export-states", ["reference", ...dictionary.estimators].map((name) => element("option", { value: name }, name)));
  bind("export-states");
  const exported = (one) =>
    save("exports", `pass-${passId}${one.ending === "zip" ? `-${one.name}` : ""}.${one.ending}`, {
      method: "POST",
      json: { pass_id: passId, format: one.name, states: byId("export-states").value },
    });
  const start = (one) => button(one.name, () => exported(one), { disabled: !one.available, needs: null });
  const contents = (one) => one.description + (one.available ? "" : ` (the server lacks linna[${one.extra}])`);
  showTable("exports", "Formats", [["Format", start], ["Contents", contents], ["States", (one) => (one.states ? "as chosen" : "")]], formats, "None.");
}

function showReport(report, id) {
  show(
    "verdict",
    element("p", { class: `verdict ${stateClass(report.verdict_level)}` }, stateMark(report.verdict_level), ` ${report.verdict}`),
    element(
      "dl",
      { class: "glance" },
      report.headline.map((one) =>
        element(
          "div",
          {},
          element("dt", {}, one.label),
          element("dd", { class: "number" }, headline(one.value), one.unit ? element("small", {}, ` ${one.unit}`) : null),
          element("dd", { class: "note" }, one.note),
        ),
      ),
    ),
    table(
      "Requirements",
      [
        ["Requirement", "name"], "status",
        ["Value", (row) => (row.value === null ? "unknown" : `${figure(row.value)} ${row.unit}`), "num"],
        ["Limit", (row) => (row.limit === null ? "–" : `${row.at_most ? "≤" : "≥"} ${figure(row.limit)} ${row.unit}`), "num"],
      ],
      report.requirements,
      "No requirement was evaluated.",
    ),
    element("p", { class: "hint" }, `Evidence: ${report.evidence_level ? `level ${report.evidence_level}` : "no level stated"}.`),
  );
  show(
    "report-links",
    element("a", { class: "button", href: `/reports/${id}`, target: "_blank" }, "Open report"),
    ["pdf", "json"].map((format) =>
      element("a", { class: "button", href: `/api/v1/reports/${id}?format=${format}`, download: `pass-${passId}.${format}` }, format.toUpperCase()),
    ),
  );
}

// As on the first page of the report.
function headline(value) {
  if (typeof value !== "number" || !value || Math.abs(value) >= 1e-3) return figure(value);
  return value > 0 ? "< 0.001" : "> −0.001";
}

// Errors against the reference, estimators and baselines on one axis: mean within the band of each stretch.
function showErrors(report) {
  const series = report.navigation
    .filter((one) => one.time_s.length)
    .map((one, index) => ({ label: one.name, ...solutionStyle(one.name, one.kind, index), ...errorColumns(one) }));
  show("errors");
  if (series.length) chart(byId("errors"), "distance from the reference", "m", series, { logarithmic: true, group: "pass", height: 300 });
}

function showCompleteness(found) {
  const rows = found.by_apid.map((one) => {
    const expected = one.packets + one.lost + (one.lost_at_edges ?? 0);
    const share = expected ? one.packets / expected : 1;
    return { ...one, share };
  });
  show(
    "completeness",
    element(
      "p",
      { class: "lead" },
      `${figure(found.packets)} of ${figure(found.expected)} packets expected, ${figure(found.lost)} lost in gaps, ` +
        `${figure(found.lost_at_edges)} at the edges of the pass, ${figure(found.duplicates)} repeated, ` +
        `${figure(found.conflicts)} in conflict, ${figure(found.crc_errors)} with a bad checksum; ` +
        `${figure(found.octets_skipped)} octets skipped, ${figure(found.symbols_corrected)} symbols corrected.`,
    ),
    table(
      "Packets by application process",
      [
        ["APID", (row) => `0x${row.apid.toString(16)}`],
        ["Packets of", (row) => words(row.name)],
        ["", (row) => element("meter", { min: 0, max: 1, low: 0.99, optimum: 1, value: row.share, "aria-label": `share of ${row.name} that came` })],
        ["Received", "packets"], "lost", "lost_at_edges", ["Repeated", "duplicates"], ["Bad checksum", "crc_errors"],
        ["Complete", (row) => `${(100 * row.share).toFixed(2)} %`, "num"],
      ],
      rows,
      "No packet of this pass was received.",
    ),
    receptionTable(found.receptions),
  );
}

const OPEN_RECEPTIONS = 8; // more are listed on request: a contact in progress is received in many parts

function receptionTable(receptions) {
  const listed = table(
    "Link quality by reception",
    [
      ["Station", (row) => row.station || "not stated"],
      ["First frame", (row) => (row.first_received ? timeText(row.first_received) : "unknown")],
      ["Last frame", (row) => (row.last_received ? timeText(row.last_received) : "unknown")],
      "frames", ["Good", "frames_good"], "symbols_corrected",
      ["Bit error rate", (row) => (row.bit_error_rate === null ? "unknown" : figure(row.bit_error_rate, 2)), "num"],
      "lock_losses", "octets", ["Outside frames", "octets_other"],
      ["Link settings", (row) => row.source],
    ],
    receptions,
    "No frames of this pass have been received.",
  );
  if (receptions.length <= OPEN_RECEPTIONS) return listed;
  const good = receptions.reduce((sum, row) => sum + row.frames_good, 0);
  const frames = receptions.reduce((sum, row) => sum + row.frames, 0);
  return element("details", {}, element("summary", {}, `Link quality: ${figure(receptions.length)} receptions, ${figure(good)} of ${figure(frames)} frames good`), listed);
}

const terrainOf = async (pass) => terrain(pass.mission_revision && (await get(`missions/${pass.mission_revision.slice(0, 16)}`)).document);

const CRATERS_SHOWN = 1000;

async function showTerrain(pass) {
  const [flown, craters] = await Promise.all([terrainOf(pass), get(`passes/${passId}/craters`, { limit: CRATERS_SHOWN })]);
  const map = moonMap(byId("map"), flown);
  craterRims(map, craters.items);
  const shown = craters.total > craters.items.length ? `the ${figure(craters.items.length)} largest of ${figure(craters.total)}` : figure(craters.total);
  byId("terrain").textContent = `${flown.text} ${craters.total ? `Circles: ${shown} craters of the catalogue of the pass.` : "The pass has no crater catalogue."}`;
  return map;
}

// Tracks lie on each other where the whole Moon is shown: wide ones below narrow ones, so that each is seen.
const trackWeight = (index, count) => 3 + 5 * (count - 1 - index);

async function showStates(pass, estimators) {
  const [map, ...answers] = await Promise.all([
    showTerrain(pass),
    ...estimators.map((name) => get(`passes/${passId}/states`, { estimator: name, value: STATES, max_points: 600 }).catch(() => null)),
  ]);
  const found = answers.filter((answer) => answer?.series[0].samples);
  const bounds = [];
  found.forEach((one, index) => {
    const [latitude, longitude] = one.series.map((series) => columns(series.buckets, seconds).mean);
    const css = solutionStyle(one.estimator).colour;
    const line = track(map, latitude, longitude, { color: css, weight: trackWeight(index, found.length), lineCap: "butt" });
    if (line.getLatLngs().length) bounds.push(line.getBounds());
    byId("map-legend").append(layerItem(map, line, one.estimator, css));
  });
  if (bounds.length) map.fitBounds(bounds.reduce((all, one) => all.extend(one)), { animate: false, maxZoom: 4, padding: [20, 20] });
  STATES.forEach((value, which) => {
    const unit = found[0]?.series[which].unit ?? "";
    const series = found.map((one) => ({
      label: one.estimator,
      ...solutionStyle(one.estimator),
      ...columns(one.series[which].buckets, seconds),
    }));
    if (series.length) chart(byId("navigation"), parameterName(value, unit), unitText(unit), series, { group: "pass" });
  });
  if (!found.length) show("navigation", element("p", { class: "hint" }, "No navigation states of this pass have come."));
}

let parameters = [];
async function showParameters() {
  const answer = await get(`passes/${passId}/parameters`);
  const { packets } = answer;
  ({ parameters } = answer);
  show("parameter", parameterOptions(parameters));
  byId("parameter").value = "temperature_c";
  bind("parameter");
  const file = (packet, format) => save(`passes/${passId}/packets/${encodeURIComponent(packet)}?format=${format}`, `pass-${passId}-${packet}.${format}`);
  const link = (packet, format) => button(format === "csv" ? "CSV" : "Parquet", () => file(packet, format), { needs: null });
  const columns = [["Packet", (row) => row.packet], ["Source", (row) => row.source], ["Packets", (row) => figure(row.packets), "num"], ["Files", (row) => element("span", {}, link(row.packet, "csv"), " ", link(row.packet, "parquet"))]];
  if (packets.length) show("packets", table("Packets that the mission description defines", columns, packets, "None."));
  await showParameter();
}

async function showParameter() {
  const chosen = parameters.find((one) => one.name === byId("parameter").value);
  show("housekeeping");
  if (chosen) await drawParameters(byId("housekeeping"), passId, [chosen], { group: "pass" });
}

let events = [];
function showEvents() {
  const chosen = byId("only-alarms").checked ? events.filter((one) => ["medium", "high"].includes(one.severity)) : events;
  showTable("events", "Events", ["time", "severity", ["Event", (row) => words(row.name)], "detail"], chosen, "None.");
}

async function showLatestReport(ids) {
  if (!ids.length) {
    show("verdict", element("p", { class: "hint" }, "No report has been made of this pass yet."));
    return;
  }
  const report = await get(`reports/${ids[0]}/overview`);
  showReport(report, ids[0]);
  showErrors(report);
}

on("make-report", "click", async () => {
  const job = await send("POST", `passes/${passId}/reports`);
  const bar = element("progress", { max: 1, value: 0, "aria-label": "report" });
  byId("report-links").replaceChildren(bar);
  await finished(job.id, (now) => (bar.value = now.progress));
  notice("The report is made.");
  const { reports } = await get(`passes/${passId}`);
  await showLatestReport(reports);
});
on("parameter", "change", showParameter);
bind("only-alarms");
byId("only-alarms").addEventListener("change", showEvents);

async function load() {
  const pass = await get(`passes/${passId}`);
  document.title = `${pass.name} · LINNA`;
  document.querySelector("h1").replaceWith(element("h1", {}, pass.name));
  byId("span").textContent =
    `${timeText(pass.start)} to ${timeText(pass.stop)}, ${lengthText(seconds(pass.stop) - seconds(pass.start))}, ` +
    `spacecraft ${pass.spacecraft_id} (${pass.instance})`;
  byId("all-events").href = `/events?spacecraft=${encodeURIComponent(`${pass.spacecraft_id} ${pass.instance}`)}`;
  show(
    "mission",
    pass.mission_revision
      ? ["Mission description: ", element("a", { href: `/missions/${pass.mission_revision.slice(0, 16)}` }, `${pass.mission}, revision ${pass.mission_revision.slice(0, 12)}`)]
      : element("strong", {}, "No mission description was registered when this pass was planned: nothing can be judged. Enter one with linna mission add, then define the pass again."),
  );
  const { scenario_toml: _, files: __, ...origin } = pass.manifest;
  show("origin", Object.keys(origin).length ? element("details", {}, element("summary", {}, "Manifest"), element("pre", {}, JSON.stringify(origin, null, 2))) : element("p", { class: "hint" }, "Defined by hand: no archive, no manifest."));
  await Promise.all([
    get(`passes/${passId}/completeness`).then(showCompleteness),
    showLatestReport(pass.reports),
    get(`passes/${passId}/events`, { limit: 1000 }).then((page) => {
      events = page.items;
      showEvents();
    }),
    showParameters(),
    showExports(),
    showStates(pass, dictionary.estimators),
  ]);
}

loading(load);
