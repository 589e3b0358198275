// Sets of zones that are switched together.
import { useEffect, useState } from "preact/hooks";
import { request } from "../api/client";
import type { SetView } from "../api/types";
import { mayOperate, useConsole } from "../context";
import { t } from "../i18n/i18n";
import { sentence } from "../stop";
import { scheduleText } from "./schedule";

const SOON_MS = 500;
const path = (id: string): string => `zone-sets/${encodeURIComponent(id)}`;

/** Return the sets as they are, read again whenever a zone or a record changes; null before they are known. */
export function useSets(): readonly SetView[] | null {
  const { live } = useConsole();
  const [sets, setSets] = useState<readonly SetView[] | null>(null);
  useEffect(() => {
    let wanted = true;
    let soon: ReturnType<typeof setTimeout> | undefined;
    const read = (): void => {
      soon = undefined;
      void request<SetView[]>("GET", "zone-sets").then(({ value }) => wanted && setSets(value), () => undefined);
    };
    read();
    const off = live.on(["zone", "record", "ready"], () => void (soon ??= setTimeout(read, SOON_MS)));
    return () => {
      wanted = false;
      off();
      clearTimeout(soon);
    };
  }, [live]);
  return sets;
}

/** The sets with their switches, and a new one. */
export function SetList(): preact.JSX.Element | null {
  const { session, say } = useConsole();
  const sets = useSets();
  const [id, setId] = useState("");
  const operates = mayOperate(session);
  if (sets === null || (sets.length === 0 && !operates)) return null;
  const send = (set: string, what: Promise<unknown>, done: string): void => void what.then(() => say(done), (error: unknown) =>
    say(t("sets.failed", { set, reason: sentence(error) }), "failed"));
  const toggle = (set: SetView): void => {
    const body = { name: set.name, enabled: !set.enabled, schedule: set.schedule };
    send(set.id, request("PUT", path(set.id), { body, headers: { "If-Match": `"${set.version}"` } }), t(set.enabled ? "sets.nowOff" : "sets.nowOn", { set: set.id }));
  };
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
