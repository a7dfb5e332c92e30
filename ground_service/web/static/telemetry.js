import { get } from "./api.js";
import { chart, columns } from "./charts.js";
import { showLive } from "./values.js";
import { acting, byId, dictionary, element, figure, limitText, parameterName, parameterOptions, seconds, show, timeText, trouble, unitText } from "./page.js";

let definition = Object.fromEntries(dictionary.parameters.map((one) => [one.name, one]));

function csv(series) {
  const lines = ["start,stop,count,min,max,mean,after_gap"];
  for (const one of series.buckets) {
    lines.push([one.start, one.stop, one.count, one.min, one.max, one.mean, one.after_gap].join(","));
  }
  return URL.createObjectURL(new Blob([`${lines.join("\n")}\n`], { type: "text/csv" }));
}

async function add() {
  const [passId, name] = [byId("pass").value, byId("parameter").value];
  const series = await get(`passes/${passId}/telemetry/${encodeURIComponent(name)}`, { max_points: byId("points").value });
  const { box } = chart(byId("charts"), parameterName(name, series.unit), unitText(series.unit), [{ label: parameterName(name, series.unit), ...columns(series.buckets, seconds) }], { group: "telemetry" });
  const about = definition[name];
  const limits = [
    about.warning ? `warning ${limitText(about.warning)}` : null,
    about.alarm ? `alarm ${limitText(about.alarm)}` : null,
    Object.keys(about.labels).length ? Object.entries(about.labels).map(([code, label]) => `${code}: ${label}`).join(", ") : null,
  ].filter(Boolean);
  const last = series.buckets.at(-1);
  box.append(
    element(
      "p",
      { class: "hint" },
      `${about.description ? `${about.description}. ` : ""}${figure(series.samples)} samples` + (last ? `, last ${figure(last.mean)} at ${timeText(last.stop)}` : "") + (limits.length ? `; ${limits.join(", ")}` : "") + ". ",
      element("a", { href: csv(series), download: `pass-${passId}-${name}.csv` }, "CSV"),
    ),
  );
}

async function chooseParameters() {
  const wanted = byId("parameter").value;
  const { parameters } = await get(`passes/${byId("pass").value}/parameters`);
  definition = Object.fromEntries(parameters.map((one) => [one.name, one]));
  show("parameter", parameterOptions(parameters));
  if (wanted in definition) byId("parameter").value = wanted;
}

async function load() {
  const passes = await get("passes", { limit: 1000 });
  const wanted = new URLSearchParams(location.search);
  const asked = Number(wanted.get("pass"));
  if (asked && !passes.items.some((one) => one.id === asked)) passes.items.unshift(await get(`passes/${asked}`));
  show("pass", passes.items.map((one) => element("option", { value: one.id }, `${one.name}, ${timeText(one.start)}`)));
  if (wanted.get("pass")) byId("pass").value = wanted.get("pass");
  if (passes.items.length) await chooseParameters();
  if ("temperature_c" in definition) byId("parameter").value = "temperature_c";
  if (wanted.get("parameter") in definition) byId("parameter").value = wanted.get("parameter");
  if (passes.items.length) await add();
  else show("charts", element("p", { class: "hint" }, "No pass yet."));
}

byId("choice").addEventListener("submit", acting(add));
byId("pass").addEventListener("change", acting(chooseParameters));
byId("clear").addEventListener("click", () => show("charts"));
showLive();
load().catch((error) => error.status === 401 || trouble(error));
