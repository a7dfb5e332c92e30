import { get, send } from "./api.js";
import { acting, byId, element, notice, show, stateMark, table, timeText, trouble } from "./page.js";

const ROLES = ["viewer", "operator", "admin"];

const button = (text, task, label) =>
  element("button", { type: "button", onclick: acting(task), "aria-label": label ?? null }, text);

function daysValid() {
  const text = byId("days").value.trim();
  return text ? Number(text) : null;
}

const missionsText = (row) => row.missions?.join(", ") ?? "all";

function missionsGiven() {
  const names = byId("missions").value.split(",").map((name) => name.trim()).filter(Boolean);
  return names.length ? names : null;
}

function showToken(made) {
  show(
    "given",
    element("p", {}, `Token of ${made.user.name}; copy it now, it cannot be shown again:`),
    element("p", { class: "breakable" }, element("code", {}, made.token)),
    button("Hide", () => show("given")),
  );
}

function roleChoice(user) {
  const choice = element("select", { "aria-label": `role of ${user.name}` }, ROLES.map((role) => element("option", {}, role)));
  choice.value = user.role;
  choice.addEventListener(
    "change",
    acting(async () => {
      try {
        await send("PATCH", `users/${encodeURIComponent(user.name)}`, { role: choice.value });
        notice(`${user.name} is ${choice.value} now.`);
      } finally {
        await load();
      }
    }),
  );
  return choice;
}

function userActions(user) {
  const path = `users/${encodeURIComponent(user.name)}`;
  const next = user.state === "active" ? "disabled" : "active";
  const verb = user.state === "active" ? "Disable" : "Enable";
  return element(
    "span",
    {},
    button(
      verb,
      async () => {
        await send("PATCH", path, { state: next });
        notice(`${user.name} is ${next} now.`);
        await load();
      },
      `${verb} ${user.name}`,
    ),
    " ",
    button(
      "New token",
      async () => {
        showToken(await send("POST", `${path}/tokens`, { days_valid: daysValid() }));
        await load();
      },
      `New token for ${user.name}`,
    ),
  );
}

function kindOf(token) {
  if (token.kind === "session") return `browser session of token ${token.parent_id}`;
  return token.kind === "token" ? "token" : "browser session by the provider";
}

function tokenAction(token) {
  if (token.state !== "active") return "";
  return button(
    "Revoke",
    async () => {
      await send("DELETE", `tokens/${token.id}`);
      notice(`Token ${token.id} of ${token.user} is revoked.`);
      await load();
    },
    `Revoke token ${token.id} of ${token.user}`,
  );
}

async function load() {
  const { role } = await get("session");
  byId("refused").hidden = role === "admin";
  if (role !== "admin") return;
  const [users, tokens] = await Promise.all([get("users"), get("tokens")]);
  show(
    "users",
    table(
      "Users",
      [
        ["Name", (row) => row.name],
        ["Role", (row) => (row.provider ? row.role : roleChoice(row))],
        ["Missions", missionsText],
        ["From", (row) => (row.provider ? element("span", { class: "breakable" }, row.provider) : "this service")],
        ["State", (row) => stateMark(row.state)],
        ["Since", (row) => timeText(row.created)],
        ["Actions", userActions],
      ],
      users.items,
      "No user: everybody on this machine is an administrator. The first user should be an administrator.",
    ),
  );
  show(
    "tokens",
    table(
      "Tokens",
      [
        ["No", (row) => String(row.id), "num"],
        ["User", (row) => row.user],
        ["Kind", kindOf],
        ["Missions", missionsText],
        ["Start", (row) => element("code", {}, `${row.hint}…`)],
        ["State", (row) => stateMark(row.state)],
        ["Created", (row) => timeText(row.created)],
        ["Expires", (row) => (row.expires ? timeText(row.expires) : "never")],
        ["Last use", (row) => (row.used ? timeText(row.used) : "never")],
        ["Actions", tokenAction],
      ],
      tokens.items,
      "No token.",
    ),
  );
}

byId("add").addEventListener(
  "submit",
  acting(async () => {
    const given = { name: byId("name").value.trim(), role: byId("role").value, missions: missionsGiven(), days_valid: daysValid() };
    showToken(await send("POST", "users", given));
    byId("name").value = byId("missions").value = "";
    await load();
  }),
);
load().catch((error) => error.status === 401 || trouble(error));
