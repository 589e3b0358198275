// Sets of zones that are switched together.
import { useState } from "preact/hooks";
import { request } from "../api/client";
import type { SetView, ZoneSourceView } from "../api/types";
import { mayOperate, useConsole, useRead } from "../context";
import { t } from "../i18n/i18n";
import { sentence } from "../stop";
import type { Schedule } from "./draft";
import { ScheduleFields, scheduleText } from "./schedule";

const path = (id: string): string => `zone-sets/${encodeURIComponent(id)}`;

const TOPICS = ["zone", "record", "ready"] as const;
export const useSets = (): readonly SetView[] | null => useRead<SetView[]>("zone-sets", TOPICS).value;

/** The sets with their switches, and a new one. */
export function SetList(): preact.JSX.Element | null {
  const { session, say } = useConsole();
  const sets = useSets();
  const [id, setId] = useState("");
  const operates = mayOperate(session);
  if (sets === null || (sets.length === 0 && !operates)) return null;
  const send = (set: string, what: Promise<unknown>, done: string): void => void what.then(() => say(done), (error: unknown) =>
    say(t("sets.failed", { set, reason: sentence(error) }), "failed"));
  const change = (set: SetView, to: Partial<SetView>, done: string): void => {
    const body = { name: set.name, enabled: set.enabled, schedule: set.schedule, ...to };
    send(set.id, request("PUT", path(set.id), { body, headers: { "If-Match": `"${set.version}"` } }), done);
  };
  const toggle = (set: SetView): void =>
    change(set, { enabled: !set.enabled }, t(set.enabled ? "sets.nowOff" : "sets.nowOn", { set: set.id }));
  const add = (): void => {
    send(id, request("PUT", path(id), { body: {}, headers: { "If-None-Match": "*" } }), t("sets.added", { set: id }));
    setId("");
  };
  return (
    <section aria-label={t("sets.title")}>
      <h2>{t("sets.title")}</h2>
      <ul class="rows">
        {sets.map((set) => (
          <li key={set.id} class="row">
            <b><bdi>{set.name || set.id}</bdi></b>
            <span class="muted">{set.zones.length === 0 ? t("sets.empty") : set.zones.join(", ")}</span>
            <span class="value">{t(set.on ? "state.on" : set.enabled ? "state.resting" : "state.off")}</span>
            {operates && (
              <button aria-label={t(set.enabled ? "sets.offOf" : "sets.onOf", { set: set.id })} onClick={() => toggle(set)}>{t(set.enabled ? "zones.switchOff" : "zones.switchOn")}</button>
            )}
            {set.schedule && <span class="why">{scheduleText(set.schedule)}</span>}
            {operates && <SetTimes key={set.version} set={set} onSave={(schedule) => change(set, { schedule }, t("sets.timesSaved", { set: set.id }))} />}
          </li>
        ))}
      </ul>
      {operates && (
        <details>
          <summary>{t("sets.new")}</summary>
          <label class="field">{t("edit.id")}
            <input value={id} maxLength={32} spellcheck={false} autocapitalize="none" title={t("edit.idHelp")} onInput={(event) => setId(event.currentTarget.value)} />
          </label>
          <button disabled={id === ""} onClick={add}>{t("sets.add")}</button>
        </details>
      )}
    </section>
  );
}

interface TimesProps {
  readonly set: SetView;
  readonly onSave: (schedule: Schedule | null) => void;
}

/** The times of the week in which a set is on. */
function SetTimes({ set, onSave }: TimesProps): preact.JSX.Element {
  const [schedule, setSchedule] = useState(set.schedule);
  return (
    <details class="times-of">
      <summary aria-label={t("sets.timesOf", { set: set.id })}>{t("sets.times")}</summary>
      <ScheduleFields schedule={schedule} onChange={setSchedule} />
      <button disabled={schedule === set.schedule} onClick={() => onSave(schedule)}>{t("edit.save")}</button>
    </details>
  );
}

/** The sources that put zones over MQTT, which an operator can mute. */
export function SourceList(): preact.JSX.Element | null {
  const { session, say } = useConsole();
  const sources = useRead<ZoneSourceView[]>("zone-sources", TOPICS).value ?? [];
  if (sources.length === 0) return null;
  const mute = (source: ZoneSourceView): void => void request("PUT", `zone-sources/${encodeURIComponent(source.id)}`, {
    body: { muted: !source.muted }, headers: { "If-Match": `"${source.version}"` },
  }).then(
    () => say(t(source.muted ? "sources.nowHeard" : "sources.nowMuted", { source: source.id })),
    (error: unknown) => say(t("sources.failed", { source: source.id, reason: sentence(error) }), "failed"),
  );
  return (
    <section aria-label={t("sources.title")}>
      <h2>{t("sources.title")}</h2>
      <ul class="rows">
        {sources.map((source) => (
          <li key={source.id} class="row">
            <b><bdi>{source.label || source.id}</bdi></b>
            <span class="muted">{source.zones.join(", ") || t("sources.none")}</span>
            <span class="value">{t(source.muted ? "sources.muted" : "sources.heard")}</span>
            {mayOperate(session) && (
              <button aria-label={t(source.muted ? "sources.hearOf" : "sources.muteOf", { source: source.id })} onClick={() => mute(source)}>{t(source.muted ? "sources.hear" : "sources.mute")}</button>
            )}
            {source.problem !== "" && <span class="why"><bdi>{source.problem}</bdi></span>}
          </li>
        ))}
      </ul>
    </section>
  );
}

interface ChoiceProps {
  readonly chosen: readonly string[];
  readonly onChange: (sets: readonly string[]) => void;
}

/** Which sets a zone is switched with. */
export function SetChoice({ chosen, onChange }: ChoiceProps): preact.JSX.Element | null {
  const sets = useSets() ?? [];
  if (sets.length === 0) return null;
  return (
    <fieldset>
      <legend>{t("field.sets")}</legend>
      {sets.map(({ id, name }) => (
        <label key={id} class="check">
          <input type="checkbox" checked={chosen.includes(id)} onChange={(event) =>
            onChange(event.currentTarget.checked ? [...chosen, id] : chosen.filter((other) => other !== id))} />
          <bdi>{name || id}</bdi>
        </label>
      ))}
    </fieldset>
  );
}
