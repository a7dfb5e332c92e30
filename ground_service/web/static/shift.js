// The shift: for each spacecraft its time, contact, windows with the step that waits, alarms, verdicts, note and hold.
import { finished, get, request, send } from "./api.js";
import { approve, chainOf, contactOf, inTime, uplink } from "./chain.js";
import { acting, button, buttons, byId, element, inTurn, lengthText, loading, missionNow, notice, on, parameterName, seconds, show, showTable, stateMark, table, textOf, timeText, watch } from "./page.js";

const OPEN = ["draft", "approved", "uplinked", "cancelling", "executing", "executed", "downlinked"];
const SHOWN = 5;
const DAY_S = 86400;

const alarmName = (alarm) => parameterName(alarm.name, alarm.unit);
const keyOf = (one) => `${one.spacecraft_id} ${one.instance}`;
const mine = (list, craft) => list.filter((one) => one.spacecraft_id === craft.spacecraft_id && (one.instance ?? "flight") === craft.instance);
const query = (craft) => `spacecraft/${craft.spacecraft_id}`;
const instance = (craft) => `?instance=${encodeURIComponent(craft.instance)}`;

const deed = (label, task, name = label) => button(label, () => task().then(load), { name });

const link = (href, text) => element("a", { href }, text);
const further = (...parts) => element("p", { class: "hint" }, parts.filter(Boolean).flatMap((one, index) => (index ? [" · ", one] : [one])));

const number = (label, value, note) =>
  element("div", {}, element("dt", {}, label), element("dd", { class: "number" }, value), element("dd", { class: "note" }, note));

function contactFigure(craft, data) {
  const contact = contactOf(craft, data.contacts.contacts);
  const reason = Object.values(data.contacts.unpredicted)[0];
  if (!mine(data.links, craft).length) return number("Contact", "none", "the mission description declares no link");
  if (!contact) return number("Contact", "none", reason ?? "no contact in the next two days");
  const open = contact.state === "open";
  const left = open ? contact.stop ?? contact.predicted_stop : contact.start;
  return number("Contact", open ? "now" : inTime(contact.start), `${contact.station}${left ? `, ${open ? "to" : "at"} ${timeText(left).slice(5, 16)}` : ""}`);
}

function ageFigure(newest, recorded) {
  const [last] = [...newest].sort((one, other) => one.age_s - other.age_s);
  if (last && recorded) return number("Data", "recorded", `data of ${last.time.slice(0, 10)}`);
  return last ? number("Age of data", lengthText(last.age_s), `newest telemetry of ${timeText(last.time)}`) : number("Age of data", "none", "no telemetry received");
}

function continuation(window, chain) {
  const named = (label) => `${label} ${window.name}`;
  if (chain.waiting === "approved") return deed("Approve…", () => approve(window), named("Approve"));
  if (chain.waiting === "released") return deed("Release…", () => uplink(window), named("Release"));
  if (chain.waiting === "sent") return deed("Send now…", () => uplink(window), named("Send"));
  if (chain.waiting === "reported" && window.pass_id) return deed("Make a report", () => send("POST", `passes/${window.pass_id}/reports`), named("Report"));
  return window.pass_id ? link(`/passes/${window.pass_id}`, "Pass") : link(`/planner?window=${window.id}`, "Plan");
}

function chainLights(chain) {
  const reached = chain.steps.filter((one) => one.state === "on").map((one) => one.step);
  return element(
    "ol",
    { class: "chain", "aria-label": `reached: ${reached.join(", ")}` },
    chain.steps.map((one) => element("li", { class: one.state, title: `${one.step}${one.note ? `, ${one.note}` : ""}` }, one.step)),
  );
}

function windowsOf(craft, data) {
  const contact = contactOf(craft, data.contacts.contacts);
  const rows = mine(data.windows, craft)
    .sort((a, b) => seconds(a.start) - seconds(b.start))
    .filter((one) => seconds(one.start) < missionNow() + DAY_S)
    .map((window) => ({ window, chain: chainOf(window, data.telecommands.filter((one) => one.window_id === window.id), contact) }));
  const hidden = rows.length - SHOWN;
  return [
    table(
      "Windows of the next day",
      [
        ["Window", ({ window }) => element("a", { href: `/planner?window=${window.id}` }, window.name)],
        ["Start", ({ window }) => timeText(window.start).slice(5, 16)],
        ["Chain", ({ chain }) => [chainLights(chain), element("span", { class: "note" }, chain.text)]],
        ["", ({ window, chain }) => continuation(window, chain)],
      ],
      rows.slice(0, SHOWN),
      "No window begins within a day.",
    ),
    further(hidden > 0 ? `${hidden} more` : null, link("/planner", "Planner"), link("/commands", "Commands")),
  ];
}

