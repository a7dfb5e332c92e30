import { keep, restore, state, stated } from "./address.js";
import { finished, get, request, send } from "./api.js";
import { button, buttons, byId, element, figure, inTurn, later, loading, notice, on, show, showTable, stateMark, table, timeText, trouble, watch, words } from "./page.js";

const LATEST = 12;
let open = stated("gates");

const buildName = (build) => `${build.name} ${build.version} (${build.digest.slice(0, 8)})`;

async function upload(path, file) {
  const answer = await request(path, { method: "POST", body: file, headers: { "Content-Type": "application/zip" } });
  return answer.json();
}

const OUTCOMES = ["fail", "inconclusive", "not judged", "pass", "informs"];

// What would decide an open gate.
function remarkOf(gate) {
  const reasons = [gate.reason, gate.evidence].filter(Boolean).join(", ");
  if (gate.outcome !== "inconclusive" || gate.frames_needed == null) return reasons;
  return `${reasons}: about ${figure(gate.frames_needed)} frames decide, ${figure(gate.frames)} compared`;
}

function gateRows(regression) {
  return table(
    regression.result.headline || "Gates",
    [
      ["Gate", (row) => words(row.name)],
      "baseline", "candidate", "limit",
      ["Pass", (row) => row.pass ?? "all"],
      "outcome",
      ["Remark", remarkOf],
    ],
    OUTCOMES.flatMap((outcome) => regression.result.gates.filter((gate) => gate.outcome === outcome)),
    regression.result.passes.map((pass) => `${pass.name}: ${pass.detail || pass.state}`).join("; ") || "No gate was judged.",
  );
}

// Parts of the report: craters lost and gained, the worst tracks with what both builds detect, the first different frame.
const PARTS = ["Craters that changed", "Passes"];

async function changesOf(id) {
  const text = await (await request(`regressions/${id}/report`)).text();
  const place = element("div", { class: "report" });
  const styles = [];
  let wanted = false;
  for (const one of new DOMParser().parseFromString(text, "text/html").querySelectorAll("main > *")) {
    const part = one.localName === "h2" ? one.lastChild.textContent : null;
    wanted = part ? PARTS.includes(part) : wanted;
    if (!wanted) continue;
    // The policy of pages permits no style attributes: each style is set on its element.
    for (const each of one.querySelectorAll("[style]")) {
      styles.push([each, each.getAttribute("style")]);
      each.removeAttribute("style");
    }
    if (!part) Object.assign(one, { tabIndex: 0, role: "group", ariaLabel: one.querySelector("caption, figcaption")?.textContent }); // it may scroll
    place.append(part ? element("h3", {}, part) : one);
  }
  for (const [each, css] of styles) each.style.cssText = css;
  return place;
}

// Verdicts that are there, and above them the jobs that have none: on their way, or failed.
async function regressionRows() {
  const [verdicts, jobs] = await Promise.all([get("regressions", { limit: LATEST }), get("jobs", { kind: "regression", limit: LATEST })]);
  const waiting = jobs.items.filter((job) => job.state !== "done");
  const rows = [
    ...waiting.map((job) => ({ created: job.created, candidate: job.arguments.candidate, baseline: job.arguments.baseline, job })),
    ...verdicts.items.map((item) => ({ ...item, verdict: item })),
  ];
  return { rows: rows.sort((a, b) => b.created.localeCompare(a.created)), total: verdicts.total };
}

// The first line of the verdict, and why it is not pass.
function outcomeOf({ job, verdict }) {
  if (!verdict) return job.state === "running" ? element("progress", { max: 1, value: job.progress, "aria-label": "regression" }) : (job.error ?? "");
  const counts = `${figure(verdict.gates_failed)} of ${figure(verdict.gates)} gates failed${verdict.gates_inconclusive ? `, ${figure(verdict.gates_inconclusive)} inconclusive` : ""}`;
  const needed = verdict.frames_needed == null ? null : `${figure(verdict.frames_needed)} frames needed, ${figure(verdict.frames)} compared`;
  const reasons = [...(needed ? [needed] : []), ...verdict.reasons];
  return [
    element("span", {}, verdict.headline || (verdict.gates ? counts : "No gate was judged.")),
    reasons.length ? element("ul", { class: "reasons" }, reasons.map((one) => element("li", {}, words(one)))) : null,
  ].filter(Boolean);
}

// Jobs have identities only; the list of builds has their names.
let builds = [];
const titleOf = (row, role) => row[`${role}_title`] ?? builds.filter((one) => one.digest === row[role]).map(buildName)[0] ?? String(row[role] ?? "").slice(0, 12);

