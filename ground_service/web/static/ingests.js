// Received files; one of another flight is withdrawn.
import { send } from "./api.js";
import { list } from "./lists.js";
import { button, confirmed, element, notice, schemas } from "./page.js";

const withdraw = (row) => async () => {
  const reason = element("input", { maxlength: 500 });
  const lines = ["Everything is derived again without this file. The file, its entry and the audit log stay.", element("label", {}, "Reason ", reason)];
  if (!(await confirmed(`Withdraw ingest ${row.id}?`, lines, "Withdraw"))) return;
  await send("POST", `ingests/${row.id}/withdraw`, { reason: reason.value.trim() });
  notice(`Ingest ${row.id} is being withdrawn.`);
  await load();
};

const action = (row) => (row.state === "done" ? button("Withdraw", withdraw(row), { name: `Withdraw ingest ${row.id}` }) : "");
const load = list("/ingests", { columns: [...Object.keys(schemas["/ingests"].items.properties), ["Actions", action]] });
