// Our Parquet files in a reader without native code: node hyparquet.mjs hyparquet SAMPLES OUT.
import fs from "node:fs";
import { createRequire } from "node:module";
import path from "node:path";
import { pathToFileURL } from "node:url";

const [, , , samples, out] = process.argv;
const packages = createRequire(path.join(process.env.NODE_PATH, "x.js"));
const { parquetReadObjects } = await import(pathToFileURL(packages.resolve("hyparquet")));
const { compressors } = await import(pathToFileURL(packages.resolve("hyparquet-compressors")));
const octets = fs.readFileSync(path.join(samples, "parquet", "housekeeping.parquet"));
const file = octets.buffer.slice(octets.byteOffset, octets.byteOffset + octets.byteLength);
const entry = { way: "reads", what: "Parquet" };
try {
  const rows = await parquetReadObjects({ file, compressors });
  const [header, ...table] = JSON.parse(fs.readFileSync(path.join(samples, "expected.json"), "utf8")).tables.housekeeping;
  const chosen = header.map((name, k) => [name, k]).filter(([name, k]) => name in rows[0] && table.every((row) => typeof row[k] === "number"));
  entry.expects = table.map((row) => chosen.map(([, k]) => row[k]));
  entry.values = rows.map((row) => chosen.map(([name]) => Number(row[name])));
} catch (error) {
  entry.refused = String(error).slice(0, 160);
}
fs.writeFileSync(path.join(out, "cells.json"), JSON.stringify([entry]));
