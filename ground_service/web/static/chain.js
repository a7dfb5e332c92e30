// Chain of a planned window: the steps that it has reached, the one that it waits for, and what continues it.
import { get, send } from "./api.js";
import { confirmed, figure, isoText, lengthText, missionNow, notice, seconds, table, timeText, words } from "./page.js";

export const STEPS = ["requested", "approved", "released", "sent", "accepted", "executed", "received", "reported"];
const VERIFIED = ["accepted", "started", "completed"];
const AFTER = ["executing", "executed", "downlinked", "processed"];

const latest = (times) => times.filter(Boolean).sort().at(-1) ?? null;
const who = (name, time) => [time && timeText(time), name && `by ${name}`].filter(Boolean).join(" ");
export function inTime(time) {
  const wait = seconds(time) - missionNow();
  const minutes = Math.abs(Math.ceil(wait / 60));
  const text = minutes < 60 ? `${minutes} min` : lengthText(60 * minutes);
  return wait > 0 ? `in ${text}` : `since ${text}`;
}

// `sent` are the telecommands that carry the window up. Returns steps with their state, the step that waits and why.
export function chainOf(window, telecommands, contact) {
  const carriers = telecommands.filter((one) => one.carrier_id === null && one.state !== "rejected");
  const all = (reached) => carriers.length > 0 && carriers.every(reached);
  const begun = AFTER.includes(window.state);
  const reached = {
    requested: true,
    approved: window.state !== "draft" && !(window.state === "failed" && !carriers.length && !window.decided_by),
    released: begun || all((one) => one.decided !== null),
    sent: begun || all((one) => one.sent !== null),
    accepted: begun || all((one) => VERIFIED.includes(one.state)),
    executed: ["executed", "downlinked", "processed"].includes(window.state),
    received: ["downlinked", "processed"].includes(window.state),
    reported: window.state === "processed",
  };
  const notes = {
    requested: who(window.created_by, window.created),
    approved: who(window.decided_by, null),
    released: who(carriers[0]?.decided_by, latest(carriers.map((one) => one.decided))),
    sent: who(null, latest(carriers.map((one) => one.sent))),
    accepted: `${carriers.filter((one) => VERIFIED.includes(one.state)).length} of ${carriers.length} telecommands`,
    executed: `${timeText(window.start)} to ${timeText(window.stop)}`,
    received: window.pass_id ? `pass ${window.pass_id}` : "",
    reported: "",
  };
  const waiting = STEPS.find((step) => !reached[step]) ?? null;
  const over = seconds(window.stop) <= missionNow();
  const reasons = {
    approved: "waits for approval",
    released: "waits for the release of its telecommands",
    sent: contact ? `waits for transmission, next contact ${inTime(contact.start)}` : "waits for transmission, no contact predicted",
    accepted: "waits for verification reports",
    executed: window.state === "executing" || over ? "waits for telemetry from after its end" : `begins ${inTime(window.start)}`,
    received: "waits for the rest of its telemetry",
    reported: "waits for its report",
  };
  const failed = window.state === "failed";
  const why = window.reason ?? (failed ? "failed" : null);
  return {
    steps: STEPS.map((step) => ({ step, note: notes[step], state: reached[step] ? "on" : step === waiting ? (failed ? "bad" : "now") : "" })),
    waiting: failed ? null : waiting,
    text: failed ? `failed: ${why}` : waiting ? [reasons[waiting], why].filter(Boolean).join("; ") : "reported",
  };
}

// The contact of a spacecraft now, otherwise the next one.
export function contactOf(craft, contacts) {
  const now = missionNow();
  const ahead = contacts.filter((one) => one.spacecraft_id === craft.spacecraft_id && (one.state === "open" || (one.state === "predicted" && seconds(one.stop) > now)));
  return ahead.find((one) => one.state === "open") ?? ahead.sort((a, b) => seconds(a.start) - seconds(b.start))[0] ?? null;
}

