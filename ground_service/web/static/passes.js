import { get, send } from "./api.js";
import { acting, byId, element, lengthText, notice, pager, seconds, show, table, timeText, trouble } from "./page.js";

const load = pager(async (limit, offset) => {
  const page = await get("passes", { limit, offset });
  show(
    "passes",
    table(
      "Passes",
      [
        ["Pass", (row) => element("a", { href: `/passes/${row.id}` }, row.name)],
        ["Start", (row) => timeText(row.start)],
        ["Stop", (row) => timeText(row.stop)],
        ["Length", (row) => lengthText(seconds(row.stop) - seconds(row.start)), "num"],
      ],
      page.items,
      "No pass yet.",
    ),
  );
  return page;
});

byId("define").addEventListener(
  "submit",
  acting(async () => {
    const made = await send("POST", "passes", {
      name: byId("name").value,
      start: byId("start").value,
      stop: byId("stop").value,
      spacecraft_id: byId("spacecraft").valueAsNumber,
    });
    notice(`${made.name} is kept as pass ${made.id}`);
    await load();
  }),
);

load().catch((error) => error.status === 401 || trouble(error));
