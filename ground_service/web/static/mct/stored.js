// Layouts that the service stores: an object provider over `displays`.
import { get, request } from "../api.js";
import { listen } from "./feed.js";

const NAMESPACE = "linna.stored";
const ROOT = "layouts";

const PAGE = 1000;

const versions = new Map(); // of the objects last read or written

// Keys of the stored objects, so that none is requested that does not exist.
let stored = null;
async function listed() {
  const keys = new Set();
  for (let offset = 0; ; offset += PAGE) {
    const page = await get("displays", { limit: PAGE, offset });
    page.items.forEach((one) => keys.add(one.key));
    if (!page.next) return keys;
  }
}

async function read(key) {
  stored ??= listed();
  if (!(await stored).has(key)) return undefined;
  const { version, document } = await get(`displays/${key}`);
  versions.set(key, version);
  return document;
}

// Writes of an object follow each other, since each one states the version that the one before it made.
const writing = new Map();
function afterWrites(key, work) {
  const done = (writing.get(key) ?? Promise.resolve()).catch(() => {}).then(work);
  writing.set(key, done);
  return done;
}

const emptyRoot = () => ({ identifier: { namespace: NAMESPACE, key: ROOT }, name: "Stored layouts", type: "folder", composition: [], location: "ROOT" });

function provider(openmct, session) {
  async function write(object) {
    const { identifier, name, type } = object;
    const json = { name, type, document: JSON.parse(JSON.stringify(object)) }; // Open MCT may change it in the meantime
    return afterWrites(identifier.key, () => put(identifier.key, json));
  }
  async function put(key, json) {
    try {
      const answer = await request(`displays/${key}`, {
        method: "PUT",
        headers: { "Content-Type": "application/json" },
        body: JSON.stringify({ ...json, version: versions.get(key) ?? 0 }),
      });
      versions.set(key, (await answer.json()).version);
      (await stored)?.add(key);
    } catch (error) {
      if (error.status === 409) throw new openmct.objects.errors.Conflict(error.message);
      openmct.notifications.error(`"${json.name}" was not stored: ${error.message}`);
      throw error;
    }
    return true;
  }
  return {
    get: async ({ key }) => (await read(key)) ?? (key === ROOT ? emptyRoot() : undefined),
    create: write,
    update: write,
    isReadOnly: () => session.role === "viewer",
    observe: ({ key }, callback) =>
      listen("display", async ({ payload }) => {
        if (payload.key !== key || payload.version === undefined) return;
        await writing.get(key)?.catch(() => {}); // it may be this write
        if (payload.version <= (versions.get(key) ?? 0)) return;
        const found = await read(key);
        if (found) callback(found);
      }),
  };
}

export function installStored(openmct, session) {
  listen("display", async ({ payload }) => {
    if (payload.version === undefined) {
      (await stored)?.delete(payload.key);
      versions.delete(payload.key);
    } else (await stored)?.add(payload.key);
  });
  openmct.objects.addProvider(NAMESPACE, provider(openmct, session));
  openmct.objects.addRoot({ namespace: NAMESPACE, key: ROOT }, openmct.priority.LOW);
}
