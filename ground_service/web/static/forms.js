// Forms from the JSON schemas of what they enter: parts of a mission description, telecommands, filters of lists.
import { element, labelled, words } from "./page.js";

// An input or, with options as pairs of value and text, a select; in its label.
export function control({ id, name = id, label, title, options, value, ...attributes }) {
  const made = options
    ? element("select", { id, name, required: attributes.required }, options.map(([one, text]) => element("option", { value: one }, text)))
    : element("input", { id, name, autocomplete: "off", value, ...attributes });
  if (options && value !== undefined && value !== null) made.value = value;
  return element("label", { title }, label, made);
}

// What a schema says of a value that is not null; lists are entered with commas, and chosen by one of their values.
const stated = (schema) => ({ ...schema.anyOf?.find((one) => one.type !== "null"), ...schema });
const choices = (one) => one.enum ?? one.items?.enum ?? (one.type === "boolean" ? [true, false] : null);
const isNumber = (one) => ["number", "integer"].includes(one.type);

const ENDS = { min: "least", max: "greatest" };
const isPair = (schema) => schema.anyOf?.some((one) => one.$ref?.endsWith("/Limits")) ?? false;
const pair = (id, name, title) => {
  const end = ([key, word]) => element("input", { id: `${id}-${key}`, name: `${name}.${key}`, type: "number", step: "any", "aria-label": `${word} ${labelled(name)}` });
  return element("label", { title }, labelled(name), element("span", { class: "pair" }, Object.entries(ENDS).map(end)));
};

// The control of a property of a schema; `none` is the text of no value.
export function property(id, name, schema, { required = false, value, none = "not stated" } = {}) {
  if (isPair(schema)) return pair(id, name, schema.description);
  const one = stated(schema);
  const options = choices(one)?.map((each) => [String(each), typeof each === "boolean" ? (each ? "yes" : "no") : words(each)]);
  const numeric = isNumber(one) ? { type: "number", step: one.type === "integer" ? 1 : "any", min: one.minimum ?? one.exclusiveMinimum, max: one.maximum ?? one.exclusiveMaximum } : {};
  return control({
    id,
    name,
    label: labelled(name),
    title: one.description,
    options: options && (required ? options : [["", one.default === undefined || one.default === null ? none : `${none} (${one.default})`], ...options]),
    pattern: one.pattern?.replace(/([^\\])-\]/g, "$1\\-]"), // as browsers want it
    maxlength: one.maxLength,
    placeholder: one.default ?? (one.format === "date-time" ? one.examples[0] : one.type === "array" ? "with commas" : null),
    required,
    value,
    ...numeric,
  });
}

// Values of the controls in a place; what is empty is not stated.
export function entered(place, properties) {
  const value = (text, one) => {
    if (isNumber(one)) return Number(text);
    if (one.type === "boolean") return text === "true";
    return one.type === "array" ? text.split(",").map((each) => each.trim()).filter(Boolean) : text;
  };
  const found = {};
  for (const each of place.querySelectorAll("input, select")) {
    const [name, end] = each.name.split(".");
    if (!(name in properties) || !each.value.trim()) continue;
    if (end) found[name] = { ...found[name], [end]: each.valueAsNumber };
    else found[name] = value(each.value.trim(), stated(properties[name]));
  }
  return found;
}
