// The Moon as a plate carrée map, east longitudes from -180 to 180.
/* global L */
import { element } from "./page.js";

// `albedo`: over the Moon itself, its picture is the background; other terrain has none.
export function moonMap(place, { albedo = true } = {}) {
  const map = L.map(place, {
    crs: L.CRS.EPSG4326,
    preferCanvas: true,
    zoomSnap: 0.25,
    minZoom: 0,
    maxZoom: 10,
    maxBounds: [
      [-95, -190],
      [95, 190],
    ],
    attributionControl: false,
  });
  map.fitBounds([
    [-90, -180],
    [90, 180],
  ]);
  const background = new Image();
  background.onload = () => L.imageOverlay(background.src, [[-90, -180], [90, 180]]).addTo(map).bringToBack();
  place.classList.toggle("bare", !albedo);
  if (albedo) {
    fetch("/moon.jpg").then(async (answer) => {
      if (answer.ok) background.src = URL.createObjectURL(await answer.blob());
      else place.classList.add("bare");
    });
  }
  const lines = { weight: 0.5, color: "#8792a0", interactive: false };
  for (let longitude = -180; longitude <= 180; longitude += 30) {
    L.polyline([[-90, longitude], [90, longitude]], lines).addTo(map);
  }
  for (let latitude = -60; latitude <= 60; latitude += 30) {
    L.polyline([[latitude, -180], [latitude, 180]], lines).addTo(map);
    L.marker([latitude, -180], {
      interactive: false,
      keyboard: false,
      icon: L.divIcon({ className: "degrees", html: `${Math.abs(latitude)}°${latitude < 0 ? "S" : latitude > 0 ? "N" : ""}` }),
    }).addTo(map);
  }
  return map;
}

// The terrain of a mission description: the picture of the Moon is of the Moon only.
export function terrain(description) {
  if (!description) return { albedo: false, text: "Terrain: not stated, since no mission description was in force." };
  const { evidence } = description;
  const world = evidence?.world;
  if (!world) return { albedo: false, text: "Terrain: not stated in the mission description." };
  if (world === "real-terrain" || world === "photographs") return { albedo: true, text: "Terrain: the Moon; the background is its albedo." };
  const seed = evidence.seed === null || evidence.seed === undefined ? "" : `, seed ${evidence.seed}`;
  return { albedo: false, text: `Terrain: ${world.replaceAll("-", " ").replaceAll("_", " ")}${seed}, which is not the Moon's: no picture of it is shown.` };
}

// Density of craters: the denser a cell, the more opaque. Returns the layer and the greatest density.
export function densityLayer(map, { rows, cell_deg: cell }, css) {
  const most = Math.max(...rows.flat(), 0);
  const layer = L.layerGroup().addTo(map);
  rows.forEach((row, north) =>
    row.forEach((value, east) => {
      if (!value) return;
      const [south, west] = [north * cell - 90, east * cell - 180];
      L.rectangle([[south, west], [south + cell, west + cell]], { stroke: false, fillColor: css, fillOpacity: 0.55 * Math.sqrt(value / most), interactive: false }).addTo(layer);
    }),
  );
  return { layer, most };
}

export const wrapped = (longitude) => ((((longitude + 180) % 360) + 360) % 360) - 180;

// A track in parts, so that no line crosses the whole map at the 180 degree meridian or bridges a missing value.
export function parts(latitudes, longitudes) {
  const found = [[]];
  let before = null;
  latitudes.forEach((latitude, index) => {
    const longitude = longitudes[index];
    if (latitude === null || longitude === null || !Number.isFinite(latitude) || !Number.isFinite(longitude)) {
      if (found.at(-1).length) found.push([]);
      before = null;
      return;
    }
    const here = wrapped(longitude);
    if (before !== null && Math.abs(here - before) > 180 && found.at(-1).length) found.push([]);
    found.at(-1).push([latitude, here]);
    before = here;
  });
  return found.filter((part) => part.length);
}

export function track(map, latitudes, longitudes, options) {
  const pieces = parts(latitudes, longitudes);
  return L.polyline(pieces, { weight: 2, interactive: false, ...options }).addTo(map);
}

// Rims of craters: circles of their true size, at least a point.
export function craterRims(map, craters) {
  const css = getComputedStyle(document.documentElement).getPropertyValue("--muted").trim();
  const degrees = (metres) => (metres / 1_737_400) * (180 / Math.PI);
  for (const one of craters) {
    const half = degrees(one.diameter_m / 2);
    const points = [];
    for (let step = 0; step < 24; step += 1) {
      const angle = (step * Math.PI) / 12;
      points.push([one.latitude_deg + half * Math.cos(angle), one.longitude_deg + (half * Math.sin(angle)) / Math.cos((one.latitude_deg * Math.PI) / 180)]);
    }
    L.polygon(points, { color: css, weight: 1, fillOpacity: 0.12, interactive: false }).addTo(map);
  }
}

export function dot(map, latitude, longitude, options) {
  return L.circleMarker([latitude, wrapped(longitude)], { radius: 5, weight: 2, interactive: false, ...options }).addTo(map);
}

export function legendItem(label, css) {
  const mark = element("span", { class: "mark" });
  mark.style.background = css;
  return element("li", {}, mark, label);
}

// A legend item that shows and hides a layer of the map.
export function layerItem(map, layer, label, css) {
  const mark = element("span", { class: "mark" });
  mark.style.background = css;
  const box = element("input", { type: "checkbox", checked: true, onchange: () => (box.checked ? layer.addTo(map) : layer.remove()) });
  return element("li", {}, element("label", {}, box, mark, label));
}
