// Tables of a TOML text, found by their headers and changed in place: comments, order and all other lines stay.
const HEADER = /^\s*\[{1,2}([^[\],]+)\]{1,2}\s*(#.*)?$/;
const ENTRY = /^\s*([\w-]+)\s*=\s*(.*)$/;
const depth = (text) => [...text.replace(/"(?:[^"\\]|\\.)*"|'[^']*'|#.*$/gm, "")].reduce((sum, sign) => sum + (sign === "[" ? 1 : sign === "]" ? -1 : 0), 0);

function parsed(raw) {
  const text = raw.match(/^"(?:[^"\\]|\\.)*"/)?.[0];
  if (text !== undefined) return JSON.parse(text);
  if (raw[0] === "'") return raw.slice(1, raw.indexOf("'", 1));
  if (raw[0] === "[") return [...raw.matchAll(/"((?:[^"\\]|\\.)*)"|'([^']*)'/g)].map(([, one, other]) => one ?? other);
  const [word] = raw.split(/[\s#]/);
  return ["true", "false"].includes(word) ? word === "true" : Number(word.replaceAll("_", ""));
}

// Entries of the lines of a table: key, value, and the lines that they take.
function entries(lines, from, to) {
  const found = [];
  for (let row = from + 1; row < to; row++) {
    const entry = lines[row].match(ENTRY);
    if (!entry) continue;
    const first = row;
    let raw = entry[2];
    while (depth(raw) > 0 && row + 1 < to) raw += `\n${lines[++row]}`;
    found.push({ key: entry[1], value: parsed(raw), from: first, to: row + 1 });
  }
  return found;
}

export function tables(text) {
  const lines = text.split("\n");
  const starts = [];
  let quote = null; // headers in strings of several lines are none
  lines.forEach((line, row) => {
    const header = quote ? null : line.match(HEADER);
    if (header) starts.push({ header: header[1].trim(), from: row });
    for (const [mark] of line.matchAll(/"""|'''/g)) quote = quote === mark ? null : (quote ?? mark);
  });
  return starts.map((one, index) => {
    const to = starts[index + 1]?.from ?? lines.length;
    const listed = entries(lines, one.from, to);
    return { ...one, to, entries: listed, values: Object.fromEntries(listed.map(({ key, value }) => [key, value])) };
  });
}

const line = (key, value) => `${key} = ${Array.isArray(value) ? `[${value.map((one) => JSON.stringify(one)).join(", ")}]` : JSON.stringify(value)}`;

// The text with a table that has these values; without a table they are one more at the end.
export function written(text, table, header, values) {
  if (!table) return `${text.trimEnd()}\n\n${[header, ...Object.entries(values).map(([key, value]) => line(key, value))].join("\n")}\n`;
  const lines = text.split("\n");
  const fresh = Object.keys(values).filter((key) => !(key in table.values)).map((key) => line(key, values[key]));
  lines.splice(table.entries.at(-1)?.to ?? table.from + 1, 0, ...fresh);
  for (const { key, value, from, to } of table.entries.toReversed()) {
    if (!(key in values)) lines.splice(from, to - from);
    else if (JSON.stringify(values[key]) !== JSON.stringify(value)) lines.splice(from, to - from, line(key, values[key]));
  }
  if (header) lines[table.from] = header;
  return lines.join("\n");
}

export const without = (text, table) => text.split("\n").toSpliced(table.from, table.to - table.from).join("\n");
