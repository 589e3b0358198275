// Sends a robot to a place or a position, and shows its path before that.
import { useEffect, useState } from "preact/hooks";
import { Problem, request, robotPath } from "../api/client";
import type { GoalBody, GoalView, PlanReply } from "../api/types";
import { type Say, useConsole, useLive, useShown } from "../context";
import { said } from "../i18n/codes";
import { t } from "../i18n/i18n";
import type { Live } from "../live/live";
import { toPoint } from "../map/geometry";
import { sentence } from "../stop";
import { decimal, metres } from "../text";
import { NumberField, numberOf, radians } from "./numbers";

interface Props {
  readonly id: string;
  readonly onClose: () => void;
}

interface Target {
  readonly place: string;
  readonly x: string;
  readonly y: string;
  readonly theta: string;
}

interface Preview {
  readonly text: string;
  readonly nearest: readonly [number, number] | null;
  readonly refused: boolean;
}

const NOWHERE: Target = { place: "", x: "", y: "", theta: "" };
const PAUSE_MS = 250;
const at = (x: number, y: number): Target => ({ place: "", x: x.toFixed(2), y: y.toFixed(2), theta: "" });

export function GoalPanel({ id, onClose }: Props): preact.JSX.Element {
  const { floor, say } = useConsole();
  const live = useLive(["place"]);
  const [target, setTarget] = useState<Target>(NOWHERE);
  const [preview, setPreview] = useState<Preview | null>(null);
  const [sending, setSending] = useState(false);

  useEffect(() => {
    floor?.setPick(([x, y]) => setTarget(at(x, y)));
    return () => {
      floor?.setPick(null);
      floor?.preview([]);
    };
  }, [floor]);

  const place = target.place === "" ? undefined : live.of.place.get(target.place);
  const x = place ? place.x : numberOf(target.x);
  const y = place ? place.y : numberOf(target.y);
  const heading = numberOf(target.theta);

  useEffect(() => {
    floor?.preview([]);
    setPreview(null);
    if (x === null || y === null) return;
    const pose = live.of.pose.get(id);
    if (!pose?.localized) {
      setPreview({ text: t("goal.noPose", { robot: id }), nearest: null, refused: false });
      return;
    }
    let current = true;
    const look = async (): Promise<void> => {
      setPreview({ text: t("goal.planning"), nearest: null, refused: false });
      const goal = { x, y, theta: place?.theta ?? (heading === null ? 0 : radians(heading)) };
      const shown = await plan({ x: pose.x, y: pose.y, theta: pose.theta }, goal);
      if (!current) return;
      floor?.preview(shown.points);
      if (shown.points.length > 1) floor?.reveal(shown.points);
      setPreview(shown.preview);
    };
    const timer = setTimeout(() => void look(), PAUSE_MS);
    return () => {
      current = false;
      clearTimeout(timer);
    };
  }, [floor, id, x, y]);

  const send = async (event: Event): Promise<void> => {
    event.preventDefault();
    if (x === null || y === null) return;
    const body: GoalBody = place ? { place: target.place }
      : { pose: { x, y, theta: heading === null ? null : radians(heading) } };
    const name = place ? place.label || target.place : nameOf(x, y);
    setSending(true);
    try {
      await sendTo(live, say, id, body, name);
      onClose();
    } catch (error) {
      const nearest = error instanceof Problem ? error.extra.nearest : null;
      setPreview({
        text: sentence(error), refused: true,
        nearest: Array.isArray(nearest) ? [Number(nearest[0]), Number(nearest[1])] : null,
      });
      setSending(false);
    }
  };

  return (
    <form ref={useShown()} class="card" aria-label={t("goal.title", { robot: id })} onSubmit={(event) => void send(event)}>
      <h3>{t("goal.title", { robot: id })}</h3>
      <p class="muted">{t("goal.pick")}</p>
      <label class="field">{t("goal.place")}
        <select value={target.place} onChange={(event) => setTarget({ ...NOWHERE, place: event.currentTarget.value })}>
          <option value="">–</option>
          {[...live.of.place].map(([name, { label }]) => <option key={name} value={name}>{label || name}</option>)}
        </select>
      </label>
      <div class="fields">
        <NumberField label="goal.x" value={place ? String(place.x) : target.x} onValue={(text) => setTarget({ ...target, place: "", x: text })} />
        <NumberField label="goal.y" value={place ? String(place.y) : target.y} onValue={(text) => setTarget({ ...target, place: "", y: text })} />
        <NumberField
          label="goal.theta" value={place ? "" : target.theta} placeholder={t("goal.anyHeading")}
          onValue={(text) => setTarget({ ...target, place: "", theta: text })}
        />
      </div>
      <p role="status" class={preview?.refused ? "problem" : ""}>{preview?.text ?? ""}</p>
      {preview?.nearest && (
        <p>
          {t("goal.nearest", { x: decimal(preview.nearest[0], 1), y: decimal(preview.nearest[1], 1) })}{" "}
          <button type="button" onClick={() => preview.nearest && setTarget(at(...preview.nearest))}>{t("goal.useNearest")}</button>
        </p>
      )}
      <div class="actions">
        <button class="primary" disabled={sending || x === null || y === null}>{t("goal.send")}</button>
        <button type="button" onClick={onClose}>{t("cancel")}</button>
      </div>
    </form>
  );
}

