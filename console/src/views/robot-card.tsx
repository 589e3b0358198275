// A robot in a few lines: mode, why it stands, battery.
import { useConsole, useLive, useSeconds } from "../context";
import { t } from "../i18n/i18n";
import { tone } from "../map/robot-layer";
import { go } from "../router";
import { decimal, percent } from "../text";
import { headline, stoppedBy } from "../why";
import { vitalsText } from "./vitals";

interface Props {
  readonly id: string;
  readonly chosen: boolean;
}

export function RobotCard({ id, chosen }: Props): preact.JSX.Element {
  const { chooseRobot } = useConsole();
  const live = useLive(["robot", "pose", "vitals", "record"], id);
  useSeconds(); // it becomes old without any event
  const robot = live.of.robot.get(id);
  const pose = live.of.pose.get(id);
  const vitals = live.of.vitals.get(id);
  const state = robot?.state ?? null;
  const old = live.oldRobot(id);
  return (
    <button
      class={`card robot ${old ? "stale" : ""}`} aria-pressed={chosen}
      onClick={() => {
        chooseRobot(id);
        go("robots", id);
      }}
    >
      <span class="head">
        <b><bdi>{id}</bdi></b>
        <span class={`badge ${old ? "" : tone(state?.mode)}`}>{state ? t(`mode.${state.mode}`) : "–"}</span>
        <span class="value">{percent(state?.battery)} · {pose ? `${decimal(pose.v, 2)} m/s` : "–"}</span>
      </span>
      {(vitals || robot?.out_of_service) && (
        <span class="head">
          {robot?.out_of_service && <span class="badge">{t("service.badge")}</span>}
          {vitals && <span class="muted">{vitalsText(vitals)}</span>}
        </span>
      )}
      <span class="why">{old ? t("robot.old") : headline(state, robot?.goal ?? null, robot?.out_of_service, stoppedBy(live.records, id))}</span>
    </button>
  );
}
