import { finished, get, request, send } from "./api.js";
import { acting, byId, element, figure, notice, show, stateMark, table, timeText, trouble, watch } from "./page.js";

const LATEST = 12;
let open = null;

const buildName = (build) => `${build.name} ${build.version} (${build.digest.slice(0, 8)})`;

async function upload(path, file) {
  const answer = await request(path, { method: "POST", body: file, headers: { "Content-Type": "application/zip" } });
  return answer.json();
}

const verdictMark = (verdict) => stateMark({ pass: "passed", fail: "failed" }[verdict] ?? verdict);
const OUTCOMES = ["fail", "inconclusive", "pass"];

// What would decide an open gate, or why its outcome does not count.
function remarkOf(gate) {
  if (gate.waived) return `waived: ${gate.waived}`;
  if (gate.outcome !== "inconclusive") return gate.reason ?? "";
  if (gate.frames_needed == null) return gate.reason;
  return `${gate.reason}: ${figure(gate.frames_needed)} frames needed, ${figure(gate.frames)} compared`;
}

function gateRows(regression) {
  return table(
    "Gates",
    [
      ["Gate", (row) => row.name.replaceAll("_", " ")],
      ["Baseline", (row) => figure(row.baseline), "num"],
      ["Candidate", (row) => figure(row.candidate), "num"],
      ["Limit", (row) => figure(row.limit), "num"],
      ["Pass", (row) => row.pass ?? "all"],
      ["Outcome", (row) => verdictMark(row.outcome)],
      ["Remark", remarkOf],
    ],
    OUTCOMES.flatMap((outcome) => regression.result.gates.filter((gate) => gate.outcome === outcome)),
    regression.result.passes.map((pass) => `${pass.name}: ${pass.detail || pass.state}`).join("; ") || "No gate was judged.",
  );
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

function outcomeOf({ job, verdict }) {
  if (verdict && !verdict.gates) return "no gate was judged: see the report for the reason";
  if (verdict) {
    const open = verdict.gates_inconclusive ? `, ${figure(verdict.gates_inconclusive)} inconclusive` : "";
    const needed = verdict.frames_needed == null ? "" : `: ${figure(verdict.frames_needed)} frames needed, ${figure(verdict.frames)} compared`;
    return `${figure(verdict.gates_failed)} of ${figure(verdict.gates)} gates failed${open}${needed}`;
  }
  return job.state === "running" ? element("progress", { max: 1, value: job.progress, "aria-label": "regression" }) : (job.error ?? "");
}

async function loadRegressions() {
  const { rows, total } = await regressionRows();
  show(
    "regressions",
    table(
      "Regressions",
      [
        ["Entered", (row) => timeText(row.created)],
        ["Candidate", (row) => String(row.candidate ?? "").slice(0, 12)],
        ["Baseline", (row) => String(row.baseline ?? "").slice(0, 12)],
        ["Verdict", (row) => (row.verdict ? verdictMark(row.verdict.verdict) : stateMark(row.job.state))],
        ["Outcome", outcomeOf],
        ["", ({ verdict }) => (verdict ? element("span", { class: "actions" }, element("button", { type: "button", onclick: () => toggle(verdict.id) }, "Gates"), element("a", { class: "button", href: `/regressions/${verdict.id}`, target: "_blank" }, "Report")) : "")],
      ],
      rows,
      "No regression has been run.",
    ),
  );
  if (total > LATEST) byId("regressions").append(element("p", { class: "hint" }, `The ${LATEST} newest of ${figure(total)} verdicts.`));
  if (rows.some((row) => row.verdict?.id === open)) {
    const shown = await get(`regressions/${open}`);
    byId("regressions").append(element("h3", {}, `Gates of ${timeText(shown.created)}`), gateRows(shown));
  }
}

function toggle(id) {
  open = open === id ? null : id;
  loadRegressions().catch(trouble);
}

async function load() {
  const [builds, archives] = await Promise.all([get("builds", { limit: 200 }), get("regression-archives")]);
  const chosen = { candidate: byId("candidate").value, baseline: byId("baseline").value };
  const options = () => [element("option", { value: "current" }, "the build on this machine"), ...builds.items.map((build) => element("option", { value: build.digest }, buildName(build)))];
  for (const name of ["candidate", "baseline"]) {
    show(name, options());
    if (chosen[name]) byId(name).value = chosen[name];
  }
  show(
    "archives",
    archives.length
      ? archives.map((archive) => element("label", {}, element("input", { type: "checkbox", name: "archive", value: archive.digest, checked: true }), `${archive.name}, ${archive.frames} frames`))
      : element("p", { class: "hint" }, "None kept: bring a zipped pass archive below."),
  );
  show(
    "builds",
    table(
      "Builds",
      [
        ["Build", buildName],
        ["Kind", (row) => row.kind],
        ["What it is", (row) => row.description],
        ["Registered", (row) => `${timeText(row.registered)} by ${row.registered_by}`],
      ],
      builds.items,
      "No build registered.",
    ),
  );
  await loadRegressions();
}

byId("run").addEventListener(
  "submit",
  acting(async () => {
    const archives = [...document.querySelectorAll("input[name=archive]:checked")].map((box) => box.value);
    if (!archives.length) throw new Error("Choose at least one archive.");
    const job = await send("POST", "regressions", { candidate: byId("candidate").value, baseline: byId("baseline").value, archives });
    open = job.id;
    await loadRegressions();
    await finished(job.id);
    await loadRegressions();
    notice("The verdict is here.");
  }),
);
byId("bring").addEventListener(
  "submit",
  acting(async () => {
    const [file] = byId("zip").files;
    const kind = byId("zip-kind").value;
    const made = await upload(kind, file);
    notice(`${made.name} is ${kind === "builds" ? "registered" : "kept"}`);
    await load();
  }),
);

let pending = null;
watch((message) => {
  if (!message.kind.startsWith("job")) return;
  clearTimeout(pending);
  pending = setTimeout(() => loadRegressions().catch(trouble), 400);
});
load().catch((error) => error.status === 401 || trouble(error));
