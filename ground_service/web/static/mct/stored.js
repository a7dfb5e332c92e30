// Layouts that the service stores: an object provider over `displays`.
import { get, request } from "../api.js";
import { listen } from "./feed.js";

const NAMESPACE = "linna.stored";
const ROOT = "layouts";

const PAGE = 1000;
const ANNOTATION = "annotation";

// Labels of marked ranges of plots.
const TAGS = { anomaly: ["Anomaly", "#b3261e"], gap: ["Data gap", "#5f6368"], manoeuvre: ["Manoeuvre", "#7b4ba8"], check: ["To check", "#a15c00"], observation: ["Observation", "#1a73a8"], reference: ["Reference", "#2e7d32"] };

const versions = new Map(); // of the objects last read or written

async function summaries(signal) {
  const found = [];
  for (let offset = 0; ; offset += PAGE) {
    const page = await get("displays", { limit: PAGE, offset }, { signal });
    found.push(...page.items);
    if (!page.next) return found;
  }
}

// Keys of the stored objects, so that none is requested that does not exist.
let stored = null;
const listed = async () => new Set((await summaries()).map((one) => one.key));

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

// Annotations, each read again after it has changed.
const annotations = new Map();
async function allAnnotations(signal) {
  const found = (await summaries(signal)).filter((one) => one.type === ANNOTATION);
  return Promise.all(
    found.map(async ({ key, version }) => {
      if (annotations.get(key)?.version !== version) {
        const { document } = await get(`displays/${key}`, {}, { signal });
        annotations.set(key, { version, document });
      }
      if (version > (versions.get(key) ?? 0)) versions.set(key, version);
      return structuredClone(annotations.get(key).document); // Open MCT may change it
    }),
  );
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
    supportsSearchType: (type) => type === openmct.objects.SEARCH_TYPES.ANNOTATIONS || type === openmct.objects.SEARCH_TYPES.TAGS,
    search: async (query, signal, type) => {
      const found = await allAnnotations(signal);
      if (type === openmct.objects.SEARCH_TYPES.TAGS) return found.filter((one) => one.tags.some((tag) => query.includes(tag)));
      return found.filter((one) => one.targets.some((target) => target.keyString === query));
    },
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
  for (const [key, [label, backgroundColor]] of Object.entries(TAGS)) openmct.annotation.defineTag(key, { label, backgroundColor, foregroundColor: "#ffffff" });
  openmct.annotation.setNamespaceToSaveAnnotations(NAMESPACE);
  document.body.classList.toggle("is-viewer", session.role === "viewer");
  openmct.objects.addProvider(NAMESPACE, provider(openmct, session));
  openmct.objects.addRoot({ namespace: NAMESPACE, key: ROOT }, openmct.priority.LOW);
}
