import { get } from "./api.js";
import { list } from "./lists.js";
import { byId, loading, shown } from "./page.js";

// Arguments of telecommands have names in their text.
const detail = ({ text, ...rest }) => shown("detail", text === undefined ? rest : { ...rest, arguments: text });

list("/audit", { columns: ["number", "time", "actor", "action", "target", ["Detail", (row) => detail(row.detail)], "sha256"], empty: "No entry." });

loading(async () => {
  const head = await get("audit/head");
  if (head.number) byId("hint").textContent = `Head of the chain: entry ${head.number}, ${head.sha256}`;
});
