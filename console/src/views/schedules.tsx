// Missions that begin by the clock: what runs when, what became of it, and the form of one.
import { useRef, useState } from "preact/hooks";
import { Problem, request } from "../api/client";
import type { ScheduleBody, ScheduledMission, StopBody } from "../api/types";
import { mayOperate, useConsole, useLive, useRead, useShown } from "../context";
import { said } from "../i18n/codes";
import { t } from "../i18n/i18n";
import type { Live } from "../live/live";
import { go, useRoute } from "../router";
import { sentence } from "../stop";
import { decimal, zonedTime } from "../text";
import { Typed } from "../typed";
import { newSchedule, ScheduleFields, scheduleText } from "../zones/schedule";
import { refusal } from "../zones/zone-form";
import "../zones/zones.css";

/** Stands in the address where a schedule's id would: ids have no plus. */
const NEW = "+new";
/** How often the list is read again: that a mission waits for its robot is no record. */
const AGAIN_MS = 5_000;

/** What to do when every way to a stop is cut. */
const CUTS = ["wait", "cancel", "nearest"] as const;

const pathOf = (id: string): string => `schedules/${encodeURIComponent(id)}`;
const tagOf = ({ version }: ScheduledMission): Record<string, string> => ({ "If-Match": `"${version}"` });
const bodyOf = ({ robot, mission, weekly, enabled }: ScheduledMission): ScheduleBody => ({ robot, mission, weekly, enabled });

export function SchedulesView(): preact.JSX.Element {
  const { session, say } = useConsole();
  const live = useLive(["place"]);
  const { chosen } = useRoute();
  const { value: found, problem, again } = useRead<ScheduledMission[]>("schedules", ["record", "ready"], AGAIN_MS);
  const [removed, setRemoved] = useState<ScheduledMission | null>(null);
  const operates = mayOperate(session);
  // What is due comes first, then what is next; what never begins is the last.
  const rank = ({ waits, next }: ScheduledMission): number => (waits === "" ? next ?? Infinity : 0);
  const missions = [...found ?? []].sort((a, b) => rank(a) - rank(b) || a.id.localeCompare(b.id));
  // What is edited stays open when somebody else deletes it.
  const edited = useRef<ScheduledMission | undefined>(undefined);
  edited.current = missions.find(({ id }) => id === chosen) ?? (edited.current?.id === chosen ? edited.current : undefined);
  if (operates && (chosen === NEW || edited.current)) {
    return <ScheduleForm key={chosen} base={edited.current ?? null} onDone={() => {
      again();
      go("schedules");
    }} />;
  }

  const change = async (id: string, what: Promise<unknown>, done: string): Promise<boolean> => {
    try {
      await what;
      say(done);
      return true;
    } catch (error) {
      say(t("schedules.failed", { id, reason: sentence(error) }), "failed");
      return false;
    } finally {
      again();
    }
  };
  const toggle = (one: ScheduledMission): void => {
    const { id, enabled } = one;
    const body = { ...bodyOf(one), enabled: !enabled };
    void change(id, request("PUT", pathOf(id), { body, headers: tagOf(one) }), t(enabled ? "schedules.off" : "schedules.on", { id }));
  };
  const remove = async (one: ScheduledMission): Promise<void> => {
    if (await change(one.id, request("DELETE", pathOf(one.id), { headers: tagOf(one) }), t("schedules.removed", { id: one.id }))) setRemoved(one);
  };
  const putBack = async (one: ScheduledMission): Promise<void> => {
    const put = request("PUT", pathOf(one.id), { body: bodyOf(one), headers: { "If-None-Match": "*" } });
    if (await change(one.id, put, t("schedules.back", { id: one.id }))) setRemoved(null);
  };
  return (
    <>
      {removed && operates && (
        <p class="undo card"><span>{t("schedules.removed", { id: removed.id })}</span> <button onClick={() => void putBack(removed)}>{t("undo")}</button></p>
      )}
      <h2>{t("filter.schedule")}</h2>
      {operates ? <div class="choices"><button class="primary" onClick={() => go("schedules", NEW)}>{t("schedules.new")}</button></div>
        : <p class="muted">{t("error.role", { role: t(`role.${session.role}`) })}</p>}
      {problem !== "" && <p class="problem" role="alert">{problem}</p>}
      {found?.length === 0 && <p class="muted">{t("schedules.none")}</p>}
      <ul class="rows">
        {missions.map((one) => (
          <li key={one.id} class="zone-row">
            <div class="row">
              <b><bdi>{one.id}</bdi></b>
              <span><bdi>{one.robot}</bdi></span>
              <span class="value">{nextText(one)}</span>
            </div>
            <p class="why">
              <bdi>{one.mission.stops.map((stop) => stopText(live, stop)).join(" → ")}</bdi>{one.mission.order === "best" && ` (${t("schedules.best")})`}
            </p>
            <p class="why">{scheduleText(one.weekly)}</p>
            {one.waits !== "" && <p class="state expiring"><bdi>{t("schedules.waits", { reason: said(one.waits_code, one.waits) })}</bdi></p>}
            {one.last && <p class={one.last.outcome === "missed" ? "problem" : "why"}><bdi>{lastText(one)}</bdi></p>}
            {operates && (
              <div class="row-actions">
                <button aria-label={t("schedules.editOf", { id: one.id })} onClick={() => go("schedules", one.id)}>{t("zones.edit")}</button>
                <button aria-label={t(one.enabled ? "schedules.offOf" : "schedules.onOf", { id: one.id })} onClick={() => toggle(one)}>
                  {t(one.enabled ? "zones.switchOff" : "zones.switchOn")}
                </button>
                <button aria-label={t("schedules.removeOf", { id: one.id })} onClick={() => void remove(one)}>{t("zones.remove")}</button>
              </div>
            )}
          </li>
        ))}
      </ul>
    </>
  );
}

