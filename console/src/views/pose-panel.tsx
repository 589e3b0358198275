// Tells a robot where it stands: by a drag on the map, by two clicks, or by numbers.
import { useEffect, useState } from "preact/hooks";
import { request, robotPath } from "../api/client";
import type { CommandBody, Point } from "../api/types";
import { useConsole, useShown } from "../context";
import { t } from "../i18n/i18n";
import { sentence } from "../stop";
import { degrees, NumberField, numberOf, radians } from "./numbers";

interface Props {
  readonly id: string;
  readonly onClose: () => void;
}

/** A drag that is shorter says no direction (m). */
const DRAG_MIN_M = 0.15;

export function PosePanel({ id, onClose }: Props): preact.JSX.Element {
  const { floor, live, say } = useConsole();
  const [x, setX] = useState("");
  const [y, setY] = useState("");
  const [theta, setTheta] = useState("");
  const [first, setFirst] = useState<Point | null>(null);
  const [problem, setProblem] = useState("");

  useEffect(() => {
    const place = (at: Point): void => {
      setX(at[0].toFixed(2));
      setY(at[1].toFixed(2));
    };
    const turn = (from: Point, to: Point): boolean => {
      if (Math.hypot(to[0] - from[0], to[1] - from[1]) < DRAG_MIN_M) return false;
      setTheta(degrees(Math.atan2(to[1] - from[1], to[0] - from[0])).toFixed(0));
      return true;
    };
    let waits: Point | null = null; // a first click, until the second
    floor?.setDrag((from, to, done) => {
      // While the second click is down, nobody knows yet that it is no drag: it moves nothing before it is one.
      if (waits && done && !turn(from, to)) {
        turn(waits, to);
        waits = null;
      } else if (!waits || turn(from, to)) {
        place(from);
        const turned = turn(from, to);
        if (done) waits = turned ? null : from;
      }
      setFirst(waits);
    });
    return () => {
      floor?.setDrag(null);
      floor?.previewPose(null);
    };
  }, [floor]);

  const position = [numberOf(x), numberOf(y), numberOf(theta)] as const;
  const [px, py, angle] = position;
  useEffect(() => {
    floor?.previewPose(px === null || py === null ? null : [px, py], radians(angle ?? 0));
  }, [floor, px, py, angle]);

  const places = [...live.of.place].filter(([, { theta: heading }]) => heading !== null && heading !== undefined);
  const send = async (event: Event): Promise<void> => {
    event.preventDefault();
    if (px === null || py === null || angle === null) return;
    const body: CommandBody = { kind: "initial_pose", pose: { x: px, y: py, theta: radians(angle) } };
    try {
      await request("POST", robotPath(id, "commands"), { body });
      say(t("pose.done", { robot: id }));
      onClose();
    } catch (error) {
      setProblem(sentence(error));
      say(t("command.refused", { robot: id, command: t("command.initial_pose"), reason: sentence(error) }), "failed");
    }
  };
  return (
    <form ref={useShown()} class="card" aria-label={t("pose.title", { robot: id })} onSubmit={(event) => void send(event)}>
      <h3>{t("pose.title", { robot: id })}</h3>
      <p class="muted" role="status">{first ? t("pose.pickHeading") : t("pose.pick")}</p>
      {places.length > 0 && (
        <label class="field">{t("goal.place")}
          <select value="" onChange={(event) => {
            const found = live.of.place.get(event.currentTarget.value);
            if (!found) return;
            setX(String(found.x));
            setY(String(found.y));
            setTheta(degrees(found.theta ?? 0).toFixed(0));
          }}>
            <option value="">–</option>
            {places.map(([name, { label }]) => <option key={name} value={name}>{label || name}</option>)}
          </select>
        </label>
      )}
      <div class="fields">
        <NumberField label="goal.x" value={x} onValue={setX} />
        <NumberField label="goal.y" value={y} onValue={setY} />
        <NumberField label="goal.theta" value={theta} onValue={setTheta} />
      </div>
      <p class="problem" role="alert">{problem}</p>
      <div class="actions">
        <button class="primary" disabled={px === null || py === null || angle === null}>{t("pose.send")}</button>
        <button type="button" onClick={onClose}>{t("cancel")}</button>
      </div>
    </form>
  );
}
