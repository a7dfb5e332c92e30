// Chain of a planned window: the steps that it has reached, the one that it waits for, and what continues it.
import { get, send } from "./api.js";
import { confirmed, figure, lengthText, missionNow, notice, seconds, table, timeText, words } from "./page.js";

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

// Release the telecommands of a window after a look at them; in a contact they are sent as well.
export async function release(window, link, contact) {
  const { items } = await get(`windows/${window.id}/telecommands`);
  const now = link !== null && contact?.state === "open" && contact.link === link.name;
  const then = now ? `Link ${link.name} is in contact and sends them with what else is released.` : link?.send === "automatic" ? `Link ${link.name} sends them in its next contact.` : "They wait for Send now.";
  const lines = [`${timeText(window.start)} to ${timeText(window.stop)}, an image every ${figure(window.cadence_s)} s.`, sequenceTable(items), then];
  if (!(await confirmed(`Release the telecommands of ${window.name}?`, lines, now ? "Release and send" : "Release"))) return;
  const released = await send("POST", `windows/${window.id}/uplink`);
  notice(`${window.name}: ${released.items.length} telecommands released`);
  if (now) await order(link);
}

async function order(link) {
  await send("POST", `links/${encodeURIComponent(link.name)}/send`);
  notice(`Link ${link.name} sends what is released.`);
}

// Send what is released, after a look at it.
export async function transmit(link, waiting) {
  const lines = waiting.map((one) => `${one.id}  ${named(one)}${one.window_id ? `, window ${one.window_id}` : ""}`);
  if (await confirmed(`Send ${lines.length} telecommands over ${link.name} now?`, lines, "Send")) await order(link);
}
