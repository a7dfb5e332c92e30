import { bind, restore, state, stated, statedAll } from "./address.js";
import { get } from "./api.js";
import { drawParameters } from "./parameters.js";
import { showLive } from "./values.js";
import { byId, element, loading, on, parameterName, parameterOptions, show, timeText } from "./page.js";

let drawn = []; // [{pass, names}] of the charts, in their order
const known = new Map(); // parameters by pass

async function parametersOf(pass) {
  if (!known.has(pass)) known.set(pass, (await get(`passes/${pass}/parameters`)).parameters);
  return known.get(pass);
}

const text = ({ pass, names }) => `${pass}:${names.join(",")}`;

function keepCharts() {
  state({ chart: drawn.map(text) });
  const choices = drawn.map(({ names }, index) => element("option", { value: index }, `with ${names.map((name) => parameterName(name, "")).join(", ")}`));
  show("chart", element("option", { value: "new" }, "a new one"), choices);
}

async function draw(entry, place) {
  const all = await parametersOf(entry.pass);
  const chosen = entry.names.map((name) => all.find((one) => one.name === name)).filter(Boolean);
  if (!chosen.length) throw new Error(`Pass ${entry.pass} has no parameter ${entry.names.join(", ")}.`);
  return drawParameters(place, entry.pass, chosen, { group: "telemetry", maxPoints: byId("points").value });
}

async function add() {
  const [pass, name] = [Number(byId("pass").value), byId("parameter").value];
  const shared = drawn[byId("chart").value];
  if (!drawn.length) show("charts");
  if (!shared) {
    const entry = { pass, names: [name] };
    await draw(entry, byId("charts"));
    drawn.push(entry);
  } else {
    if (shared.pass !== pass) throw new Error("A chart shows parameters of one pass.");
    const entry = { pass, names: [...new Set([...shared.names, name])] };
    const place = element("div");
    byId("charts").append(place); // a chart is as wide as its place
    try {
      await draw(entry, place);
      byId("charts").children[drawn.indexOf(shared)].replaceWith(...place.children);
    } finally {
      place.remove();
    }
    shared.names = entry.names;
  }
  keepCharts();
}

async function chooseParameters() {
  const wanted = byId("parameter").value;
  const parameters = await parametersOf(Number(byId("pass").value));
  show("parameter", parameterOptions(parameters));
  byId("parameter").value = parameters.some((one) => one.name === wanted) ? wanted : (parameters.find((one) => one.name === "temperature_c") ?? parameters[0])?.name;
}

function statedCharts() {
  return statedAll("chart").map((one) => {
    const [pass, names] = one.split(":");
    return { pass: Number(pass), names: (names ?? "").split(",") };
  });
}

async function load() {
  const passes = await get("passes", { limit: 1000 });
  const asked = Number(stated("pass"));
  if (asked && !passes.items.some((one) => one.id === asked)) passes.items.unshift(await get(`passes/${asked}`));
  show("pass", passes.items.map((one) => element("option", { value: one.id }, `${one.name}, ${timeText(one.start)}`)));
  restore("pass");
  bind("points");
  keepPassAndParameter();
  if (!passes.items.length) {
    show("charts", element("p", { class: "hint" }, "No pass yet."));
    return;
  }
  await chooseParameters();
  restore("parameter");
  const wanted = statedCharts();
  if (!wanted.length) await add();
  for (const entry of wanted) {
    await draw(entry, byId("charts"));
    drawn.push(entry);
  }
  keepCharts();
}

function keepPassAndParameter() {
  for (const id of ["pass", "parameter"]) byId(id).addEventListener("change", () => state({ [id]: byId(id).value }));
}

on("choice", "submit", add);
on("pass", "change", chooseParameters);
byId("clear").addEventListener("click", () => {
  show("charts");
  drawn = [];
  keepCharts();
});
showLive();
loading(load);
