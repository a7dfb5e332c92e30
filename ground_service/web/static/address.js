// State of a page in its address: filters, selections and zoom survive a reload and can be linked.
const given = () => new URLSearchParams(location.search);

export const stated = (name) => given().get(name);
export const statedAll = (name) => given().getAll(name);

// Values by name; null, "" and [] remove the name.
export function state(values) {
  const all = given();
  for (const [name, value] of Object.entries(values)) {
    all.delete(name);
    for (const one of [value].flat()) if (one !== null && one !== undefined && one !== "") all.append(name, one);
  }
  const text = all.toString();
  history.replaceState(null, "", `${location.pathname}${text ? `?${text}` : ""}${location.hash}`);
}

const valueOf = (input) => (input.type === "checkbox" ? (input.checked ? "1" : "") : input.value);

// Set inputs, named by their ids, to what the address states; a select only if it has the option.
export function restore(...ids) {
  for (const id of ids) {
    const input = document.getElementById(id);
    const value = stated(id);
    if (value === null) continue;
    if (input.type === "checkbox") input.checked = value === "1";
    else if (input instanceof HTMLSelectElement) {
      if ([...input.options].some((one) => one.value === value)) input.value = value;
    } else input.value = value;
  }
}

export const keep = (...ids) => state(Object.fromEntries(ids.map((id) => [id, valueOf(document.getElementById(id))])));

// Inputs that are in the address as soon as they change.
export function bind(...ids) {
  restore(...ids);
  for (const id of ids) document.getElementById(id).addEventListener("change", () => keep(id));
}
