import { finished, get, request, send } from "./api.js";
import { acting, byId, element, figure, notice, show, stateMark, table, timeText, trouble, watch } from "./page.js";

const LATEST = 12;
let open = null;

const buildName = (build) => `${build.name} ${build.version} (${build.digest.slice(0, 8)})`;

async function upload(path, file) {
  const answer = await request(path, { method: "POST", body: file, headers: { "Content-Type": "application/zip" } });
  return answer.json();
}

async function openReport(id) {
  const answer = await request(`regressions/${id}/report`);
  window.open(URL.createObjectURL(await answer.blob()), "_blank", "noopener");
}

function verdictOf(job, regression) {
  if (!regression) return stateMark(job.state);
  return stateMark({ pass: "passed", fail: "failed" }[regression.verdict] ?? regression.verdict);
}

function gateRows(regression) {
  const failed = regression.result.gates.filter((gate) => !gate.passed);
  return table(
    "Gates",
    [
      ["Gate", (row) => row.name.replaceAll("_", " ")],
      ["Baseline", (row) => figure(row.baseline), "num"],
      ["Candidate", (row) => figure(row.candidate), "num"],
      ["Limit", (row) => figure(row.limit), "num"],
      ["", (row) => stateMark(row.passed ? "passed" : "failed")],
    ],
    [...failed, ...regression.result.gates.filter((gate) => gate.passed)],
    "No gate could be judged.",
  );
}

async function loadRegressions() {
  const jobs = (await get("jobs", { limit: 500 })).items.filter((job) => job.kind === "regression").slice(0, LATEST);
  const found = await Promise.all(
    jobs.map(async (job) => ({ job, regression: job.state === "done" ? await get(`regressions/${job.id}`).catch(() => null) : null })),
  );
  show(
    "regressions",
    table(
      "Regressions",
      [
        ["Entered", (row) => timeText(row.job.created)],
        ["Candidate", (row) => String(row.job.arguments.candidate ?? "").slice(0, 12)],
        ["Baseline", (row) => String(row.job.arguments.baseline ?? "").slice(0, 12)],
        ["Verdict", (row) => verdictOf(row.job, row.regression)],
        ["", (row) => (row.job.state === "running" ? element("progress", { max: 1, value: row.job.progress, "aria-label": "regression" }) : (row.job.error ?? ""))],
        ["", (row) => (row.regression ? element("span", { class: "actions" }, element("button", { type: "button", onclick: () => toggle(row.job.id) }, "Gates"), element("button", { type: "button", onclick: acting(() => openReport(row.job.id)) }, "Report")) : "")],
      ],
      found,
      "No regression has been run.",
    ),
  );
  const shown = found.find((row) => row.job.id === open)?.regression;
  if (shown) byId("regressions").append(element("h3", {}, `Gates of ${timeText(shown.created)}`), gateRows(shown));
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
