import { get, send } from "./api.js";
import { list } from "./lists.js";
import { button, byId, element, on, show, showTable, svg, timeText } from "./page.js";

const CROP = 3; // diameters of the crater that a picture shows
let chosen = null;

const metres = (value) => `${Math.round(value)}`;
const place = (row) => `${row.latitude_deg.toFixed(4)}°, ${row.longitude_deg.toFixed(4)}°`;

const opener = (row) => button(String(row.id), () => open(row.id), { name: `Sightings of landmark ${row.id}`, needs: null });

const columns = [
  ["No", opener, "num"],
  "spacecraft_id",
  ["Latitude, longitude", place],
  ["Diameter, m", (row) => `${metres(row.diameter_m)} ± ${metres(row.diameter_sigma_m)}`, "num"],
  ["Sigma east, north, up, m", (row) => [row.sigma_east_m, row.sigma_north_m, row.sigma_up_m].map(metres).join(", "), "num"],
  "passes",
  ["Sightings of frames in view", (row) => `${row.sightings} of ${row.looks}`, "num"],
  ["Score", (row) => row.score.toFixed(2), "num"],
  "state",
  ["Decided by", (row) => (row.decided_by ? `${row.decided_by}, ${timeText(row.decided)}` : "")],
  "reason",
];

function picture(pass, one) {
  const size = Math.max(CROP * one.diameter_px, 24);
  const label = `Frame ${one.frame_number} of pass ${pass.pass_id}, ${timeText(one.time)}`;
  const drawing = svg(
    "svg",
    { viewBox: `${one.u_px - size / 2} ${one.v_px - size / 2} ${size} ${size}`, width: 160, height: 160, role: "img", "aria-label": label },
    svg("image", { href: one.image, x: -0.5, y: -0.5, width: pass.frame_width_px, height: pass.frame_height_px }),
    svg("circle", { cx: one.u_px, cy: one.v_px, r: one.diameter_px / 2, fill: "none", stroke: "#e69f00", "stroke-width": size / 80 }),
  );
  return element("figure", {}, drawing, element("figcaption", {}, label));
}

async function open(id) {
  const row = await get(`landmarks/${id}`);
  chosen = row.id;
  byId("detail").hidden = false;
  byId("sightings-title").textContent = `Sightings of landmark ${row.id}`;
  byId("decision-text").textContent = row.decided_by ? `${row.state} by ${row.decided_by}` : row.state;
  for (const button of ["accept", "reject"]) byId(button).hidden = row.state === "seen" || row.state === `${button}ed`;
  const sightings = ["Sightings of frames in view", (one) => `${one.sightings.length} of ${one.looks}`, "num"];
  const diameter = ["Diameter, m", (one) => metres(one.diameter_m), "num"];
  showTable("passes", "Sightings by pass", ["pass_id", ["Latitude, longitude", place], diameter, sightings, ["Calibrating craters", "controls"]], row.evidence, "None.");
  const pictures = row.evidence.flatMap((pass) => pass.sightings.filter((one) => one.image).map((one) => picture(pass, one)));
  show("images", pictures.length ? pictures : element("p", {}, "No image of these frames was received."));
  byId("sightings-title").focus(); // a button of the decision may be hidden now
}

for (const decision of ["accept", "reject"]) {
  on(decision, "click", async () => {
    await send("POST", `landmarks/${chosen}/${decision}`, { reason: byId("reason").value });
    byId("reason").value = "";
    await open(chosen);
    await load();
  });
}

const load = list("/landmarks", { place: "landmarks", columns, query: () => ({ state: byId("state").value || null }), concerns: (message) => message.kind === "landmarks" });
on("state", "change", () => load.first());
