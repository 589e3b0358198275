// Why a robot stands or drives slowly, in one sentence, and what to do about it.
import type { AuditEntry, BlockedWay, GoalView, OutOfService, RobotState } from "./api/types";
import { language, t } from "./i18n/i18n";
import { REASONS } from "./reasons";
import { clockTime, duration } from "./text";

export interface Why {
  /** What is the matter. */
  readonly says: string;
  /** What to do; empty: it passes by itself, or nobody wrote it down. */
  readonly remedy: string;
}

export type Stopped = Pick<AuditEntry, "who" | "at">;

/** Return by whom and when a robot was stopped last, unless somebody has enabled it since; null: nobody has. */
export function stoppedBy(records: readonly AuditEntry[], robot: string): Stopped | null {
  const stops = ["stop", "disable"];
  let last: AuditEntry | null = null;
  for (const entry of records) {
    const counts = entry.id === robot && (entry.kind === "stop" || entry.kind === "robot") && [...stops, "enable"].includes(entry.action);
    if (counts && (last === null || entry.at > last.at)) last = entry;
  }
  return last !== null && stops.includes(last.action) ? last : null;
}

/** Return the robot's reasons, the most important first. A newer robot may have some that the console does not know. */
export function whys(state: RobotState, stopped: Stopped | null = null): Why[] {
  return state.reasons.map((sentence, i) => {
    const code = state.codes?.[i] ?? "";
    const known = REASONS[code];
    if (code === "not_enabled" && stopped) {
      return { says: t("why.stopped", { who: stopped.who, time: clockTime(stopped.at) }), remedy: t("why.enable") };
    }
    // The robot's own sentences are English, and have figures.
    return language() === "pt" && known
      ? { says: known.pt, remedy: known.remedyPt }
      : { says: sentence, remedy: known?.remedy ?? "" };
  });
}

/** Return that a robot is out of service, by whom, why and till when, and what ends that. */
export function outOfService({ reason, by, until }: OutOfService): string {
  const end = until === null ? "" : t("service.until", { time: clockTime(until) });
  return `${t("service.is", { reason, by, end })} ${t("service.remedy")}`;
}

/** Return that a robot waits before something in its way, or goes round it, and what both cost. */
export function blockedWay({ choice, causes, expected_s, detour_s, limit_s }: BlockedWay): string {
  const places = causes.map(({ id }) => id).join(", ");
  const figures = { places, wait: duration(expected_s), round: duration(detour_s), limit: duration(limit_s ?? 0) };
  return t(choice === "wait" ? "way.waits" : "way.goesRound", figures);
}

/** Return one sentence about what a robot does, or why not. */
export function headline(state: RobotState | null, goal: GoalView | null, out: OutOfService | null = null, stopped: Stopped | null = null): string {
  // Whoever asks why it gets no goal must not read that it has none.
  if (out && (!state || state.mode === "NORMAL" || state.mode === "INIT")) return outOfService(out);
  if (!state) return t("robot.noState");
  const [first] = whys(state, stopped);
  if (first && state.mode !== "NORMAL") return first.remedy === "" ? first.says : `${first.says.replace(/\.$/, "")}. ${first.remedy}`;
  if (state.goal_reached) return t("robot.arrived");
  if (!goal && state.goal_id === null) return t("robot.idle");
  return first ? first.says : t("robot.allWell");
}
