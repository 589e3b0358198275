// What the console asks the map-service about zones: saving, deleting, trying, undoing, and who has applied a change.
import { Problem, request } from "../api/client";
import type { AppliedChange, AuditEntry, DryRunBody, DryRunOutcome, Zone } from "../api/types";
import { t } from "../i18n/i18n";
import { bodyOf, type Draft } from "./draft";

/** So many entries back the own change is looked for. */
const READ_FOR_UNDO = 200;

const path = (id: string): string => `zones/${encodeURIComponent(id)}`;
const tag = (version: number): string => `"${version}"`;

/** What a save came to: stored, or somebody else was faster (their version; null: the zone is gone). */
export type Saved = { readonly zone: Zone } | { readonly theirs: Zone | null };

let last: { readonly content: string; readonly body: unknown; readonly key: string } | null = null;

/** Return what to send, with an Idempotency-Key: the very same as before if what it is made of is the same. */
export function attemptOf<T>(content: string, body: () => T): { readonly body: T; readonly key: string } {
  if (last?.content !== content) last = { content, body: body(), key: randomKey() };
  return last as { readonly content: string; readonly body: T; readonly key: string };
}

// `crypto.randomUUID` exists in secure contexts only, and a floor's address may have no certificate.
function randomKey(): string {
  return [...crypto.getRandomValues(new Uint8Array(16))].map((byte) => byte.toString(16).padStart(2, "0")).join("");
}

/** Store a draft, at `now` (s since the epoch, the server's); throws a `Problem` if it is refused or nobody answers. */
export async function save(draft: Draft, now: number): Promise<Saved> {
  const { shape } = draft.fields;
  if (!shape) throw new Error("a draft without a shape can't be saved");
  const version = draft.base ? tag(draft.base.version) : "";
  const { body, key } = attemptOf(JSON.stringify(draft), () => bodyOf(draft, shape, now));
  const headers = { "Idempotency-Key": key };
  let zone: Zone;
  try {
    if (draft.base) {
      zone = (await request<Zone>("PUT", path(draft.base.id), { body, headers: { ...headers, "If-Match": version } })).value;
    } else if (draft.id !== "") {
      zone = (await request<Zone>("PUT", path(draft.id), { body, headers: { ...headers, "If-None-Match": "*" } })).value;
    } else zone = (await request<Zone>("POST", "zones", { body, headers })).value;
  } catch (error) {
    const changed = error instanceof Problem && (error.status === 412 || (draft.base !== null && error.code === "no_zone"));
    if (!changed) throw error;
    return { theirs: await read(draft.id) };
  }
  // The next save is another request, even if it says the same.
  last = null;
  return { zone };
}

/** Return a zone as it is now, null if there is none. */
export async function read(id: string): Promise<Zone | null> {
  try {
    return (await request<Zone>("GET", path(id))).value;
  } catch (error) {
    if (error instanceof Problem && error.code === "no_zone") return null;
    throw error;
  }
}

/** Delete a zone as it is known; throws a `Problem`, with 412 if somebody has changed it meanwhile. */
export async function remove(zone: Zone): Promise<void> {
  await request("DELETE", path(zone.id), { headers: { "If-Match": tag(zone.version) } });
}

/** A change that was made here, and can be undone. */
export interface Change {
  readonly id: string;
  readonly before: Zone | null;
  readonly after: Zone | null;
}

/** Undo a change of this page, unless somebody has changed the zone since: then a `Problem` says who. */
export async function undo({ id, before, after }: Change): Promise<void> {
  const { value: entries } = await request<AuditEntry[]>("GET", `audit?kind=zone&limit=${READ_FOR_UNDO}`);
  const version = (value: unknown): unknown => (value as Partial<Zone> | null)?.version ?? null;
  const own = entries.find((entry) => entry.id === id && version(entry.after) === (after?.version ?? null)
    && (after !== null || version(entry.before) === before?.version));
  if (!own) throw new Problem(404, "no_entry", t("undo.tooOld"));
  await undoEntry("zones", id, own.entry);
}

/** What records are called in the paths of their undo. */
export type Undoing = "zones" | "zone-sets" | "places" | "areas" | "robots" | "map";

/** Undo a change by its entry in the audit trail. */
export async function undoEntry(of: Undoing, id: string, entry: string): Promise<void> {
  // There is one map.
  const record = of === "map" ? of : `${of}/${encodeURIComponent(id)}`;
  await request("POST", `${record}/undo`, { body: { entry } });
}

/** Return which robots drive by a map with the latest change of a zone; null if nobody knows any more. */
export async function applied(id: string): Promise<AppliedChange | null> {
  return (await request<AppliedChange[]>("GET", `applied?kind=zone&id=${encodeURIComponent(id)}`)).value[0] ?? null;
}

const BUSY_WAIT_MS = 700;
const BUSY_TRIES = 5;

/** Return what a change would do; null once `isWanted` says that nobody wants to know any more. */
export async function tryOut(body: DryRunBody, isWanted: () => boolean): Promise<DryRunOutcome | null> {
  for (let attempt = 0; isWanted(); attempt++) {
    try {
      return (await request<DryRunOutcome>("POST", "dry-run", { body })).value;
    } catch (error) {
      // One of one's own is still being computed, or others' are.
      const busy = error instanceof Problem && error.code === "busy";
      if (!busy || attempt >= BUSY_TRIES) throw error;
      await new Promise((done) => setTimeout(done, BUSY_WAIT_MS));
    }
  }
  return null;
}
