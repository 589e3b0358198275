// What a change would do, before it is made: in words beside the form, and at robots and places on the map.
import L from "leaflet";
import { useEffect, useState } from "preact/hooks";
import { Problem } from "../api/client";
import type { DryRunBody, DryRunOutcome, Point } from "../api/types";
import { useConsole } from "../context";
import { said } from "../i18n/codes";
import { t } from "../i18n/i18n";
import type { Live } from "../live/live";
import { sentence } from "../stop";
import { duration, metres } from "../text";
import { tryOut } from "./requests";

const WAIT_MS = 500;
const LEAST_M = 0.1;
const LEAST_S = 1;

export interface Effect {
  readonly text: string;
  /** Where it is shown on the map: at a robot or a place. */
  readonly at: { readonly robot: string } | { readonly place: string } | null;
  /** The same in a few characters, for the map. */
  readonly short: string;
  readonly bad: boolean;
}

type Robot = DryRunOutcome["robots"][number];
type Reach = DryRunOutcome["cut_off"][number];

/** Return what a dry run found, the worst first. */
export function effectsOf(outcome: DryRunOutcome): Effect[] {
  const found = [
    ...outcome.robots.flatMap(robotEffects),
    ...outcome.cut_off.map((reach) => reachEffect(reach, true)),
    ...outcome.connected.map((reach) => reachEffect(reach, false)),
    ...outcome.unfinished.map((robot): Effect => ({ text: t("effect.unfinished", { robot }), at: { robot }, short: "?", bad: false })),
  ];
  return found.sort((a, b) => Number(b.bad) - Number(a.bad));
}

function robotEffects({ robot, before, after, replanned, extra_m: extraM, extra_s: extraS, inside, way_out: wayOut }: Robot): Effect[] {
  const found: Effect[] = [];
  const add = (text: string, short: string, bad: boolean): void => void found.push({ text, short, bad, at: { robot } });
  if (inside.length > 0) {
    const refused = wayOut?.refusal;
    add(refused ? t("effect.insideNoWay", { robot, reason: said(refused.kind, refused.reason) }) : t("effect.inside", { robot }), t("effect.insideShort"), true);
  }
  if (after?.refusal) {
    if (!before?.refusal) add(t("effect.noPath", { robot, reason: said(after.refusal.kind, after.refusal.reason) }), t("effect.noPathShort"), true);
  } else if (after && before?.refusal) {
    add(t("effect.pathAgain", { robot }), t("effect.pathShort"), false);
  } else if (extraM !== null && extraS !== null && (Math.abs(extraM) >= LEAST_M || Math.abs(extraS) >= LEAST_S)) {
    const values = { robot, metres: metres(Math.abs(extraM), Math.abs(extraM) < 10 ? 1 : 0), time: duration(Math.abs(extraS)) };
    if (Math.abs(extraM) < LEAST_M) add(t(extraS > 0 ? "effect.slower" : "effect.faster", values), `${extraS > 0 ? "+" : "−"}${values.time}`, false);
    else add(t(extraM > 0 ? "effect.longer" : "effect.shorter", values), `${extraM > 0 ? "+" : "−"}${values.metres}`, false);
  } else if (replanned) add(t("effect.otherPath", { robot }), t("effect.pathShort"), false);
  return found;
}

function reachEffect({ kind, id, closed, robots, places, more }: Reach, lost: boolean): Effect {
  const name = kind === "dock" ? t("effect.dock", { robot: id }) : `'${id}'`;
  const from = [...robots, ...places.map((place) => `'${place}'`)].join(", ") + (more > 0 ? t("effect.more", { number: more }) : "");
  const text = !lost ? t("effect.connected", { name })
    : closed ? t("effect.closed", { name }) : from === "" ? t("effect.cutOff", { name }) : t("effect.cutOffFrom", { name, from });
  return { text, at: kind === "place" ? { place: id } : null, short: lost ? "✕" : "✓", bad: lost };
}

export type Trial = { readonly state: "waiting" } | { readonly state: "failed"; readonly reason: string; readonly invalid: boolean }
  | { readonly state: "done"; readonly effects: readonly Effect[] };

/** Try a change out whenever it differs from the last one; null: there is nothing to try. */
export function useTrial(body: DryRunBody | null): Trial | null {
  const [trial, setTrial] = useState<Trial | null>(null);
  const key = body === null ? "" : JSON.stringify(body);
  useEffect(() => {
    if (key === "") {
      setTrial(null);
      return;
    }
    let wanted = true;
    setTrial({ state: "waiting" });
    const ask = async (): Promise<void> => {
      try {
        const outcome = await tryOut(JSON.parse(key) as DryRunBody, () => wanted);
        if (wanted && outcome) setTrial({ state: "done", effects: effectsOf(outcome) });
      } catch (error) {
        const invalid = error instanceof Problem && error.status === 422;
        if (wanted) setTrial({ state: "failed", reason: sentence(error), invalid });
      }
    };
    // Who drags or types goes on in a moment.
    const timer = setTimeout(() => void ask(), WAIT_MS);
    return () => {
      wanted = false;
      clearTimeout(timer);
    };
  }, [key]);
  return trial;
}

/** The trial in words, and on the map. */
export function Effects({ trial }: { readonly trial: Trial | null }): preact.JSX.Element {
  const { floor, live } = useConsole();
  useEffect(() => {
    if (!floor || trial?.state !== "done") return;
    const marks = L.layerGroup(trial.effects.flatMap((effect) => {
      const at = placeOf(effect, live);
      return at ? [mark(at, effect)] : [];
    }));
    marks.addTo(floor.map);
    return () => void marks.remove();
  }, [floor, live, trial]);
  return (
    <section class="effects" aria-label={t("effect.title")} aria-busy={trial?.state === "waiting"}>
      <h3>{t("effect.title")}</h3>
      <div role="status">
        {trial === null && <p class="muted">{t("effect.noShape")}</p>}
        {trial?.state === "waiting" && <p class="muted">{t("effect.waiting")}</p>}
        {trial?.state === "failed" && (
          <p class="problem">{trial.invalid ? trial.reason : t("effect.failed", { reason: trial.reason })}</p>
        )}
        {trial?.state === "done" && trial.effects.length === 0 && <p class="fine">{t("effect.none")}</p>}
        {trial?.state === "done" && trial.effects.length > 0 && (
          <ul>{trial.effects.map((effect) => <li key={effect.text} class={effect.bad ? "bad" : ""}>{effect.text}</li>)}</ul>
        )}
      </div>
    </section>
  );
}

function placeOf({ at }: Effect, live: Live): Point | null {
  if (at === null) return null;
  const found = "robot" in at ? live.of.pose.get(at.robot) : live.of.place.get(at.place);
  return found ? [found.x, found.y] : null;
}

function mark([x, y]: Point, effect: Effect): L.Marker {
  const text = document.createElement("span");
  text.textContent = effect.short;
  const icon = L.divIcon({ className: `effect ${effect.bad ? "bad" : ""}`, html: text, iconSize: [0, 0] });
  return L.marker([y, x], { icon, interactive: false, keyboard: false });
}
