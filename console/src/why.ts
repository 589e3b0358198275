// Why a robot stands or drives slowly, in one sentence, and what to do about it.
import type { GoalView, OutOfService, RobotState } from "./api/types";
import { language, t } from "./i18n/i18n";
import { REASONS } from "./reasons";
import { clockTime } from "./text";

export interface Why {
  /** What is the matter. */
  readonly says: string;
  /** What to do; empty: it passes by itself, or nobody wrote it down. */
  readonly remedy: string;
}

/** Return the robot's reasons, the most important first. A newer robot may have some that the console does not know. */
export function whys(state: RobotState): Why[] {
  return state.reasons.map((sentence, i) => {
    const known = REASONS[state.codes?.[i] ?? ""];
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

/** Return one sentence about what a robot does, or why not. */
export function headline(state: RobotState | null, goal: GoalView | null, out: OutOfService | null = null): string {
  // Whoever asks why it gets no goal must not read that it has none.
  if (out && (!state || state.mode === "NORMAL" || state.mode === "INIT")) return outOfService(out);
  if (!state) return t("robot.noState");
  const [first] = whys(state);
  if (first && state.mode !== "NORMAL") return first.remedy === "" ? first.says : `${first.says}. ${first.remedy}`;
  if (state.goal_reached) return t("robot.arrived");
  if (!goal && state.goal_id === null) return t("robot.idle");
  return first ? first.says : t("robot.allWell");
}
