// Positions and directions of our CZML in CesiumJS, without a page: node cesium.cjs cesium SAMPLES OUT.
const fs = require("fs");
const path = require("path");
const [, , , samples, out] = process.argv;
const entries = [];
globalThis.Image = class {}; // CesiumJS makes pictures of points, which nothing here looks at

async function main() {
  const Cesium = require("cesium");
  const text = JSON.parse(fs.readFileSync(path.join(samples, "pass.czml"), "utf8"));
  const source = await Cesium.CzmlDataSource.load(text);
  const craft = source.entities.getById("spacecraft");
  const written = text.find((one) => one.id === "spacecraft").position;
  const right = [];
  const values = [];
  for (let k = 0; k < written.cartesian.length; k += 4) {
    const [seconds, ...place] = written.cartesian.slice(k, k + 4);
    const at = Cesium.JulianDate.addSeconds(Cesium.JulianDate.fromIso8601(written.epoch), seconds, new Cesium.JulianDate());
    const found = craft.position.getValueInReferenceFrame(at, Cesium.ReferenceFrame.FIXED);
    right.push([seconds, ...place]);
    values.push([seconds, found.x, found.y, found.z]);
  }
  entries.push({ way: "reads", what: "CZML, positions of the spacecraft", expects: right, values });
  entries.push({ way: "reads", what: "CZML, entities", expects: [text.length - 1], values: [source.entities.values.length] });
}

main()
  .catch((error) => entries.push({ way: "reads", what: "CZML", refused: String(error).slice(0, 160) }))
  .finally(() => {
    fs.writeFileSync(path.join(out, "cells.json"), JSON.stringify(entries));
    process.exit(0);
  });
