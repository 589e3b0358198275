// Entries of the timeline: in words, and which of them can be undone.
import type { Pose, TimelineEntry } from "../api/types";
import { said, saidAll, saidCause } from "../i18n/codes";
import { language, maybe, t } from "../i18n/i18n";
import { decimal, duration } from "../text";
import type { Undoing } from "../zones/requests";

export const KINDS = ["zone", "set", "source", "place", "map", "hazard", "override", "area", "mission", "schedule", "robot", "service", "stop", "fault", "alert", "store"] as const;

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

/** Return the details of what happened, empty without any. */
export function detailText({ kind, text, codes, decided_by: by, overridden, after }: TimelineEntry): string {
  if (kind === "stop") return repeatsText(after);
  if (kind === "mission") return goalText(after);
  if (kind === "schedule") return (after as { readonly last?: { readonly reason?: string } | null } | null)?.last?.reason ?? "";
  if (kind === "alert") {
    const { code, reason } = (after ?? {}) as { readonly code?: string; readonly reason?: string };
    return said(code, reason ?? "");
  }
  if (kind !== "hazard") return saidAll(codes, text);
  if (overridden) return language() === "en" ? text : t("area.overridden");
  return saidCause(codes[0] ?? "", by, text);
}

/** Return where a robot was sent; empty for a mission that ended. */
function goalText(after: unknown): string {
  const { goal } = (after ?? {}) as { readonly goal?: { readonly place?: string | null; readonly pose?: Pose | null } };
  if (goal?.place) return goal.place;
  return goal?.pose ? t("goal.position", { x: decimal(goal.pose.x, 1), y: decimal(goal.pose.y, 1) }) : "";
}

/** Return how often stops were repeated, and by whom; empty for one that is told by itself. */
function repeatsText(after: unknown): string {
  const { repeats, period_s: period } = (after ?? {}) as { readonly repeats?: Readonly<Record<string, number>>; readonly period_s?: number };
  if (repeats === undefined) return "";
  const count = Object.values(repeats).reduce((sum, each) => sum + each, 0);
  const who = Object.entries(repeats).map(([name, times]) => `${name} ${times}`).join(", ");
  return t("timeline.repeats", { count, time: duration(period ?? 0), who });
}

/** Return what happened, in words. */
export function entryText({ kind, id, action }: TimelineEntry): string {
  const what = maybe(`kind.${kind}`) ?? kind;
  const state = kind === "hazard" ? maybe(`state.${action}`) : null;
  const done = state ?? maybe(`action.${action}`) ?? maybe(`command.${action}`) ?? action;
  return t("timeline.entry", { what, id, done });
}
