// Series on a time axis: mean line in a band from least to greatest value, silences left open.
/* global uPlot */
import { element, figure } from "./page.js";

const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
export const COLOURS = ["--blue", "--vermillion", "--green", "--purple", "--orange", "--sky", "--gray1"];
export const colour = (index) => style(COLOURS[index % COLOURS.length]);

// Solutions look as in the reports: flown ones in their colour wherever they are shown, baselines gray and dashed.
const FLOWN = { anchored: "--blue", paper: "--vermillion", spherical: "--purple", smoothed: "--green" };
const BASELINES = [["--gray1", [6, 3]], ["--gray1", [2, 3]], ["--faint", [8, 3, 2, 3]], ["--muted", [3, 2]], ["--faint", [12, 4]]];
export function solutionStyle(name, kind = "estimate", index = 0) {
  if (kind === "baseline") {
    const [role, dash] = BASELINES[index % BASELINES.length];
    return { colour: style(role), dash };
  }
  return { colour: FLOWN[name] ? style(FLOWN[name]) : colour(4 + index) };
}

// Buckets of the API as columns; a gap becomes a point without a value just before the bucket after it.
export function columns(buckets, seconds) {
  const [times, low, high, mean] = [[], [], [], []];
  for (const bucket of buckets) {
    const time = (seconds(bucket.start) + seconds(bucket.stop)) / 2;
    if (bucket.after_gap && times.length) {
      times.push(time - 1e-3);
      low.push(null);
      high.push(null);
      mean.push(null);
    }
    times.push(time);
    low.push(bucket.min);
    high.push(bucket.max);
    mean.push(bucket.mean);
  }
  return { times, low, high, mean };
}

// Clock times as in the tables, with the date where the day begins or the axis does.
function clockTexts(plot, times, _, __, step) {
  return times.map((time, index) => {
    const iso = new Date(1000 * time).toISOString();
    if (step >= 86400) return iso.slice(5, 10);
    const clock = iso.slice(11, step < 60 ? 19 : 16);
    return index === 0 || time % 86400 === 0 ? `${clock}\n${iso.slice(0, 10)}` : clock;
  });
}

const faint = (css) => (css.startsWith("#") && css.length === 7 ? `${css}38` : css);

// series: [{label, times, mean, low?, high?}]; logarithmic axis where asked for.
export function chart(place, title, unit, series, { logarithmic = false, group = null, height = 220 } = {}) {
  const label = unit ? `${title}, ${unit}` : title;
  const box = element("figure", { class: "chart", tabindex: "0", role: "group", "aria-label": `chart: ${label}` });
  box.append(element("figcaption", {}, label));
  place.append(box);
  if (!series.some((one) => one.times.length)) {
    box.append(element("p", { class: "hint" }, "No samples."));
    return { box, plot: null };
  }
  const tables = series.map((one) =>
    one.low ? [one.times, one.mean, one.low, one.high] : [one.times, one.mean],
  );
  const data = tables.length === 1 ? tables[0] : uPlot.join(tables, tables.map((t) => t.slice(1).map(() => 2)));
  const lines = [{ label: "UTC", value: (_, time) => (time === null ? "–" : new Date(1000 * time).toISOString().slice(0, 19).replace("T", " ")) }];
  const bands = [];
  series.forEach((one, index) => {
    const stroke = one.colour ?? colour(index);
    lines.push({
      label: one.label,
      stroke,
      width: 1.5,
      dash: one.dash,
      points: { show: (plot) => plot.data[0].length < 40, size: 4 },
      value: (_, value) => (value === null || value === undefined ? "–" : value.toPrecision(6)),
    });
    if (!one.low) return;
    lines.push({ label: "min", width: 0, points: { show: false }, stroke: "transparent", class: "hidden" });
    lines.push({ label: "max", width: 0, points: { show: false }, stroke: "transparent", class: "hidden" });
    bands.push({ series: [lines.length - 1, lines.length - 2], fill: faint(stroke) });
  });
  const ink = style("--muted");
  const grid = { stroke: style("--grid"), width: 1 };
  // Decades only: the nine lines in each make a hatching.
  const rules = logarithmic ? { ...grid, filter: (_, splits) => splits.map((value) => (Number.isInteger(Math.log10(value)) ? value : null)) } : grid;
  const plot = new uPlot(
    {
      width: box.clientWidth,
      height,
      padding: [null, 40, null, null], // the date under the last tick
      tzDate: (time) => uPlot.tzDate(new Date(1000 * time), "Etc/UTC"),
      // What is nearer than a metre is drawn at the edge: zeros at a reset would rule the axis.
      scales: { y: logarithmic ? { distr: 3, range: (_, low, high) => [Math.max(1, 10 ** Math.floor(Math.log10(Math.max(low, 1)))), 10 ** Math.ceil(Math.log10(Math.max(high, 10)))] } : {} },
      axes: [
        { stroke: ink, grid, ticks: grid, values: clockTexts, space: 80 },
        { stroke: ink, grid: rules, ticks: rules, size: 86, values: (_, values) => values.map((value) => (value === null ? null : figure(value, 6))) },
      ],
      series: lines,
      bands,
      cursor: group ? { sync: { key: group, setSeries: false } } : {},
      legend: { live: true },
    },
    data,
    box,
  );
  const first = data[0][0];
  const last = data[0][data[0].length - 1];
  box.addEventListener("keydown", (event) => {
    const { min, max } = plot.scales.x;
    const [middle, half] = [(min + max) / 2, (max - min) / 2];
    const to = {
      "+": [middle - half / 2, middle + half / 2],
      "-": [middle - 2 * half, middle + 2 * half],
      ArrowLeft: [min - half / 2, max - half / 2],
      ArrowRight: [min + half / 2, max + half / 2],
      0: [first, last],
    }[event.key];
    if (!to) return;
    event.preventDefault();
    plot.setScale("x", { min: Math.max(to[0], first), max: Math.min(to[1], last) });
  });
  new ResizeObserver(() => plot.setSize({ width: box.clientWidth, height })).observe(box);
  return { box, plot };
}
