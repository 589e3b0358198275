// Zones in words.
import type { AppliedChange, Values } from "../api/types";
import { t } from "../i18n/i18n";
import { clockTime, duration } from "../text";
import { type End, stateOf } from "./draft";

/** Return when a zone ends. */
export function endText(end: End): string {
  switch (end.type) {
    case "never":
      return t("end.never");
    case "after":
      return t("end.after", { time: duration(end.seconds) });
    case "at":
      return t("end.at", { time: clockTime(end.stamp) });
  }
}

/** Return whether a zone is in force, why not, and until when; `now` in s since the epoch. */
export function stateText(zone: Values["zone"], now: number): string {
  const state = stateOf(zone, now);
  const rest = zone.expires_at === null ? "" : duration(Math.max(0, zone.expires_at - now));
  switch (state) {
    case "expiring":
      return t("state.expiring", { rest });
    case "toCome":
      return t("state.toCome", { time: clockTime(zone.starts_at ?? 0) });
    case "active":
      return zone.expires_at === null ? t("state.active") : t("state.activeUntil", { time: clockTime(zone.expires_at) });
    default:
      return t(`state.${state}`);
  }
}

const SILENT_S = 10;

/** Return which robots drive by a map with a change, which not yet, and of which nobody knows. */
export function appliedText({ robots }: AppliedChange): string {
  const silent = robots.filter((each) => !each.applied && each.age_s > SILENT_S);
  const groups = [
    [t("applied.by"), robots.filter((each) => each.applied)],
    [t("applied.notYet"), robots.filter((each) => !each.applied && !silent.includes(each))],
    [t("applied.silent"), silent],
  ] as const;
  const texts = groups.flatMap(([text, which]) => (which.length === 0 ? [] : [`${text} ${which.map(({ robot }) => robot).join(", ")}`]));
  return texts.length === 0 ? t("applied.none") : texts.join("; ");
}
