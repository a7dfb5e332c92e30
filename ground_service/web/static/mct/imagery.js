// Downlinked thumbnails and frames of pass archives as imagery.
import { get } from "../api.js";
import { addExtra } from "./dictionary.js";
import { listen, milliseconds } from "./feed.js";

const METADATA = {
  values: [
    { key: "name", source: "name", name: "Frame" },
    { key: "utc", source: "utc", name: "Spacecraft time", format: "utc", hints: { domain: 1 } },
    { key: "url", source: "url", name: "Image", format: "image", hints: { image: 1 } },
    { key: "file", source: "file", name: "File name", format: "string", hints: { imageDownloadName: 1 } },
  ],
};

function datum(one, detections) {
  const name = `frame ${one.frame_number}, ${one.source}`;
  const url = detections ? one.overlay : one.address;
  return { name, utc: milliseconds(one.time), url, file: `${name.replaceAll(/[ ,]+/g, "-")}.png` };
}

const LONGEST_MS = 31 * 86_400_000;

async function request({ spacecraft, detections }, { start, end, size, strategy, signal }) {
  const from = Math.max(start, end - LONGEST_MS, 0);
  const query = { instance: spacecraft.instance, start: new Date(from).toISOString(), stop: new Date(Math.max(end, 0)).toISOString() };
  const { items } = await get(`spacecraft/${spacecraft.spacecraft_id}/images`, query, { signal });
  const shown = detections ? items.filter((one) => one.overlay) : items;
  return (strategy === "latest" || size === 1 ? shown.slice(-1) : shown).map((one) => datum(one, detections));
}

function subscribe(openmct, object, callback) {
  const known = new Set();
  return listen("telemetry", async () => {
    try {
      const { start } = openmct.time.getBounds();
      const found = await request(object, { start, end: start + LONGEST_MS });
      const fresh = found.filter((one) => !known.has(one.url));
      fresh.forEach((one) => known.add(one.url));
      if (fresh.length) callback(fresh);
    } catch (error) {
      console.warn(`${object.name}: ${error.message}`);
    }
  });
}

export function installImagery(openmct) {
  const isImagery = (object) => object.type === "linna.images";
  openmct.types.addType("linna.images", { name: "Images", cssClass: "icon-image", creatable: false });
  const make = (name, detections) => () => ({ type: "linna.images", name, detections, telemetry: METADATA, configuration: { layers: [] } });
  addExtra("images", make("Images", false));
  addExtra("detections", make("Images with detections", true));
  openmct.telemetry.addProvider({
    supportsRequest: isImagery,
    request,
    supportsSubscribe: isImagery,
    subscribe: (object, callback) => subscribe(openmct, object, callback),
  });
}
