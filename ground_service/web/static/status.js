import { get } from "./api.js";
import { byId, element, lengthText, loading, plural, show, showTable, timeText } from "./page.js";

const PERIOD_MS = 15000;
const gibibytes = (octets) => `${(octets / 2 ** 30).toFixed(1)} GiB`;
const counts = (states) =>
  Object.entries(states)
    .map(([state, count]) => `${count} ${state}`)
    .join(", ") || "none";

// What needs attention: complaints of the service, alarms that nobody has acknowledged, and a backup that is not known.
function draw(status, raised) {
  const complaints = [
    raised ? element("a", { href: "/alarms?state=raised" }, `${plural(raised, "alarm")} not acknowledged.`) : null,
    ...status.complaints,
    status.backup_age_s === null && !status.complaints.some((text) => text.includes("backup")) ? "No backup is known." : null,
  ].filter(Boolean);
  byId("asked").textContent = `At ${timeText(status.time)}; the page asks again every ${PERIOD_MS / 1000} s.`;
  show(
    "complaints",
    complaints.length
      ? element("ul", {}, complaints.map((text) => element("li", {}, text)))
      : element("p", {}, "Nothing."),
  );
  const rows = [
    ["Jobs", counts(status.jobs)],
    ["Oldest job that waits", status.queue_age_s ? lengthText(status.queue_age_s) : "none waits"],
    ["Ingests", counts(status.ingests)],
    ["Oldest unfinished ingest", status.ingest_lag_s ? lengthText(status.ingest_lag_s) : "none"],
    ["Free disk space of the archive", `${gibibytes(status.disk_free_octets)} of ${gibibytes(status.disk_octets)}`],
    ["Newest backup", status.backup_age_s === null ? "unknown" : `${lengthText(status.backup_age_s)} ago`],
    ["Recurring work is done by", status.scheduler ?? "no process"],
  ];
  showTable("figures", "Figures", [["Figure", "0"], ["Value", "1"]], rows, "");
  const made = (row) => `${lengthText(row.age_s)} ago`;
  showTable("correlations", "Time correlations", ["spacecraft_id", "instance", ["Made", made]], status.correlations, "No time correlation.");
}

async function load() {
  const [status, raised] = await Promise.all([get("status"), get("alarms", { state: "raised", limit: 1 })]);
  draw(status, raised.total);
}

loading(load);
setInterval(() => loading(load), PERIOD_MS);
