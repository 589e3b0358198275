// The robots, and all that can be done with the chosen one.
import { useEffect, useState } from "preact/hooks";
import { Problem, request, robotPath } from "../api/client";
import type { CommandBody, Values } from "../api/types";
import { mayOperate, useConsole, useLive, useSeconds } from "../context";
import { Confirm } from "../dialog";
import { t } from "../i18n/i18n";
import { useRoute } from "../router";
import { sentence } from "../stop";
import { decimal, duration, metres, percent } from "../text";
import { blockedWay, headline, outOfService, stoppedBy, whys } from "../why";
import { GoalPanel, homeOf, sendTo } from "./goal-panel";
import { Visits } from "./places";
import { PosePanel } from "./pose-panel";
import { RobotCard } from "./robot-card";
import { ServicePanel } from "./service-panel";
import { VitalsFacts } from "./vitals";

type Kind = CommandBody["kind"];

export function RobotsView(): preact.JSX.Element {
  const { robot, robots, chooseRobot } = useConsole();
  const { chosen } = useRoute();
  useEffect(() => {
    if (chosen !== "" && chosen !== robot) chooseRobot(chosen);
  }, [chosen]);
  return (
    <>
      <h2>{t("view.robots")}</h2>
      {robots.length === 0 && <p class="muted">{t("robots.none")}</p>}
      {robots.length > 1 && (
        <ul class="cards">{robots.map((id) => <li key={id}><RobotCard id={id} chosen={id === robot} /></li>)}</ul>
      )}
      {robot !== null && robots.includes(robot) && <Details key={robot} id={robot} />}
      <Visits />
    </>
  );
}

function Details({ id }: { readonly id: string }): preact.JSX.Element {
  const { session } = useConsole();
  const live = useLive(["robot", "pose", "record"], id);
  useSeconds();
  const robot = live.of.robot.get(id);
  const state = robot?.state ?? null;
  const old = live.oldRobot(id);
  const stopped = stoppedBy(live.records, id);
  const reasons = state ? whys(state, stopped) : [];
  return (
    <section aria-labelledby="robot-title">
      <h2 id="robot-title" class="named"><bdi>{id}</bdi></h2>
      <div class={old ? "card stale" : "card"}>
        <p class="lead">{headline(state, robot?.goal ?? null, robot?.out_of_service, stopped)}</p>
        {old && <p class="problem">{t("robot.old")}</p>}
        {robot?.goal && robot.plan?.blocked_way && <p>{blockedWay(robot.plan.blocked_way)}</p>}
        {robot?.goal && robot.plan?.waits_for && <p>{t("way.letsPass", { who: robot.plan.waits_for })}</p>}
        {reasons.length > 1 && (
          <>
            <h3>{t("robot.why")}</h3>
            <ul class="rows">
              {reasons.map(({ says, remedy }) => <li key={says} class="row">{says}{remedy !== "" && <span class="value">{remedy}</span>}</li>)}
            </ul>
          </>
        )}
        {/* What stops it now comes first; that it gets no goal either is said all the same. */}
        {robot?.out_of_service && state && state.mode !== "NORMAL" && state.mode !== "INIT" && <p>{outOfService(robot.out_of_service)}</p>}
      </div>
      {/* What one comes to do stands before what one may read. */}
      {mayOperate(session) ? <Commands id={id} robot={robot} />
        : <p class="muted">{t("error.role", { role: t(`role.${session.role}`) })}</p>}
      <div class={old ? "card stale" : "card"}>
        <Facts id={id} robot={robot} />
        <VitalsFacts id={id} />
      </div>
    </section>
  );
}

function Facts({ id, robot }: { readonly id: string; readonly robot: Values["robot"] | undefined }): preact.JSX.Element {
  const { live } = useConsole();
  const pose = live.of.pose.get(id);
  const state = robot?.state ?? null;
  const place = robot?.goal?.place ?? null;
  const goal = robot?.goal
    ? place !== null ? live.of.place.get(place)?.label || place
      : t("goal.position", { x: decimal(robot.goal.pose.x, 1), y: decimal(robot.goal.pose.y, 1) })
    : t("robot.noGoal");
  const power = state?.power ?? null;
  const charging = state?.docked || (power?.charging != null && power.charging !== "no" && power.charging !== "fault");
  return (
    <dl class="facts">
      <dt>{t("robot.mode")}</dt><dd>{state ? t(`mode.${state.mode}`) : "–"}</dd>
      <dt>{t("robot.goal")}</dt><dd><bdi>{goal}</bdi></dd>
      <dt>{t("robot.rest")}</dt><dd>{robot?.goal ? metres(state?.goal_distance) : "–"}</dd>
      <dt>{t("robot.speed")}</dt><dd>{pose ? `${decimal(pose.v, 2)} m/s` : "–"}</dd>
      <dt>{t("robot.position")}</dt>
      <dd>{pose ? `${decimal(pose.x, 2)}, ${decimal(pose.y, 2)}` : "–"}{pose && !pose.localized && ` · ${t("robot.notLocalized")}`}</dd>
      <dt>{t("robot.battery")}</dt>
      <dd>{percent(state?.battery)}{power?.voltage_v != null && ` · ${decimal(power.voltage_v, 1)} V`}{charging && ` · ${t("robot.charging")}`}</dd>
      <dt>{t("robot.profile")}</dt><dd>{state?.profile ?? "–"}</dd>
      <dt>{t("robot.heard")}</dt><dd>{heard(live.robotAge(id))}</dd>
    </dl>
  );
}