function alarmsOf(craft, data) {
  const open = mine(data.alarms, craft).filter((one) => one.state !== "shelved");
  const acknowledge = (row) => (row.state === "raised" ? deed("Acknowledge", () => send("POST", `alarms/${row.id}/acknowledge`, {}), `Acknowledge ${alarmName(row)}`) : `by ${row.acknowledged_by}`);
  return table(
    "Open alarms",
    [
      ["Alarm", (row) => element("a", { href: `/alarms?alarm=${row.id}` }, alarmName(row))],
      ["Since", (row) => timeText(row.first).slice(5, 16)],
      "severity",
      ["", acknowledge],
    ],
    open.slice(0, SHOWN),
    "None.",
  );
}

function verdictsOf(craft, data) {
  return table(
    "Last verdicts",
    [
      ["Pass", (row) => element("a", { href: `/passes/${row.id}` }, row.name)],
      ["Verdict", (row) => { const found = data.reports.find((one) => one.pass_id === row.id); return found ? [stateMark(found.verdict_level), " ", element("span", { class: "note" }, found.verdict)] : "no report"; }],
      ["", (row) => { const found = data.reports.find((one) => one.pass_id === row.id); return found ? element("a", { href: `/reports/${found.id}`, target: "_blank" }, "Report") : ""; }],
    ],
    data.passes.filter((one) => one.spacecraft_id === craft.spacecraft_id).slice(0, 3), // emulated and replayed ones too
    "No pass yet: upload a downlink below, or use linna ingest.",
  );
}

// The note, and what is switched off: the hold and shelved alarms.
function handoverOf(craft, data) {
  const found = mine(data.handovers, craft)[0] ?? { note: "", held_by: null };
  const shelved = mine(data.alarms, craft).filter((one) => one.state === "shelved");
  const note = element("textarea", { rows: 2, maxlength: 2000, "aria-label": `Note for the next shift, spacecraft ${keyOf(craft)}` }, found.note);
  const overrides = [
    found.held_by ? `hold by ${found.held_by} since ${timeText(found.held)}: ${found.hold_reason}` : null,
    ...shelved.map((one) => `alarm ${alarmName(one)} shelved by ${one.shelved_by} until ${timeText(one.shelved_until)}`),
  ].filter(Boolean);
  return [
    element(
      "form",
      { class: "handover", onsubmit: acting(async () => { await send("PUT", `${query(craft)}/handover${instance(craft)}`, { note: note.value }); notice("The note is kept."); await load(); }) },
      note,
      element("span", { class: "actions" }, element("button", { "data-needs": "operator" }, "Keep the note"), element("span", { class: "note" }, found.noted_by ? `${timeText(found.noted)} by ${found.noted_by}` : "no note yet")),
    ),
    element("p", { class: "hint" }, overrides.length ? "Overrides in force:" : "No override is in force."),
    overrides.length ? element("ul", { class: "reasons" }, overrides.map((one) => element("li", {}, one))) : null,
  ];
}

function holdOf(craft, data) {
  const found = mine(data.handovers, craft)[0];
  const path = `${query(craft)}/hold${instance(craft)}`;
  if (found?.held_by) {
    return element("p", { class: "conflicts held" }, element("strong", {}, "On hold"), ` by ${found.held_by} since ${timeText(found.held)}: ${found.hold_reason}. No telecommand is released or sent. `, deed("Resume", () => send("DELETE", path), `Resume ${keyOf(craft)}`));
  }
  const reason = element("input", { placeholder: "reason", required: true, maxlength: 500, "aria-label": `Reason of the hold, spacecraft ${keyOf(craft)}` });
  return element(
    "form",
    { class: "hold", "data-needs": "operator", onsubmit: acting(async () => { await send("POST", path, { reason: reason.value }); await load(); }) },
    reason,
    element("button", { "aria-label": `Hold ${keyOf(craft)}` }, "Hold"),
  );
}

