// Lists of the API as pages: columns and filters by the schemas of the operation, as the OpenAPI document has them.
import { keep, restore } from "./address.js";
import { get } from "./api.js";
import { entered, property } from "./forms.js";
import { acting, byId, element, loading, pager, schemas, show, showTable } from "./page.js";

const PAGING = ["limit", "offset"];
export const NOTHING = null; // a query that no item can answer

// The filters of the operation in the form of the page, kept in its address.
function filterForm(form, properties, load) {
  const names = Object.keys(properties).filter((name) => !PAGING.includes(name));
  form.hidden = !names.length;
  show(form, names.map((name) => property(name, name, properties[name], { none: "any" })), element("button", { class: "primary" }, "Show"));
  const choose = acting(async () => {
    keep(...names);
    await load().first();
  });
  form.addEventListener("submit", choose);
  for (const one of form.querySelectorAll("select")) one.addEventListener("change", choose);
  restore(...names);
}

// A list in the element `place`. Without `columns` it has all fields of its entity, without `query` the filters of its
// operation; `rows` adds to its items. `ready` is waited for; messages that `concerns` accepts bring the list again. Returns what loads it.
export function list(path, { place = "items", caption = document.querySelector("h1").textContent, columns, query, rows = (found) => found, empty = "None.", size, ready, concerns } = {}) {
  const { filters, items } = schemas[path];
  const form = query ? null : byId("filter");
  if (form) filterForm(form, filters.properties, () => load);
  const load = pager(async (limit, offset) => {
    const asked = query ? await query() : form && entered(form, filters.properties);
    const page = asked === NOTHING ? { items: [], total: 0 } : await get(path.slice(1), { limit, offset, ...asked });
    showTable(place, caption, columns ?? Object.keys(items.properties), await rows(page.items), typeof empty === "string" ? empty : empty());
    return page;
  }, size);
  loading(() => Promise.resolve(ready).then(load), concerns);
  return load;
}

// Options of a list of spacecraft; the value is number and instance.
export async function spacecraftOptions(id, ...first) {
  const { items } = await get("spacecraft");
  const keys = [...new Set(items.map((one) => `${one.spacecraft_id} ${one.instance}`))];
  show(id, first, keys.map((key) => element("option", { value: key }, key.replace(" ", ", "))));
  restore(id);
  return keys;
}

export const spacecraftOf = (id) => {
  const [spacecraft, ...instance] = byId(id).value.split(" ");
  return { spacecraft_id: spacecraft || null, instance: instance.join(" ") || null };
};
