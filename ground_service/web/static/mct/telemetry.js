// Historical and live values of parameters, and their limits.
import { get } from "../api.js";
import { afterTelemetry, FAR, followNewest, milliseconds, newest } from "./feed.js";

const POINTS = 1000;
const MOST_POINTS = 10000;
const GAP_MS = 1; // a missing value so long after a sample interrupts the line of a plot

const iso = (time) => new Date(Math.max(time, 0)).toISOString();
const isParameter = (one) => one.type === "linna.parameter";

function series({ spacecraft, parameter }, start, end, points, signal) {
  return get(
    `spacecraft/${spacecraft.spacecraft_id}/telemetry/${encodeURIComponent(parameter.name)}`,
    { instance: spacecraft.instance, start: iso(start), stop: iso(end), max_points: points },
    { signal },
  );
}

// Samples of an interval. Several samples become two: the least at the start, the greatest at the end.
export function samplesOf(buckets, extremes) {
  const found = [];
  for (const one of buckets) {
    const [start, stop] = [milliseconds(one.start), milliseconds(one.stop)];
    const shared = { mean: one.mean, min: one.min, max: one.max };
    if (one.after_gap && extremes && found.length) found.push({ utc: found.at(-1).utc + GAP_MS, value: Number.NaN });
    if (one.count > 1 && extremes) {
      found.push({ utc: start, value: one.min, ...shared }, { utc: Math.max(stop, start + 1), value: one.max, ...shared });
    } else {
      found.push({ utc: (start + stop) / 2, value: one.mean, ...shared });
    }
  }
  return found;
}

const liveDatum = (one) => ({ utc: milliseconds(one.time), value: one.value, mean: one.value, min: one.value, max: one.value });
const liveName = (object) => object.parameter.short ?? object.parameter.name;
const hasPacket = (values, object) => values.some((one) => one.packet === object.parameter.packet);
// The newest packet of a state may be of another estimator.
const isNewest = (object) => object.parameter.packet !== "navigation_state";

function newestOf(values, object) {
  const found = values.find((one) => one.packet === object.parameter.packet && one.name === liveName(object));
  return found ? liveDatum(found) : null;
}

async function latest(object, options) {
  if (isNewest(object)) {
    const values = await newest(object.spacecraft);
    if (hasPacket(values, object)) {
      const found = newestOf(values, object);
      return found && found.utc >= options.start && found.utc <= options.end ? [found] : [];
    }
  }
  if (!object.parameter.series) return [];
  let start = options.start;
  for (;;) {
    const { buckets } = await series(object, start, options.end, POINTS, options.signal);
    const last = buckets.at(-1);
    if (!last) return [];
    if (last.count === 1 || milliseconds(last.start) <= start) return samplesOf([last], false);
    start = milliseconds(last.start);
  }
}

const shown = new Map(); // key of an object -> end of the history last requested

async function history(object, options) {
  if (options.strategy === "latest" || options.size === 1 || !object.parameter.series) return latest(object, options);
  const points = Math.min(Math.max(Math.round(options.size ?? MOST_POINTS), 100), MOST_POINTS);
  const { buckets } = await series(object, options.start, options.end, points, options.signal);
  if (buckets.length) shown.set(object.identifier.key, milliseconds(buckets.at(-1).stop));
  return samplesOf(buckets, options.strategy === "minmax" && !Object.keys(object.parameter.labels).length);
}

const KINDS = { housekeeping: "housekeeping", navigation_state: "navigation_states" }; // of samples, by packet
const PLOT_AGAIN_MS = 1000; // shortest time between two requests of one plot

// All values later than the last one, after each reception: newest values leave out those that came together.
// The first request is that of the history: its interval ends after the newest telemetry, so its end would hide what follows.
function followSeries(object, callback, since) {
  let last = since - 1;
  let points = 0;
  const work = async () => {
    try {
      // Plots append what follows, so nothing of the history is repeated.
      if (!points) last = Math.max(last, shown.get(object.identifier.key) ?? last);
      const { buckets } = await series(object, last + 1, FAR, points || MOST_POINTS);
      points = POINTS;
      const found = samplesOf(buckets, false).filter((one) => one.utc > last);
      if (!found.length) return;
      last = found.at(-1).utc;
      callback(found);
    } catch (error) {
      console.warn(`${object.name}: ${error.message}`);
    }
  };
  return afterTelemetry(KINDS[object.parameter.packet] ?? null, work, isNewest(object) ? PLOT_AGAIN_MS : undefined);
}

// Tables of newest values ask for one value, plots for all.
const isComplete = ({ size, strategy }) => strategy === "batch" && size !== 1;

function subscribe(openmct, object, callback, options) {
  if (!isNewest(object) || (object.parameter.series && isComplete(options))) return followSeries(object, callback, openmct.time.getBounds().start);
  let last = -Infinity;
  let stop = null;
  const warn = (error) => console.warn(`${object.name}: ${error.message}`);
  stop = followNewest(
    object.spacecraft,
    (values) => {
      const found = newestOf(values, object);
      if (found && found.utc > last) {
        last = found.utc;
        callback([found]);
      } else if (!found && object.parameter.series && !hasPacket(values, object)) {
        stop();
        stop = followSeries(object, callback, Math.max(last, openmct.time.getBounds().start));
      }
    },
    warn,
  );
  return () => stop();
}

export function limitOf(value, { warning, alarm }) {
  for (const [limits, colour, name] of [
    [alarm, "red", "alarm"],
    [warning, "yellow", "warning"],
  ]) {
    if (!limits) continue;
    const [low, high] = limits;
    if (high !== null && value > high) return { cssClass: `is-limit--upr is-limit--${colour}`, name: `${name}, above ${high}`, low: high, high: Infinity };
    if (low !== null && value < low) return { cssClass: `is-limit--lwr is-limit--${colour}`, name: `${name}, below ${low}`, low: -Infinity, high: low };
  }
  return undefined;
}

function limitLines(limits, color) {
  const [low, high] = limits;
  const all = (value) => ({ color, value, mean: value, min: value, max: value });
  return { ...(low === null ? {} : { low: all(low) }), ...(high === null ? {} : { high: all(high) }) };
}

export function installTelemetry(openmct) {
  openmct.telemetry.addProvider({
    supportsRequest: isParameter,
    request: history,
    supportsSubscribe: isParameter,
    supportsBatching: () => true,
    subscribe: (object, callback, options) => subscribe(openmct, object, callback, options ?? {}),
    supportsLimits: (object) => isParameter(object) && Boolean(object.parameter.warning || object.parameter.alarm),
    getLimitEvaluator: ({ parameter }) => ({
      evaluate: (datum, metadata) => (metadata && typeof datum[metadata.key] === "number" ? limitOf(datum[metadata.key], parameter) : undefined),
    }),
    getLimits: ({ parameter: { warning, alarm } }) => ({
      limits: async () => ({
        ...(warning ? { WARNING: limitLines(warning, "yellow") } : {}),
        ...(alarm ? { CRITICAL: limitLines(alarm, "red") } : {}),
      }),
    }),
  });
}