function nextText({ enabled, next, weekly }: ScheduledMission): string {
  if (!enabled) return t("schedules.isOff");
  return next === null ? t("schedules.noNext") : t("schedules.next", { time: zonedTime(next, weekly.time_zone) });
}

function lastText({ last, weekly }: ScheduledMission): string {
  const time = zonedTime(last?.begin ?? 0, weekly.time_zone);
  return last?.outcome === "missed" ? t("schedules.missed", { time, reason: said(last.code, last.reason) }) : t("schedules.given", { time });
}

/** The other floor of a stop, whose places are not this one's. */
const elsewhere = ({ site }: Live, { floor }: StopBody): string => (floor && floor !== site ? `${floor}: ` : "");

/** What the form's list of places has for a stop: for a place of another floor something that is no place's id here. */
const choiceOf = (live: Live, stop: StopBody): string => (stop.place ? elsewhere(live, stop) + stop.place : "");

function stopText(live: Live, stop: StopBody): string {
  const away = elsewhere(live, stop);
  const { place, pose } = stop;
  if (place) return away + ((away === "" && live.of.place.get(place)?.label) || place);
  return away + (pose ? t("goal.position", { x: decimal(pose.x, 1), y: decimal(pose.y, 1) }) : "–");
}

interface Props {
  /** null: a new one. */
  readonly base: ScheduledMission | null;
  readonly onDone: () => void;
}

