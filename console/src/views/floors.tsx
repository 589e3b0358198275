// All floors of a building: how each is, how old that is, and one stop for one of them or for all.
import { useEffect, useState } from "preact/hooks";
import { request } from "../api/client";
import type { FloorEntry, FloorStop, FloorView } from "../api/types";
import { useConsole, useSeconds } from "../context";
import { t } from "../i18n/i18n";
import { sentence } from "../stop";
import { clockTime, duration } from "../text";

const PERIOD_MS = 1_000;
/** A floor has 6 s for its answer. */
const STOP_MS = 12_000;
/** So many floors are seen at once. */
const SEARCHED = 6;

interface Known {
  readonly entries: readonly FloorEntry[];
  /** When they were asked for (ms of the page's clock). */
  readonly at: number;
  /** The console's server has not answered since. */
  readonly lost: boolean;
}

/** Return the number of floors that this console knows, its own among them; 1 until it is known. */
export function useFloorCount(): number {
  const [count, setCount] = useState(1);
  useEffect(() => {
    request<FloorEntry[]>("GET", "floors").then(({ value }) => setCount(value.length), () => setCount(1));
  }, []);
  return count;
}

function useFloors(): Known | null {
  const [known, setKnown] = useState<Known | null>(null);
  useEffect(() => {
    let ended = false;
    let timer: ReturnType<typeof setTimeout> | undefined;
    const ask = async (): Promise<void> => {
      const at = performance.now();
      try {
        const { value } = await request<FloorEntry[]>("GET", "floors", { timeout: 5_000 });
        if (!ended) setKnown({ entries: value, at, lost: false });
      } catch {
        if (!ended) setKnown((before) => before && { ...before, lost: true });
      }
      if (!ended) timer = setTimeout(() => void ask(), PERIOD_MS);
    };
    void ask();
    return () => {
      ended = true;
      clearTimeout(timer);
    };
  }, []);
  return known;
}

export function FloorsView(): preact.JSX.Element {
  const { say } = useConsole();
  const known = useFloors();
  const [sought, setSought] = useState("");
  const [failed, setFailed] = useState<readonly FloorStop[]>([]);
  useSeconds();

  const stop = async (floors: readonly string[] | null): Promise<void> => {
    say(t("stop.sending"));
    try {
      const { value } = await request<FloorStop[]>("POST", "floors/stop", { body: { floors }, timeout: STOP_MS });
      const missing = value.filter((each) => !each.acknowledged);
      // One floor's answer says nothing of another that has not acknowledged an earlier stop.
      setFailed((before) => [...before.filter(({ id }) => value.every((each) => each.id !== id)), ...missing]);
      const done = value.filter((each) => each.acknowledged).map((each) => each.id).join(", ");
      if (missing.length === 0) say(t("floors.stopped", { floors: done }));
      else say(t("floors.notStopped", { floors: missing.map((each) => each.id).join(", ") }), "failed");
    } catch (error) {
      say(t("floors.stopFailed", { reason: sentence(error) }), "failed");
    }
  };

  const entries = known?.entries ?? [];
  const shown = entries.filter((entry) => entry.id.includes(sought.trim().toLowerCase()));
  return (
    <>
      <h2>{t("view.floors")}</h2>
      <div class="actions">
        <button class="stop all" onClick={() => void stop(null)}>
          <span class="octagon" aria-hidden="true" /><span>{t("floors.stopAll")}</span>
        </button>
      </div>
      {failed.length > 0 && (
        <section class="card" role="alert">
          <h3>{t("floors.missing")}</h3>
          <ul class="rows">{failed.map((each) => <li key={each.id} class="row"><b><bdi>{each.id}</bdi></b><span class="why">{each.detail}</span></li>)}</ul>
          <button onClick={() => setFailed([])}>{t("floors.seen")}</button>
        </section>
      )}
      {known?.lost && <p class="problem">{t("error.unreachable")}</p>}
      {entries.length > SEARCHED && (
        <label class="field">{t("floors.search")}
          <input type="search" value={sought} onInput={(event) => setSought(event.currentTarget.value)} />
        </label>
      )}
      <ul class="cards">
        {shown.map((entry) => (
          <li key={entry.id}>
            <FloorCard entry={entry} since={(performance.now() - (known?.at ?? 0)) / 1000} lost={known?.lost === true} onStop={() => void stop([entry.id])} />
          </li>
        ))}
      </ul>
      {known !== null && shown.length === 0 && <p class="muted">{t("floors.none")}</p>}
    </>
  );
}

interface CardProps {
  readonly entry: FloorEntry;
  /** How long ago (s) the list was asked for. */
  readonly since: number;
  readonly lost: boolean;
  readonly onStop: () => void;
}

function FloorCard({ entry, since, lost, onStop }: CardProps): preact.JSX.Element {
  const { id, floor, reachable } = entry;
  const present = reachable && !lost;
  return (
    <article class="card" aria-label={id}>
      <div class={present ? "" : "stale"}>
        <h3 class="named">{entry.address === "" ? <bdi>{id}</bdi> : <a href={entry.address} target="_blank" rel="noreferrer"><bdi>{id}</bdi></a>}</h3>
        {floor === null ? <p class="muted">{t("floors.unknown")}</p> : <State floor={floor} />}
        <p class="muted">{entry.age_s === null ? "" : t("floors.age", { age: duration(entry.age_s + Math.max(0, since)) })}</p>
      </div>
      {!reachable && (
        <p class="problem">
          {entry.heard === null ? t("floors.never") : t("floors.since", { time: clockTime(entry.heard) })}
          {" "}{t(`floors.trouble.${entry.trouble === "" ? "silent" : entry.trouble}`)}
        </p>
      )}
      <button class="danger" onClick={onStop}>{t("floors.stop", { floor: id })}</button>
    </article>
  );
}

function State({ floor }: { readonly floor: FloorView }): preact.JSX.Element {
  const lacking = Object.entries(floor.not_ready);
  return (
    <>
      <p class="lead">{floor.stopped ? t("floors.isStopped") : lacking.length === 0 ? t("floors.ready") : t("floors.notReady")}</p>
      <ul class="rows">
        {lacking.map(([service, missing]) => <li key={service} class="row"><b>{service}</b><span class="why">{missing}</span></li>)}
        {floor.robots.map((robot) => (
          <li key={robot.id} class="row">
            <b><bdi>{robot.id}</bdi></b>
            <span class="value">
              {robot.age_s === null || robot.mode === null ? t("floors.unheard") : t(`mode.${robot.mode}`)}
              {robot.age_s !== null && robot.age_s > 2 && ` · ${t("ago", { age: duration(robot.age_s) })}`}
            </span>
          </li>
        ))}
        {(["blocked", "unknown"] as const).map((state) => floor[state].length > 0 && (
          <li key={state} class="row">
            <span class={`swatch ${state}`} aria-hidden="true" />
            <bdi>{floor[state].join(", ")}</bdi><span class="value">{t(`state.${state}`)}</span>
          </li>
        ))}
      </ul>
    </>
  );
}
