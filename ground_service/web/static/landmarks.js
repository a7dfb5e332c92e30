import { get, send } from "./api.js";
import { acting, element, pager, show, table, timeText, trouble, watch } from "./page.js";

const SVG = "http://www.w3.org/2000/svg";
const CROP = 3; // diameters of the crater that a picture shows
const byId = (id) => document.getElementById(id);
let shown = null;

const metres = (value) => `${Math.round(value)}`;

function place(row) {
  return `${row.latitude_deg.toFixed(4)}°, ${row.longitude_deg.toFixed(4)}°`;
}

function opener(row) {
  const button = element("button", { type: "button", "aria-label": `Sightings of landmark ${row.id}` }, String(row.id));
  button.addEventListener(
    "click",
    acting(async () => {
      await open(row.id);
      byId("sightings-title").focus();
    }),
  );
  return button;
}

const columns = [
  ["No", opener, "num"],
  ["Spacecraft", (row) => String(row.spacecraft_id), "num"],
  ["Latitude, longitude", place],
  ["Diameter, m", (row) => `${metres(row.diameter_m)} ± ${metres(row.diameter_sigma_m)}`, "num"],
  ["Sigma east, north, up, m", (row) => [row.sigma_east_m, row.sigma_north_m, row.sigma_up_m].map(metres).join(", "), "num"],
  ["Passes", (row) => String(row.passes), "num"],
  ["Sightings of frames in view", (row) => `${row.sightings} of ${row.looks}`, "num"],
  ["Score", (row) => row.score.toFixed(2), "num"],
  ["State", (row) => row.state],
  ["Decided by", (row) => (row.decided_by ? `${row.decided_by}, ${timeText(row.decided)}` : "")],
  ["Reason", (row) => row.reason ?? ""],
];

function part(name, attributes) {
  const made = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  return made;
}

function picture(pass, one) {
  const size = Math.max(CROP * one.diameter_px, 24);
  const label = `Frame ${one.frame_number} of pass ${pass.pass_id}, ${timeText(one.time)}`;
  const drawing = part("svg", {
    viewBox: `${one.u_px - size / 2} ${one.v_px - size / 2} ${size} ${size}`,
    width: 160,
    height: 160,
    role: "img",
    "aria-label": label,
  });
  drawing.append(
    part("image", { href: one.image, x: -0.5, y: -0.5, width: pass.frame_width_px, height: pass.frame_height_px }),
    part("circle", {
      cx: one.u_px,
      cy: one.v_px,
      r: one.diameter_px / 2,
      fill: "none",
      stroke: "#e69f00",
      "stroke-width": size / 80,
    }),
  );
  return element("figure", {}, drawing, element("figcaption", {}, label));
}

async function open(id) {
  const row = await get(`landmarks/${id}`);
  shown = row.id;
  byId("detail").hidden = false;
  byId("sightings-title").textContent = `Sightings of landmark ${row.id}`;
  byId("decision-text").textContent = row.decided_by ? `${row.state} by ${row.decided_by}` : row.state;
  for (const button of ["accept", "reject"]) byId(button).hidden = row.state === "seen" || row.state === `${button}ed`;
  show(
    "passes",
    table(
      "Sightings by pass",
      [
        ["Pass", (one) => element("a", { href: `/passes/${one.pass_id}` }, String(one.pass_id))],
        ["Latitude, longitude", place],
        ["Diameter, m", (one) => metres(one.diameter_m), "num"],
        ["Sightings of frames in view", (one) => `${one.sightings.length} of ${one.looks}`, "num"],
        ["Calibrating craters", (one) => String(one.controls), "num"],
      ],
      row.evidence,
      "None.",
    ),
  );
  const pictures = row.evidence.flatMap((pass) => pass.sightings.filter((one) => one.image).map((one) => picture(pass, one)));
  byId("images").replaceChildren(...(pictures.length ? pictures : [element("p", {}, "No image of these frames was received.")]));
}

for (const decision of ["accept", "reject"]) {
  byId(decision).addEventListener(
    "click",
    acting(async () => {
      await send("POST", `landmarks/${shown}/${decision}`, { reason: byId("reason").value });
      byId("reason").value = "";
      await open(shown);
      byId("sightings-title").focus(); // the button is hidden now
      await load();
    }),
  );
}

const load = pager(async (limit, offset) => {
  const state = byId("state").value;
  const page = await get("landmarks", state ? { limit, offset, state } : { limit, offset });
  show("landmarks", table("Landmarks", columns, page.items, "None."));
  return page;
});

byId("state").addEventListener("change", () => load.first().catch((error) => error.status === 401 || trouble(error)));
watch((message) => message.kind === "landmarks" && load().catch(trouble), load);
load().catch((error) => error.status === 401 || trouble(error));
