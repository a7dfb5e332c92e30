import { get } from "./api.js";
import { element, pager, show, table, timeText, trouble } from "./page.js";

const load = pager(async (limit, offset) => {
  const page = await get("missions", { limit, offset });
  show(
    "revisions",
    table(
      "Revisions of mission descriptions, the newest first",
      [
        ["Mission", (row) => element("a", { href: `/missions/${row.revision.slice(0, 16)}` }, row.mission)],
        ["Revision", (row) => element("code", { title: row.revision }, row.revision.slice(0, 12))],
        ["Spacecraft", (row) => (row.spacecraft_id === null ? "not stated" : String(row.spacecraft_id)), "num"],
        ["Entered", (row) => timeText(row.entered)],
        ["By", (row) => row.entered_by],
        ["Not stated", (row) => String(row.unknown.length), "num"],
      ],
      page.items,
      "No mission description yet: linna mission write makes the text of one.",
    ),
  );
  return page;
});

load().catch((error) => error.status === 401 || trouble(error));