const nameOf = (x: number, y: number): string => t("goal.position", { x: decimal(x, 1), y: decimal(y, 1) });

/** Send a robot, and say so, or why not; throws what went wrong. */
export async function sendTo(live: Live, say: Say, id: string, body: GoalBody, name: string): Promise<void> {
  try {
    const { value } = await request<GoalView>("PUT", robotPath(id, "goal"), { body });
    const waits = live.of.robot.get(id)?.state?.enabled === false;
    say(t(waits ? "goal.waits" : "goal.sent", { robot: id, goal: name }), "done", () => live.of.robot.get(id)?.goal?.goal_id === value.goal_id);
  } catch (error) {
    say(t("goal.failed", { robot: id, reason: sentence(error) }), "failed");
    throw error;
  }
}

/** A place is where a robot begins if it is so near to it (m). */
const HOME_M = 0.5;

/** Return where a robot is at home: the place `home`, else where it begins by the site's file; null: it has a dock, or none. */
export function homeOf({ of }: Live, id: string): { readonly body: GoalBody; readonly name: string } | null {
  const robot = of.robot.get(id);
  const start = robot?.start;
  const found = of.place.has("home") ? "home"
    : !start || robot.dock ? undefined : [...of.place].find(([, { x, y }]) => Math.hypot(x - start.x, y - start.y) <= HOME_M)?.[0];
  if (found !== undefined) return { body: { place: found }, name: of.place.get(found)?.label || found };
  return start && !robot.dock ? { body: { pose: start }, name: nameOf(start.x, start.y) } : null;
}

interface Position {
  readonly x: number;
  readonly y: number;
  readonly theta: number;
}

/** Ask the planner for the path, without sending the robot. */
async function plan(start: Position, goal: Position): Promise<{ points: [number, number][]; preview: Preview }> {
  try {
    const { value } = await request<PlanReply>("POST", "plan", { body: { start, goal } });
    const { refusal } = value;
    if (refusal) {
      const nearest = refusal.nearest ? toPoint(refusal.nearest) : null;
      return { points: [], preview: { text: t("goal.refused", { reason: said(refusal.kind, refusal.reason) }), nearest, refused: true } };
    }
    const points = (value.points ?? []).map((pair): [number, number] => [...toPoint(pair)]);
    return { points, preview: { text: t("goal.length", { length: metres(value.length) }), nearest: null, refused: false } };
  } catch (error) {
    return { points: [], preview: { text: sentence(error), nearest: null, refused: true } };
  }
}
