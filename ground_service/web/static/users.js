import { get, send } from "./api.js";
import { acting, button, buttons, byId, element, loading, notice, on, show, showTable, timeText } from "./page.js";

const ROLES = ["viewer", "operator", "admin"];

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
    button("Hide", () => show("given"), { needs: "admin" }),
  );
}

// A change of a user or token: it is shown, and the lists are read again even if it was refused.
const changing = (task, message) => async () => {
  try {
    await task();
    notice(message());
  } finally {
    await load();
  }
};

function roleChoice(user) {
  const choice = element("select", { "aria-label": `role of ${user.name}` }, ROLES.map((role) => element("option", {}, role)));
  choice.value = user.role;
  const change = () => send("PATCH", `users/${encodeURIComponent(user.name)}`, { role: choice.value });
  choice.addEventListener("change", acting(changing(change, () => `${user.name} is ${choice.value} now.`)));
  return choice;
}

function userActions(user) {
  const path = `users/${encodeURIComponent(user.name)}`;
  const [verb, next] = user.state === "active" ? ["Disable", "disabled"] : ["Enable", "active"];
  const newToken = async () => {
    showToken(await send("POST", `${path}/tokens`, { days_valid: daysValid() }));
    await load();
  };
  return buttons(
    button(verb, changing(() => send("PATCH", path, { state: next }), () => `${user.name} is ${next} now.`), { name: `${verb} ${user.name}`, needs: "admin" }),
    button("New token", newToken, { name: `New token for ${user.name}`, needs: "admin" }),
  );
}

function kindOf(token) {
  if (token.kind === "session") return `browser session of token ${token.parent_id}`;
  return token.kind === "token" ? "token" : "browser session by the provider";
}

function tokenAction(token) {
  if (token.state !== "active") return "";
  const revoke = changing(() => send("DELETE", `tokens/${token.id}`), () => `Token ${token.id} of ${token.user} is revoked.`);
  return button("Revoke", revoke, { name: `Revoke token ${token.id} of ${token.user}`, needs: "admin" });
}

async function load() {
  const { role } = await get("session");
  byId("refused").hidden = role === "admin";
  if (role !== "admin") return;
  const [users, tokens] = await Promise.all([get("users"), get("tokens")]);
  const origin = (row) => (row.provider ? element("span", { class: "breakable" }, row.provider) : "this service");
  showTable(
    "users",
    "Users",
    ["name", ["Role", (row) => (row.provider ? row.role : roleChoice(row))], ["Missions", missionsText], ["From", origin], "state", ["Since", "created"], ["Actions", userActions]],
    users.items,
    "No user: everybody on this machine is an administrator. The first user should be an administrator.",
  );
  const never = (field) => (row) => timeText(row[field]) || "never";
  const hint = (row) => element("code", {}, `${row.hint}…`);
  showTable(
    "tokens",
    "Tokens",
    ["id", "user", ["Kind", kindOf], ["Missions", missionsText], ["Start", hint], "state", "created", ["Expires", never("expires")], ["Last use", never("used")], ["Actions", tokenAction]],
    tokens.items,
    "No token.",
  );
}

on("add", "submit", async () => {
  const given = { name: byId("name").value.trim(), role: byId("role").value, missions: missionsGiven(), days_valid: daysValid() };
  showToken(await send("POST", "users", given));
  byId("name").value = byId("missions").value = "";
  await load();
});
loading(load);