async function openedGates() {
  const [verdict, changes] = await Promise.all([get(`regressions/${open}`), changesOf(open)]);
  return [element("h3", {}, `Gates of ${timeText(verdict.created)}`), gateRows(verdict), changes];
}

const loadRegressions = inTurn(async () => {
  const { rows, total } = await regressionRows();
  const opened = rows.some((row) => row.verdict?.id === open) ? await openedGates() : null;
  const actions = ({ verdict }) => verdict && buttons(button("Gates and craters", () => toggle(verdict.id), { needs: null }), element("a", { class: "button", href: `/regressions/${verdict.id}`, target: "_blank" }, "Report"));
  const columns = [
    ["Candidate", (row) => [titleOf(row, "candidate"), element("p", { class: "hint" }, `against ${titleOf(row, "baseline")}, ${timeText(row.created)}`)]],
    ["Verdict", (row) => [stateMark(row.verdict?.verdict ?? row.job.state), actions(row)].filter(Boolean)],
    ["Outcome", outcomeOf],
  ];
  show(
    "regressions",
    table("Regressions", columns, rows, "No regression has been run."),
    total > LATEST ? element("p", { class: "hint" }, `The ${LATEST} newest of ${figure(total)} verdicts.`) : null,
    opened,
  );
});

function toggle(id) {
  open = open === id ? null : id;
  state({ gates: open });
  return loadRegressions();
}

// Without frames the detector is not judged: such an archive is chosen only on purpose.
const archiveChoice = (archive) => {
  const pass = archive.pass_id === null ? null : [", ", element("a", { href: `/passes/${archive.pass_id}` }, `pass ${archive.pass_id}`)];
  const without = archive.state === "telemetry only";
  const what = `${archive.name}, ${archive.frames} frames`;
  return element("label", {}, element("input", { type: "checkbox", name: "archive", value: archive.digest, checked: !without }), element("span", {}, what, pass, without ? `: ${archive.state}, ${archive.reason}` : null));
};

// A pass is replayed from its archive: one without a kept archive is listed with what to do.
const passWithout = (pass) =>
  element("label", {}, element("input", { type: "checkbox", disabled: true }), element("span", {}, element("a", { href: `/passes/${pass.id}` }, `pass ${pass.id}, ${pass.name}`), ": no archive is kept; upload it below"));

async function load() {
  const [found, archives, passes, calibrations] = await Promise.all([get("builds", { limit: 200 }), get("regression-archives"), get("passes", { limit: 200 }), get("calibrations")]);
  builds = found.items;
  const chosen = { candidate: byId("candidate").value, baseline: byId("baseline").value };
  for (const name of ["candidate", "baseline"]) {
    show(name, element("option", { value: "current" }, "current, the installed flight code"), builds.map((one) => element("option", { value: one.digest }, buildName(one))));
    byId(name).value = chosen[name] || "current";
    restore(name);
  }
  const kept = new Set(archives.map((one) => one.pass_id));
  const without = passes.items.filter((one) => !kept.has(one.id));
  show("archives", archives.map(archiveChoice), without.map(passWithout), archives.length + without.length ? null : element("p", { class: "hint" }, "None: upload a zipped pass archive below."));
  const registered = (row) => `${timeText(row.registered)} by ${row.registered_by}`;
  showTable("builds", "Builds", [["Build", buildName], "kind", "description", ["Registered", registered]], builds, "No build registered.");
  showTable(
    "placebos",
    "Placebos",
    [
      ["Gate", (row) => words(row.metric)],
      ["Passes", (row) => row.condition || "all"],
      ["Rejected", (row) => `${figure(row.rejected)} of ${figure(row.placebos)}`, "num"],
      ["Allowed share", "level"],
      "spread",
      ["State", (row) => stateMark(row.calibrated ? "calibrated" : "uncalibrated")],
    ],
    calibrations,
    "No placebo has been run.",
  );
  await loadRegressions();
}

on("run", "submit", async () => {
  const archives = [...document.querySelectorAll("input[name=archive]:checked")].map((box) => box.value);
  if (!archives.length) throw new Error("Choose at least one archive.");
  const job = await send("POST", "regressions", { candidate: byId("candidate").value, baseline: byId("baseline").value, archives });
  open = job.id;
  await loadRegressions();
  await finished(job.id);
  await loadRegressions();
  notice("The regression is complete.");
});
on("bring", "submit", async () => {
  const [file] = byId("zip").files;
  const kind = byId("zip-kind").value;
  const made = await upload(kind, file);
  notice(`${made.name} is ${kind === "builds" ? "registered" : "kept"}`);
  await load();
});

watch(later(loadRegressions, (message) => message.kind.startsWith("job")), loadRegressions);
for (const name of ["candidate", "baseline"]) byId(name).addEventListener("change", () => keep(name));
loading(load);