function spacecraftOf(craft, data, newest) {
  const next = mine(data.windows, craft).filter((one) => seconds(one.stop) > missionNow()).sort((a, b) => seconds(a.start) - seconds(b.start))[0];
  const part = (heading, ...content) => element("section", {}, element("h3", {}, heading), ...content);
  return element(
    "section",
    { class: "craft", "aria-label": `Spacecraft ${keyOf(craft)}` },
    element("div", { class: "head" }, element("h2", { title: keyOf(craft) }, craft.name ?? `Spacecraft ${craft.spacecraft_id}`), holdOf(craft, data)),
    data.recorded ? element("p", {}, "A finished recording. Next step: open its ", link(data.passes.length ? `/passes/${data.passes[0].id}` : "/passes", "pass"), " and report, then plan an observation window in the ", link("/planner", "planner"), ".") : null,
    element(
      "dl",
      { class: "glance" },
      contactFigure(craft, data),
      next ? number("Next window", seconds(next.start) <= missionNow() ? "now" : inTime(next.start), next.name) : number("Next window", "none", "no window planned"),
      ageFigure(newest, data.recorded),
      number("Open alarms", String(mine(data.alarms, craft).filter((one) => one.state !== "shelved").length), "raised or acknowledged"),
    ),
    element(
      "div",
      { class: "columns shift" },
      element("div", {}, part("Windows of the next day", ...windowsOf(craft, data))),
      element("div", {}, part("Open alarms", alarmsOf(craft, data), further(link("/alarms", "All alarms"), link("/events", "Events"), link("/telemetry", "Telemetry"))), part("Last verdicts", verdictsOf(craft, data), further(link("/passes", "All passes"), link("/passes#monthly", "Monthly reports"), link("/regression", "Builds and gates"))), part("Handover", ...handoverOf(craft, data))),
    ),
  );
}

function showJobs(jobs) {
  const running = jobs.filter((job) => ["queued", "running"].includes(job.state)).length;
  const failed = jobs.filter((job) => job.state === "failed").length;
  byId("jobs-count").textContent = `${running} under way, ${failed} of the latest failed`;
  if (failed) byId("work").open = true;
  const progress = (row) => (row.state === "running" ? element("progress", { max: 1, value: row.progress, "aria-label": row.kind }) : stateMark(row.state));
  const named = (label, row) => `${label} ${row.kind} of ${timeText(row.created)}`;
  const repeat = (row) => (row.state === "failed" ? buttons(deed("Repeat", () => send("POST", `jobs/${row.id}/repeat`), named("Repeat", row)), deed("Dismiss", () => send("DELETE", `jobs/${row.id}`), named("Dismiss", row))) : "");
  showTable("jobs", "Jobs", [["Job", "kind"], ["Entered", "created"], ["State", progress], ["", "error"], ["", repeat]], jobs, "None.");
}

let pressEnded = null;
document.addEventListener("pointerdown", () => {
  pressEnded = new Promise((resolve) => ["pointerup", "pointercancel"].forEach((name) => document.addEventListener(name, () => setTimeout(resolve), { once: true })));
});

const load = inTurn(async () => {
  const { recorded } = await get("session");
  const [spacecraft, windows, links, contacts, alarms, passes, handovers, jobs] = await Promise.all([
    get("spacecraft"),
    get("windows", { limit: 100, state: OPEN }),
    get("links"),
    get("contacts", { since: new Date(1000 * (missionNow() - 3600)).toISOString() }),
    get("alarms", { limit: 50, state: ["raised", "acknowledged", "shelved"] }),
    get("passes", { limit: 30 }),
    get("handovers"),
    get("jobs", { limit: 8 }),
  ]);
  const ids = windows.items.map((one) => one.id);
  const passIds = passes.items.map((one) => one.id);
  // The flown one of each spacecraft; a spacecraft of archives alone is shown in one of its instances. Flown ones come first.
  const known = (one) => spacecraft.items.filter((other) => other.spacecraft_id === one.spacecraft_id);
  const crafts = [...new Map(spacecraft.items.toReversed().map((one) => [one.spacecraft_id, one])).values()].reverse().map((one) => ({ ...one, name: one.name ?? known(one).at(-1).name }));
  const sources = crafts.map((one) => (recorded ? known(one).at(-1) : one)); // of values
  const [telecommands, reports, ...newest] = await Promise.all([
    ids.length ? get("telecommands", { limit: 1000, window_id: ids }) : { items: [] },
    passIds.length ? get("reports", { pass_id: passIds }) : { items: [] },
    ...sources.map((one) => get("parameters", { live: true, spacecraft_id: one.spacecraft_id, instance: one.instance }).then((answer) => answer.items)),
  ]);
  const data = { recorded, windows: windows.items, links: links.items, contacts, alarms: alarms.items, passes: passes.items, handovers: handovers.items, telecommands: telecommands.items, reports: reports.items };
  await pressEnded; // a button that is drawn again while it is pressed is not clicked
  show("spacecraft", crafts.length ? crafts.map((craft, index) => spacecraftOf(craft, data, newest[index])) : element("p", { class: "hint" }, "No spacecraft yet: register a mission description on the page ", element("a", { href: "/missions" }, "Missions"), ", or upload a downlink."));
  showJobs(jobs.items);
});

on("upload", "submit", async () => {
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
});

watch((message) => {
  byId("feed").prepend(element("li", { value: message.sequence }, `${timeText(message.time)} ${message.kind}: ${textOf(message.payload)}`));
  while (byId("feed").children.length > 50) byId("feed").lastChild.remove();
});
loading(load, () => true);
