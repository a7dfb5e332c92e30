// Series on a time axis: mean line in a band from least to greatest value, silences left open.
/* global uPlot */
import { state, stated } from "./address.js";
import { element, figure, isoText } from "./page.js";

export const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
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

// Errors of a solution from a time on as columns. A logarithmic axis has no zero, which is the error at a reset.
export function errorColumns(solution, begin = 0) {
  const at = (name, row) => solution[name][row] || null;
  const buckets = solution.time_s.map((time, row) => ({ start: time, stop: time, min: at("min_m", row), max: at("max_m", row), mean: at("mean_m", row), after_gap: solution.after_gap[row] }));
  return columns(buckets, (time) => time - begin);
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

// Time since a start, in minutes.
const minuteTexts = (_, times) => times.map((time) => String(+(time / 60).toFixed(2)));
const sinceStart = (_, time) => (time === null ? "–" : `${(time / 60).toFixed(2)} min`);

const faint = (css) => (css.startsWith("#") && css.length === 7 ? `${css}38` : css);

// Zoom: charts of a group show the same time, which is in the address.
const groups = new Map(); // plots by group
const zooms = new Map(); // [from, to] by group; none: each chart shows all of its time

const ends = (plot) => [plot.data[0][0], plot.data[0].at(-1)];

function zoomTo(group) {
  const shown = (groups.get(group) ?? []).filter((plot) => plot.root.isConnected);
  groups.set(group, shown);
  for (const plot of shown) {
    const [min, max] = zooms.get(group) ?? ends(plot);
    if (plot.scales.x.min !== min || plot.scales.x.max !== max) plot.setScale("x", { min, max });
  }
}

function joinGroup(group, plot) {
  const [from, to] = (stated("zoom") ?? "").split("~").map((text) => Date.parse(text) / 1000);
  if (from < to) zooms.set(group, [from, to]);
  groups.set(group, [...(groups.get(group) ?? []), plot]);
  zoomTo(group);
}

function zoomed(plot, group) {
  const { min, max } = plot.scales.x;
  const [first, last] = ends(plot);
  const [from, to] = zooms.get(group) ?? [first, last];
  if (min === from && max === to) return;
  if (min <= first && max >= last) zooms.delete(group);
  else zooms.set(group, [min, max]);
  const zoom = zooms.get(group);
  state({ zoom: zoom ? zoom.map(isoText).join("~") : null });
  zoomTo(group);
}

// What a chart shows of a series: of codes, steps with their names; of numbers, a line on the axis of their unit.
const axisOf = (one) => (one.labels ? `codes of ${one.label}` : (one.unit ?? ""));
const STEPS = { align: 1 };

function lineOf(one, stroke, scale, paths) {
  const text = one.labels ? (value) => one.labels[value] ?? String(value) : (value) => value.toPrecision(6);
  return {
    label: one.label,
    scale,
    stroke,
    width: 1.5,
    dash: one.dash,
    paths,
    points: { show: (plot) => plot.data[0].length < 40, size: 4 },
    value: (_, value) => (value === null || value === undefined ? "–" : text(value)),
  };
}

function axisFor(one, scale, index, colours, logarithmic) {
  const { ink, grid } = colours;
  // Decades only: the nine lines in each make a hatching.
  const rules = logarithmic ? { ...grid, filter: (_, splits) => splits.map((value) => (Number.isInteger(Math.log10(value)) ? value : null)) } : grid;
  const axis = { scale, side: index ? 1 : 3, stroke: ink, grid: index ? { show: false } : rules, ticks: rules, size: 86 };
  if (!one.labels) return { ...axis, values: (_, values) => values.map((value) => (value === null ? null : figure(value, 6))) };
  const codes = Object.keys(one.labels).map(Number);
  return {
    ...axis,
    size: 110,
    splits: (_, __, least, greatest) => codes.filter((code) => code >= least && code <= greatest),
    values: (_, values) => values.map((value) => (one.labels[value] ?? "").replaceAll("_", " ")),
  };
}

// What is nearer than a metre is drawn at the edge: zeros at a reset would rule the axis.
const LOGARITHMIC = { distr: 3, range: (_, low, high) => [Math.max(1, 10 ** Math.floor(Math.log10(Math.max(low, 1)))), 10 ** Math.ceil(Math.log10(Math.max(high, 10)))] };
const CODES = { range: (_, low, high) => [low - 0.5, high + 0.5] };

// Limits of a series as dashed lines, where the axis shows them.
function drawLimits(plot, series, scaleOf) {
  const { ctx, bbox } = plot;
  ctx.save();
  ctx.setLineDash([6, 4]);
  for (const one of series) {
    for (const [kind, css] of [["warning", "--orange"], ["alarm", "--vermillion"]]) {
      for (const value of one[kind] ?? []) {
        const y = value === null ? NaN : plot.valToPos(value, scaleOf(one), true);
        if (!(y >= bbox.top && y <= bbox.top + bbox.height)) continue;
        ctx.strokeStyle = style(css);
        ctx.beginPath();
        ctx.moveTo(bbox.left, y);
        ctx.lineTo(bbox.left + bbox.width, y);
        ctx.stroke();
      }
    }
  }
  ctx.restore();
}

// Lines and bands of the series, and their values as uPlot takes them.
function drawnSeries(series, scaleOf, elapsed) {
  const lines = [elapsed ? { label: "since start", value: sinceStart } : { label: "UTC", value: (_, time) => (time === null ? "–" : new Date(1000 * time).toISOString().slice(0, 19).replace("T", " ")) }];
  const bands = [];
  const tables = [];
  series.forEach((one, index) => {
    const stroke = one.colour ?? colour(index);
    const paths = one.labels ? uPlot.paths.stepped(STEPS) : undefined;
    // Between codes there is no mean: an interval with several shows the band from the least to the greatest.
    const middle = one.labels ? one.high : one.mean;
    lines.push(lineOf(one, stroke, scaleOf(one), paths));
    tables.push(one.low ? [one.times, middle, one.low, one.high] : [one.times, middle]);
    if (!one.low) return;
    const edge = { width: 0, scale: scaleOf(one), paths, points: { show: false }, stroke: "transparent", class: "hidden" };
    lines.push({ label: "min", ...edge }, { label: "max", ...edge });
    bands.push({ series: [lines.length - 1, lines.length - 2], fill: faint(stroke) });
  });
  const data = tables.length === 1 ? tables[0] : uPlot.join(tables, tables.map((t) => t.slice(1).map(() => 2)));
  return { lines, bands, data };
}

function zoomByKeys(box, plot) {
  box.addEventListener("keydown", (event) => {
    const { min, max } = plot.scales.x;
    const [first, last] = ends(plot);
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
}

// The legend shows and hides series, with the pointer (uPlot) and with keys. The band of a series goes with its line.
function legendByKeys(plot) {
  plot.root.querySelectorAll(".u-legend .u-series").forEach((row, index) => {
    const label = row.querySelector(".u-label");
    if (!index || plot.series[index].class === "hidden") return;
    label.tabIndex = 0;
    label.role = "button";
    label.addEventListener("keydown", (event) => {
      if (event.key !== "Enter" && event.key !== " ") return;
      event.preventDefault();
      label.click();
    });
  });
  seriesShown(plot);
}

function seriesShown(plot) {
  const labels = plot.root.querySelectorAll(".u-legend .u-series .u-label");
  let shown = true;
  plot.series.forEach((one, index) => {
    if (one.class !== "hidden") {
      shown = one.show;
      if (labels[index]?.role) labels[index].ariaPressed = String(shown);
    } else if (one.show !== shown) plot.setSeries(index, { show: shown });
  });
}

const DARK = matchMedia("(prefers-color-scheme: dark)");
function redrawWithColours(box, plot) {
  const redraw = () => {
    if (box.isConnected) plot.redraw(false, true);
    else DARK.removeEventListener("change", redraw);
  };
  DARK.addEventListener("change", redraw);
}

// Minutes are ruled at whole numbers of them.
const MINUTES = [1, 2, 5, 10, 15, 30, 60, 120, 300, 600].map((one) => 60 * one);

// series: [{label, times, mean, low?, high?, unit?, labels?, warning?, alarm?}]; logarithmic axis where asked for.
// `elapsed`: times are seconds since a start instead of UTC.
export function chart(place, title, unit, series, { logarithmic = false, elapsed = false, group = null, height = 220 } = {}) {
  const label = unit ? `${title}, ${unit}` : title;
  const box = element("figure", { class: "chart", tabindex: "0", role: "group", "aria-label": `chart: ${label}` });
  box.append(element("figcaption", {}, label));
  place.append(box);
  if (!series.some((one) => one.times.length)) {
    box.append(element("p", { class: "hint" }, "No samples."));
    return { box, plot: null };
  }
  const axes = [...new Map(series.map((one) => [axisOf(one), one]))];
  if (axes.length > 2) throw new Error("A chart has two axes: choose parameters with at most two units.");
  const scaleOf = (one) => (axisOf(one) === axes[0][0] ? "y" : "second");
  const { lines, bands, data } = drawnSeries(series, scaleOf, elapsed);
  // Asked for at each drawing: the colours of the page may change while it is open.
  const colours = { ink: () => style("--muted"), grid: { stroke: () => style("--grid"), width: 1 } };
  const ruler = elapsed ? { values: minuteTexts, incrs: MINUTES, label: "minutes since the start", labelSize: 20 } : { values: clockTexts };
  const scales = { ...(elapsed && { x: { time: false } }), ...Object.fromEntries(axes.map(([, one]) => [scaleOf(one), one.labels ? CODES : logarithmic ? LOGARITHMIC : {}])) };
  const plot = new uPlot(
    {
      width: box.clientWidth,
      height,
      padding: [null, axes.length > 1 ? null : 40, null, null], // the date under the last tick
      tzDate: (time) => uPlot.tzDate(new Date(1000 * time), "Etc/UTC"),
      scales,
      axes: [
        { stroke: colours.ink, grid: colours.grid, ticks: colours.grid, space: 80, ...ruler },
        ...axes.map(([, one], index) => axisFor(one, scaleOf(one), index, colours, logarithmic)),
      ],
      series: lines,
      bands,
      cursor: group ? { sync: { key: group, setSeries: false } } : {},
      legend: { live: true },
      hooks: {
        draw: [(drawn) => drawLimits(drawn, series, scaleOf)],
        setSeries: [seriesShown],
        setScale: [(changed, key) => key === "x" && group && zoomed(changed, group)],
      },
    },
    data,
    box,
  );
  box.plot = plot;
  redrawWithColours(box, plot);
  if (group) joinGroup(group, plot);
  zoomByKeys(box, plot);
  legendByKeys(plot);
  new ResizeObserver(() => plot.setSize({ width: box.clientWidth, height })).observe(box);
  return { box, plot };
}