// The link that sends to a spacecraft: that of its contact, otherwise one that works.
export function uplinkOf(craft, links, contact) {
  const able = links.filter((one) => one.uplink && one.spacecraft_id === craft.spacecraft_id && one.instance === craft.instance);
  return able.find((one) => one.name === contact?.link) ?? able.find((one) => one.state !== "failed") ?? able[0] ?? null;
}

const named = (one) => `${words(one.name)}${one.text ? `: ${one.text}` : ""}`;

// Telecommands of a window with their times, before their release.
export const sequenceTable = (planned) =>
  table("Telecommands of the window", [["On board", (row) => (row.time ? timeText(row.time) : "on reception")], ["Telecommand", named]], planned, "None.");

const SEND = "Release and send";

export async function order(link) {
  await send("POST", `links/${encodeURIComponent(link.name)}/send`);
  notice(`Link ${link.name} sends what is released.`);
}

const spanText = (window) => `${timeText(window.start)} to ${timeText(window.stop)}, an image every ${figure(window.cadence_s)} s.`;

// Approve a window, after a question: the planner may release its telecommands at once.
export async function approve(window) {
  const lines = [spanText(window), "Back to draft takes this back until its telecommands are sent."];
  if (await confirmed(`Approve ${window.name}?`, lines, "Approve")) await send("PATCH", `windows/${window.id}`, { state: "approved" });
}

// Take a window back: from the plan, or from the spacecraft.
export async function takeBack(window) {
  const onBoard = "Its activities are on board: telecommands that delete them are released now, and sent in the next contact. It is cancelling until they are verified.";
  const lines = [spanText(window), window.state === "approved" ? "Its telecommands are withdrawn." : onBoard];
  if (await confirmed(`Take ${window.name} back?`, lines, "Take back")) await send("PATCH", `windows/${window.id}`, { state: "failed", reason: "cancelled" });
}

// Release the telecommands of a window after a look at them, and send them with `others` where that is chosen.
async function release(window, link, isOpen, others) {
  const { items } = await get(`windows/${window.id}/telecommands`);
  const deeds = [isOpen ? null : "Release", isOpen || link?.send === "manual" ? SEND : null].filter(Boolean);
  const also = `Link ${link?.name} is ${isOpen ? "" : "not "}in contact. ${SEND} also sends what is released already: ${others.join("; ") || "nothing"}.`;
  const then = deeds.includes(SEND) ? also : link ? `Link ${link.name} sends them in its next contact.` : "They wait for Send now.";
  const lines = [spanText(window), sequenceTable(items), then];
  const chosen = await confirmed(`Release the telecommands of ${window.name}?`, lines, ...deeds);
  if (!chosen) return;
  const released = await send("POST", `windows/${window.id}/uplink`);
  notice(`${window.name}: ${released.items.length} telecommands released`);
  if (chosen === SEND) await order(link);
}

// Release the telecommands of a window, or send what is released.
export async function uplink(window) {
  const [links, ahead, released] = await Promise.all([get("links"), get("contacts", { since: isoText(missionNow() - 3600) }), get("telecommands", { limit: 200, state: "released" })]);
  const contact = contactOf(window, ahead.contacts);
  const link = uplinkOf(window, links.items, contact);
  const waiting = released.items.filter((one) => one.spacecraft_id === window.spacecraft_id && one.instance === window.instance && one.carrier_id === null);
  const listed = waiting.map((one) => `${one.id}  ${named(one)}${one.window_id ? `, window ${one.window_id}` : ""}`).reverse();
  if (!window.telecommands.length) return release(window, link, contact?.state === "open" && contact.link === link?.name, listed);
  if (!link) throw new Error("No link can send: linna command uplink writes the octets to a file.");
  if (!listed.length) throw new Error("No telecommand is released: those in the queue wait for a second person, see Commands.");
  if (await confirmed(`Send ${listed.length} telecommands over ${link.name} now?`, listed, "Send")) await order(link);
}
