// Names and units of parameters as people read them.

// Names of parameters end in their unit, which is shown next to them: "bus voltage, V" for bus_voltage_v.
const UNIT_SUFFIX = { degC: "_c", V: "_v", W: "_w", KiB: "_kib", "1/1000": "_permille", deg: "_deg", m: "_m", "m/s": "_m_s" };
export const parameterName = (name, unit) => (unit in UNIT_SUFFIX && name.endsWith(UNIT_SUFFIX[unit]) ? name.slice(0, -UNIT_SUFFIX[unit].length) : name).replaceAll("_", " ");

export const unitText = (unit) => ({ degC: "°C", deg: "°", "1/1000": "‰" })[unit] ?? unit;