const heard = (age: number): string => (age === Infinity ? "–" : t("ago", { age: duration(age / 1000) }));

interface CommandsProps {
  readonly id: string;
  readonly robot: Values["robot"] | undefined;
}

/** Which panel is open beneath the commands. */
type Open = "goal" | "pose" | "service" | null;

function Commands({ id, robot }: CommandsProps): preact.JSX.Element {
  const { live, say } = useConsole();
  const state = robot?.state ?? null;
  const out = robot?.out_of_service ?? null;
  const [asked, setAsked] = useState<"enable" | "reset" | null>(null);
  const [open, setOpen] = useState<Open>(null);
  const [waiting, setWaiting] = useState<Kind | null>(null);

  const run = async (kind: Kind): Promise<void> => {
    const command = t(`command.${kind as "enable"}`);
    setWaiting(kind);
    try {
      if (kind === "cancel") await request("DELETE", robotPath(id, "goal"));
      else {
        const body: CommandBody = { kind };
        await request("POST", robotPath(id, "commands"), { body });
        say(t("command.done", { robot: id, command, reason: t(kind === "dock" ? "command.docks" : "command.accepted") }));
        return;
      }
      say(t("command.done", { robot: id, command, reason: t("robot.noGoal") }));
    } catch (error) {
      const refused = error instanceof Problem && error.code === "command_refused";
      say(t(refused ? "command.refused" : "command.failed", { robot: id, command, reason: sentence(error) }), "failed");
    } finally {
      setWaiting(null);
    }
  };
  const goHome = async (): Promise<void> => {
    const home = homeOf(live, id);
    if (home === null) return;
    setWaiting("dock");
    await sendTo(live, say, id, home.body, home.name).catch(() => undefined);  // it has said so
    setWaiting(null);
  };
  const button = (kind: Kind, primary = false): preact.JSX.Element => (
    <button class={primary ? "primary" : ""} disabled={waiting !== null} onClick={() => void run(kind)}>
      {t(`command.${kind as "enable"}`)}
    </button>
  );
  const codes: readonly string[] = state?.codes ?? [];
  const fault = state?.mode === "FAULT";
  return (
    <>
      <h3>{t("robot.actions")}</h3>
      <div class="actions">
        <button class={state && !state.enabled && !fault ? "primary" : ""} onClick={() => setAsked("enable")}>{t("command.enable")}</button>
        {fault && <button class="primary" onClick={() => setAsked("reset")}>{t("command.reset")}</button>}
        {codes.includes("in_blocked") && button("egress", true)}
        {(codes.includes("bumper") || fault) && button("back_off")}
        {homeOf(live, id) && <button disabled={out !== null || waiting !== null} onClick={() => void goHome()}>{t("command.home")}</button>}
        {robot?.dock && !state?.docked && button("dock")}
        <button aria-expanded={open === "goal"} disabled={out !== null} onClick={() => setOpen(open === "goal" ? null : "goal")}>{t("command.goal")}</button>
        {robot?.goal && button("cancel")}
        {state?.docked && button("undock")}
        {!codes.includes("in_blocked") && button("egress")}
        <button aria-expanded={open === "service"} onClick={() => setOpen(open === "service" ? null : "service")}>
          {t(out ? "service.in" : "command.disable")}
        </button>
        <button aria-expanded={open === "pose"} onClick={() => setOpen(open === "pose" ? null : "pose")}>{t("command.initial_pose")}</button>
      </div>
      {open === "goal" && <GoalPanel id={id} onClose={() => setOpen(null)} />}
      {open === "service" && <ServicePanel id={id} out={out} onClose={() => setOpen(null)} />}
      {open === "pose" && <PosePanel id={id} onClose={() => setOpen(null)} />}
      {asked !== null && (
        <Confirm
          title={t(`${asked}.title`, { robot: id })}
          text={t(`${asked}.text`, { reason: state?.reasons[0] ?? "" })}
          what={t(`command.${asked}`)}
          onYes={() => void run(asked)}
          onClose={() => setAsked(null)}
        />
      )}
    </>
  );
}
