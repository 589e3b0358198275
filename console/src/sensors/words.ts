// Areas in words, and what they count as.
import type { AreaState, AreaView } from "../api/types";
import { t } from "../i18n/i18n";
import { clockTime, percent } from "../text";

const ALL_SEEN = 0.995; // which percent() rounds to 100 %

/** Whether sensors show a part of a blocked area free, through which robots may pass slowly. */
export function isPartlyFree({ hazard }: AreaView): boolean {
  return hazard?.state === "blocked" && (hazard.free ?? []).length > 0;
}

/** Whether an area was last told to be clear, and nobody says that this still holds, or robots do not go by it. */
function isUnconfirmed({ hazard, on_map: shown }: AreaView): boolean {
  if (hazard?.state !== "clear" || shown === undefined) return false;
  return shown === null || !shown.confirmed || shown.state !== "clear";
}

/** Return what an area is shown as: clear only while the map confirms it. */
export function shownState(area: AreaView): AreaState {
  return isUnconfirmed(area) ? "unknown" : area.hazard?.state ?? "unknown";
}

/** Return on how much of a clear area its sensors would notice something, empty where that is all or nobody knows. */
function seenText({ hazard, seen_share: share }: AreaView): string {
  const told = hazard?.state === "clear" && typeof share === "number" && share < ALL_SEEN;
  return told ? `, ${t("area.seen", { share: percent(share) })}` : "";
}

/** Return what an area's state is called, and since when it has it. */
export function areaText(area: AreaView): string {
  const { hazard } = area;
  if (!hazard) return t("state.unknown");
  // Since when nobody confirms it, nobody has said.
  if (isUnconfirmed(area)) return t("area.unconfirmed");
  const text = t(`state.${hazard.state}`) + (hazard.override ? ` (${t("area.overridden")})` : "");
  const part = isPartlyFree(area) ? `, ${t("area.part_free")}` : "";
  return `${text} ${t("since", { time: clockTime(hazard.since) })}${part}${seenText(area)}`;
}