function ScheduleForm({ base: known, onDone }: Props): preact.JSX.Element {
  const { robot, robots, say } = useConsole();
  const live = useLive(["place"]);
  // As it was opened: what somebody else changes meanwhile is refused when it is saved, and not overwritten.
  const [base] = useState(known);
  const [id, setId] = useState(base?.id ?? "");
  const [body, setBody] = useState<ScheduleBody>(() => base ? bodyOf(base) : {
    robot: robot ?? "", mission: { stops: [{ place: [...live.of.place.keys()][0] ?? "" }] }, weekly: newSchedule("09:00"), enabled: true,
  });
  const [timed, setTimed] = useState(true);
  const [saving, setSaving] = useState(false);
  const [problem, setProblem] = useState("");
  const { stops, when_cut, deadline_s, priority } = body.mission;
  const set = (change: Partial<ScheduleBody>): void => setBody((before) => ({ ...before, ...change }));
  const setMission = (change: Partial<ScheduleBody["mission"]>): void => set({ mission: { ...body.mission, ...change } });
  const places = [...live.of.place].map(([name, { label }]) => [name, label || name] as const).sort(([, a], [, b]) => a.localeCompare(b));

  const save = async (event: Event): Promise<void> => {
    event.preventDefault();
    setSaving(true);
    setProblem("");
    try {
      await request("PUT", pathOf(id), { body, headers: base ? tagOf(base) : { "If-None-Match": "*" } });
      say(t("schedules.saved", { id }));
      onDone();
    } catch (error) {
      const exists = base === null && error instanceof Problem && error.status === 412;
      setProblem(exists ? t("schedules.exists", { id }) : refusal(error));
      setSaving(false);
    }
  };
  return (
    <form ref={useShown()} class="zone-form" aria-label={t("schedules.form")} onSubmit={(event) => void save(event)}>
      <h2>{base ? t("schedules.editOf", { id }) : t("schedules.new")}</h2>
      <p class="muted">{t("schedules.help")}</p>
      {!base && (
        <label class="field">{t("edit.id")}
          <input value={id} required pattern="[a-z0-9][a-z0-9\-]*" maxLength={32} spellcheck={false} autocapitalize="none" title={t("edit.idHelp")}
            onInput={(event) => setId(event.currentTarget.value)} />
        </label>
      )}
      <label class="field">{t("schedules.robot")}
        <select value={body.robot} required onChange={(event) => set({ robot: event.currentTarget.value })}>
          {[...new Set([...robots, body.robot])].map((each) => <option key={each} value={each}>{each}</option>)}
        </select>
      </label>
      <fieldset>
        <legend>{t("schedules.places")}</legend>
        {stops.map((stop, index) => (
          <div key={index} class="fields beside">
            <label>{t("schedules.place", { number: index + 1 })}
              <select value={choiceOf(live, stop)} required={!stop.pose} onChange={(event) => {
                const place = event.currentTarget.value;
                setMission({ stops: stops.map((other, i) => (i === index ? { place } : other)) });
              }}>
                {!live.of.place.has(choiceOf(live, stop)) && <option value={choiceOf(live, stop)}>{stopText(live, stop)}</option>}
                {places.map(([name, label]) => <option key={name} value={name}>{label}</option>)}
              </select>
            </label>
            <button type="button" class="low" disabled={stops.length === 1} aria-label={t("schedules.removePlace", { number: index + 1 })}
              onClick={() => setMission({ stops: stops.filter((_, i) => i !== index) })}>✕</button>
          </div>
        ))}
        <div class="choices">
          <button type="button" disabled={stops.length >= 20} onClick={() => setMission({ stops: [...stops, { place: places[0]?.[0] ?? "" }] })}>{t("schedules.another")}</button>
          <label><input type="checkbox" checked={body.mission.order === "best"} onChange={(event) =>
            setMission({ order: event.currentTarget.checked ? "best" : "given" })} /> {t("schedules.best")}</label>
        </div>
        <div class="fields">
          <label>{t("schedules.whenCut")}
            <select value={when_cut?.do ?? "wait"} onChange={({ currentTarget }) => setMission({ when_cut: { limit_s: null, ...when_cut, do: CUTS[currentTarget.selectedIndex] ?? "wait" } })}>
              {CUTS.map((each) => <option key={each} value={each}>{t(`schedules.cut.${each}`)}</option>)}
            </select>
          </label>
          <label>{t("schedules.deadline")}
            <Typed value={deadline_s == null ? "" : String(deadline_s / 60)} onTyped={({ value, valueAsNumber }) => {
              if (value === "" || valueAsNumber > 0) setMission({ deadline_s: value === "" ? null : 60 * valueAsNumber });
            }}>
              {(typed) => <input type="number" inputMode="decimal" min="0" step="any" {...typed} />}
            </Typed>
          </label>
          <label>{t("schedules.priority")}
            <select value={priority ?? 0} onChange={({ currentTarget }) => setMission({ priority: currentTarget.selectedIndex })}>
              {Array.from({ length: 10 }, (_, each) => <option key={each} value={each}>{each}</option>)}
            </select>
          </label>
        </div>
      </fieldset>
      <h3>{t("field.schedule")}</h3>
      <ScheduleFields schedule={timed ? body.weekly : null} onChange={(weekly) => {
        setTimed(weekly !== null);
        if (weekly) set({ weekly });
      }} />
      <label class="check"><input type="checkbox" checked={body.enabled ?? true} onChange={(event) => set({ enabled: event.currentTarget.checked })} /> {t("schedules.enabled")}</label>
      <div class="sticky">
        {problem !== "" && <p class="problem" role="alert">{problem}</p>}
        <div class="actions">
          <button class="primary" disabled={saving || !timed}>{saving ? t("edit.saving") : t("edit.save")}</button>
          <button type="button" onClick={() => go("schedules")}>{t("cancel")}</button>
        </div>
      </div>
    </form>
  );
}
