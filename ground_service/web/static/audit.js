import { keep, restore, stated } from "./address.js";
import { get } from "./api.js";
import { acting, byId, element, pager, show, table, timeText, trouble } from "./page.js";

const FIELDS = ["actor", "action", "target", "since", "until"];
let chosen = Object.fromEntries(FIELDS.map((name) => [name, stated(name)]).filter(([, value]) => value));

function detail(entry) {
  const { text: named, ...rest } = entry.detail;
  if (named !== undefined) delete rest.arguments;
  const text = Object.entries({ ...rest, ...(named && { arguments: named }) })
    .map(([key, value]) => `${key.replaceAll("_", " ")} ${value !== null && typeof value === "object" ? JSON.stringify(value) : value}`)
    .join(", ");
  return text.length > 160 ? element("span", { title: text.slice(0, 2000) }, `${text.slice(0, 159)}…`) : text;
}

const load = pager(async (limit, offset) => {
  const [page, head] = await Promise.all([get("audit", { ...chosen, limit, offset }), get("audit/head")]);
  byId("head").textContent = head.number ? `Head of the chain: entry ${head.number}, ${head.sha256}` : "";
  show(
    "entries",
    table(
      "Audit log",
      [
        ["No", (row) => String(row.number), "num"],
        ["Time", (row) => timeText(row.time)],
        ["Actor", (row) => row.actor],
        ["Action", (row) => row.action],
        ["Target", (row) => row.target],
        ["Detail", detail],
        ["Hash", (row) => element("code", { title: row.sha256 }, row.sha256.slice(0, 12))],
      ],
      page.items,
      "No entry.",
    ),
  );
  return page;
});

byId("filter").addEventListener(
  "submit",
  acting(async () => {
    chosen = Object.fromEntries(FIELDS.map((name) => [name, byId(name).value.trim()]).filter(([, value]) => value));
    keep(...FIELDS);
    await load.first();
  }),
);
restore(...FIELDS);
load().catch((error) => error.status === 401 || trouble(error));
