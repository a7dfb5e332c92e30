import { list } from "./lists.js";
import { element } from "./page.js";

list("/missions", {
  columns: [["Mission", (row) => element("a", { href: `/missions/${row.revision.slice(0, 16)}` }, row.mission)], "revision", "spacecraft_id", "entered", ["By", "entered_by"], ["Not stated", (row) => String(row.unknown.length), "num"]],
  empty: "No mission description yet: linna mission write makes the text of one.",
});
