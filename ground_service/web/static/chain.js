// Chain of a planned window: the steps that it has reached, the one that it waits for, and what continues it.
import { lengthText, missionNow, seconds, timeText } from "./page.js";

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
