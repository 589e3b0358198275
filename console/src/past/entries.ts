// Entries of the timeline: in words, and which of them can be undone.
import type { TimelineEntry } from "../api/types";
import { maybe, t } from "../i18n/i18n";
import type { Undoing } from "../zones/requests";

export const KINDS = ["zone", "set", "source", "place", "map", "hazard", "override", "area", "mission", "robot", "service", "stop", "fault", "alert", "store"] as const;

/** Under which path a change is undone, by the kind of its record. */
const UNDONE_BY: Readonly<Record<string, Undoing>> = {
  zone: "zones", set: "zone-sets", place: "places", map: "map", area: "areas", override: "areas", mission: "robots",
  service: "robots",
};
/** Nobody decided these. */
const BY_ITSELF = new Set(["reached", "end"]);

/** Return the entries that can be undone, with the path for it: of each record the latest change that somebody decided. */
export function undoable(entries: readonly TimelineEntry[]): Map<string, Undoing> {
  const found = new Map<string, Undoing>();
  const seen = new Set<string>();
  for (const { kind, id, entry, action } of entries) {
    const service = UNDONE_BY[kind];
    const record = `${kind} ${id}`;
    if (service === undefined || entry === "" || seen.has(record)) continue;
    seen.add(record);
    if (!BY_ITSELF.has(action)) found.set(entry, service);
  }
  return found;
}

/** Return what happened, in words. */
export function entryText({ kind, id, action }: TimelineEntry): string {
  const what = maybe(`kind.${kind}`) ?? kind;
  const state = kind === "hazard" ? maybe(`state.${action}`) : null;
  const done = state ?? maybe(`action.${action}`) ?? action;
  return t("timeline.entry", { what, id, done });
}
