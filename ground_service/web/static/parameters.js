// Series of parameters of a pass: numbers as lines, codes as steps with their names, hashes as a table.
import { chart, columns } from "./charts.js";
import { element, figure, limitText, parameterName, seconds, table, timeText, unitText } from "./page.js";
import { get } from "./api.js";

// A hash has no size: its values are listed.
export const isHash = (about) => about.unit === "" && /(^|[._])hash$/.test(about.name);

const nameOf = (about) => parameterName(about.name, about.unit);

export function seriesOf(about, answer) {
  const coded = Object.keys(about.labels).length > 0;
  return {
    label: nameOf(about),
    unit: unitText(about.unit),
    labels: coded ? about.labels : null,
    warning: about.warning,
    alarm: about.alarm,
    ...columns(answer.buckets, seconds),
  };
}

// Stretches of time with one value each.
export function stretches(buckets) {
  const found = [];
  for (const one of buckets) {
    const value = one.min === one.max ? one.min : null;
    const last = found.at(-1);
    if (last && last.value === value) {
      last.stop = one.stop;
      last.count += one.count;
    } else found.push({ start: one.start, stop: one.stop, value, count: one.count });
  }
  return found;
}

const hexadecimal = (value) => (value === null ? "several values" : element("code", {}, Math.round(value).toString(16).padStart(8, "0")));

function hashes(about, answer) {
  return element(
    "figure",
    { class: "chart", "aria-label": `values: ${nameOf(about)}` },
    element("figcaption", {}, nameOf(about)),
    table(
      `Values of ${nameOf(about)}`,
      [["Value", (row) => hexadecimal(row.value)], ["From", (row) => timeText(row.start)], ["To", (row) => timeText(row.stop)], ["Samples", (row) => figure(row.count), "num"]],
      stretches(answer.buckets),
      "No samples.",
    ),
  );
}

function remark(about, answer) {
  const last = answer.buckets.at(-1);
  const value = last && (about.labels[last.max] ?? figure(last.mean));
  const parts = [
    `${figure(answer.samples)} samples${last ? `, last ${value} at ${timeText(last.stop)}` : ""}`,
    about.warning ? `warning ${limitText(about.warning)}` : null,
    about.alarm ? `alarm ${limitText(about.alarm)}` : null,
  ];
  return `${about.description ? `${about.description}. ` : ""}${parts.filter(Boolean).join("; ")}. `;
}

const samplesLink = (passId, about) =>
  element("a", { href: `/api/v1/passes/${passId}/packets/${encodeURIComponent(about.packet)}?format=csv`, download: `pass-${passId}-${about.packet}.csv` }, `CSV of all samples (${about.packet})`);

// One chart of parameters of a pass, given as their entries in the list of parameters.
export async function drawParameters(place, passId, chosen, { group, maxPoints = 600 }) {
  const path = (about) => `passes/${passId}/telemetry/${encodeURIComponent(about.name)}`;
  // An interval of codes with several values has no one name: as many intervals as there may be.
  const points = (about) => (Object.keys(about.labels).length ? 10_000 : maxPoints);
  const answers = await Promise.all(chosen.map((about) => get(path(about), { max_points: points(about) })));
  const listed = chosen.map((about, index) => [about, answers[index]]);
  const box = element("div", { class: "drawn" });
  place.append(box);
  const drawn = listed.filter(([about]) => !isHash(about));
  if (drawn.length) {
    const series = drawn.map(([about, answer]) => seriesOf(about, answer));
    const units = [...new Set(series.map((one) => one.unit))];
    try {
      chart(box, series.map((one) => one.label).join(" and "), units.length === 1 ? units[0] : "", series, { group });
    } catch (error) {
      box.remove();
      throw error;
    }
  }
  for (const [about, answer] of listed) {
    if (isHash(about)) box.append(hashes(about, answer));
    box.append(element("p", { class: "hint" }, chosen.length > 1 ? `${nameOf(about)}: ` : "", remark(about, answer), samplesLink(passId, about)));
  }
  return box;
}
