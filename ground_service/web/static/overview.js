import { finished, get, request, send } from "./api.js";
import { acting, byId, element, figure, notice, parameterName, show, stateMark, table, timeText, trouble, watch } from "./page.js";

const number = (label, value, note) =>
  element("div", {}, element("dt", {}, label), element("dd", { class: "number" }, value), element("dd", { class: "note" }, note));

const alarmName = (alarm) => parameterName(alarm.name, alarm.unit);

function repeatButton(row) {
  const made = element("button", { type: "button", "data-needs": "operator", "aria-label": `Repeat ${row.kind} of ${timeText(row.created)}` }, "Repeat");
  made.addEventListener(
    "click",
    acting(async () => {
      await send("POST", `jobs/${row.id}/repeat`);
      await load();
    }),
  );
  return made;
}

async function load() {
  const [passes, windows, jobs, alarms] = await Promise.all([
    get("passes", { limit: 8 }),
    get("windows", { limit: 8 }),
    get("jobs", { limit: 8 }),
    get("alarms", { limit: 8, state: ["raised", "acknowledged"] }),
  ]);
  const running = jobs.items.filter((job) => ["queued", "running"].includes(job.state)).length;
  const failed = jobs.items.filter((job) => job.state === "failed").length;
  show("glance", [
    number("Passes", figure(passes.total), passes.items.length ? `latest ${timeText(passes.items[0].start)}` : "none yet"),
    number("Windows", figure(windows.total), `${windows.items.filter((one) => one.state === "draft").length} of the latest are drafts`),
    number("Open alarms", figure(alarms.total), alarms.total ? `latest: ${alarmName(alarms.items[0])}` : "none"),
    number("Jobs under way", figure(running), failed ? `${failed} of the latest failed` : "none of the latest failed"),
  ]);
  show(
    "passes",
    table(
      "Latest passes",
      [
        ["Pass", (row) => element("a", { href: `/passes/${row.id}` }, row.name)],
        ["Start", (row) => timeText(row.start)],
        ["Stop", (row) => timeText(row.stop)],
      ],
      passes.items,
      "No pass yet: bring in a downlink below, or with linna ingest.",
    ),
  );
  show(
    "windows",
    table(
      "Windows",
      [
        ["Window", (row) => element("a", { href: `/planner#window-${row.id}` }, row.name)],
        ["Start", (row) => timeText(row.start)],
        ["State", (row) => stateMark(row.state)],
      ],
      windows.items,
      "No window planned.",
    ),
  );
  show(
    "alarms",
    table(
      "Open alarms",
      [
        ["Alarm", alarmName],
        ["Last", (row) => timeText(row.last)],
        ["Severity", (row) => stateMark(row.severity)],
        ["State", (row) => stateMark(row.state)],
      ],
      alarms.items,
      "None.",
    ),
  );
  show(
    "jobs",
    table(
      "Jobs",
      [
        ["Job", (row) => row.kind],
        ["Entered", (row) => timeText(row.created)],
        ["State", (row) => (row.state === "running" ? element("progress", { max: 1, value: row.progress, "aria-label": row.kind }) : stateMark(row.state))],
        ["", (row) => row.error ?? ""],
        ["", (row) => (row.state === "failed" ? repeatButton(row) : "")],
      ],
      jobs.items,
      "None.",
    ),
  );
}

byId("upload").addEventListener(
  "submit",
  acting(async () => {
    const [file] = byId("file").files;
    const kind = byId("kind").value;
    const answer = await request(`${kind}?name=${encodeURIComponent(file.name)}`, {
      method: "POST",
      body: file,
      headers: { "Content-Type": "application/octet-stream" },
    });
    const accepted = await answer.json();
    if (kind === "telemetry") {
      const bar = byId("upload-progress");
      bar.hidden = false;
      await finished(accepted.job_id, (job) => (bar.value = job.progress)).finally(() => (bar.hidden = true));
      notice(`${file.name}: ingested`);
    } else {
      notice(`${file.name}: ${accepted.states} states from ${timeText(accepted.start)} to ${timeText(accepted.stop)}`);
    }
    await load();
  }),
);

let pending = null;
watch((message) => {
  const words = Object.entries(message.payload)
    .map(([key, value]) => `${key.replaceAll("_", " ")} ${typeof value === "object" ? JSON.stringify(value) : value}`)
    .join(", ");
  byId("feed").prepend(element("li", { value: message.sequence }, `${timeText(message.time)} ${message.kind}: ${words}`));
  while (byId("feed").children.length > 50) byId("feed").lastChild.remove();
  clearTimeout(pending);
  pending = setTimeout(() => load().catch(trouble), 400);
});

load().catch((error) => error.status === 401 || trouble(error));
