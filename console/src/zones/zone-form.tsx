// The form of a zone: where, what it does, why, until when; and what it would do to the robots.
import { useEffect, useState } from "preact/hooks";
import { Problem } from "../api/client";
import type { DryRunBody, Zone } from "../api/types";
import { useConsole, useLive } from "../context";
import { t } from "../i18n/i18n";
import { sentence } from "../stop";
import { Typed } from "../typed";
import { Conflict } from "./conflict";
import { bodyOf, type Draft, type End, type Fields, nextHour } from "./draft";
import type { Editor } from "./editor";
import { Effects, useTrial } from "./effects";
import { type Change, read, save } from "./requests";
import { ScheduleFields } from "./schedule";
import { SetChoice } from "./sets";
import { DrawingFields, Metres, PointFields } from "./shape-fields";
import { endText } from "./words";

const KINDS: readonly Zone["kind"][] = ["BLOCKED", "PENALTY", "SPEED_LIMIT", "RELEASE"];
const EVENING = 18;

interface Props {
  readonly editor: Editor;
  readonly onSaved: (change: Change) => void;
  readonly onCancel: () => void;
}

/** Return what a draft would change; null while it has no shape. */
function trialOf(draft: Draft | null): DryRunBody | null {
  const shape = draft?.fields.shape;
  if (!draft || !shape) return null;
  const body = bodyOf(draft, shape, 0);
  // An end in the past or a wrong schedule is told when it is saved; here only the place counts.
  const zone = { ...body, starts_at: null, expires_at: null, ttl_s: null, schedule: null, sets: [], reason: "" };
  return { zones: [zone] };
}

export function ZoneForm({ editor, onSaved, onCancel }: Props): preact.JSX.Element | null {
  const { say } = useConsole();
  const live = useLive(["zone"]);
  const { draft } = editor;
  const trial = useTrial(trialOf(draft));
  const [saving, setSaving] = useState(false);
  const [problem, setProblem] = useState("");
  // What was refused may be mended by any change.
  useEffect(() => setProblem(""), [draft]);
  if (!draft) return null;
  const { fields, base } = draft;
  const set = (change: Partial<Fields>): void => editor.set(change);

  const submit = async (): Promise<void> => {
    const now = editor.draft;
    if (!now?.fields.shape || saving) return;
    setSaving(true);
    setProblem("");
    try {
      const saved = await save(now, live.serverTime || Date.now() / 1000);
      if ("zone" in saved) {
        onSaved({ id: saved.zone.id, before: now.base, after: saved.zone });
        return;
      }
      editor.compare(saved.theirs);
    } catch (error) {
      const reason = refusal(error);
      setProblem(reason);
      say(t("zones.saveFailed", { reason }), "failed");
    }
    setSaving(false);
  };

  const known = base ? live.of.zone.get(base.id) : undefined;
  const overtaken = base !== null && editor.theirs === undefined && live.ready && (known === undefined || known.version > base.version);
  const compare = (): void => void (base && read(base.id).then((zone) => editor.compare(zone), (error: unknown) => say(sentence(error), "failed")));
  return (
    <form class="zone-form" noValidate aria-label={t("edit.title")} onSubmit={(event) => {
      event.preventDefault();
      void submit();
    }}>
      <h2>{base ? t("edit.titleOf", { zone: base.id }) : t("edit.titleNew")}</h2>
      {overtaken && (
        <p class="notice" role="alert">{known ? t("conflict.changed", { who: known.author }) : t("conflict.removed")}{" "}
          <button type="button" onClick={compare}>{t("conflict.compare")}</button>
        </p>
      )}
      <Conflict editor={editor} onSave={() => void submit()} onDrop={onCancel} />
      <DrawingFields editor={editor} />
      <fieldset>
        <legend>{t("field.kind")}</legend>
        <div class="choices" role="group" aria-label={t("field.kind")}>
          {KINDS.map((kind) => (
            <button type="button" key={kind} aria-pressed={fields.kind === kind} onClick={() => set({ kind })}>
              <span class={`swatch zone ${kind.toLowerCase()}`} aria-hidden="true" /> {t(`zone.${kind}`)}
            </button>
          ))}
        </div>
        {fields.kind === "PENALTY" && (
          <label class="field">{t("edit.factor")}
            <Metres value={fields.factor} min={1} max={5} label={t("edit.factor")} onValue={(factor) => set({ factor })} />
          </label>
        )}
        {fields.kind === "SPEED_LIMIT" && (
          <label class="field">{t("edit.speed")}
            <Metres value={fields.speed} min={0.01} max={2.54} label={t("edit.speed")} onValue={(speed) => set({ speed })} />
          </label>
        )}
      </fieldset>
      <label class="field">{t("field.reason")}
        <Typed value={fields.reason} onTyped={({ value: reason }) => set({ reason })}>
          {(typed) => <input dir="auto" maxLength={500} {...typed} />}
        </Typed>
      </label>
      <EndFields end={fields.end} now={live.serverTime || Date.now() / 1000} onChange={(end) => set({ end })} />
      <PointFields editor={editor} />
      <details>
        <summary>{t("edit.more")}</summary>
        {!base && (
          <label class="field">{t("edit.id")}
            <input value={draft.id} pattern="[a-z0-9][a-z0-9\-]*" maxLength={32} spellcheck={false} autocapitalize="none" title={t("edit.idHelp")}
              placeholder={t("edit.idMade")} onInput={(event) => editor.rename(event.currentTarget.value)} />
          </label>
        )}
        <label class="check"><input type="checkbox" checked={fields.enabled} onChange={(event) => set({ enabled: event.currentTarget.checked })} /> {t("edit.enabled")}</label>
        <SetChoice chosen={fields.sets} onChange={(sets) => set({ sets })} />
        <h3>{t("field.schedule")}</h3>
        <ScheduleFields schedule={fields.schedule} onChange={(schedule) => set({ schedule })} />
      </details>
      <div class="sticky">
        {problem === "" ? <Effects trial={trial} /> : <p class="problem" role="alert">{problem}</p>}
        <div class="actions">
          <button class="primary" disabled={!fields.shape || saving}>{saving ? t("edit.saving") : t("edit.save")}</button>
          <button type="button" onClick={onCancel}>{t("cancel")}</button>
        </div>
      </div>
    </form>
  );
}

/** Return a refusal with the fields that it names. */
export function refusal(error: unknown): string {
  if (!(error instanceof Problem) || !Array.isArray(error.extra.errors)) return sentence(error);
  const named = (error.extra.errors as { field?: string; problem?: string }[])
    .map(({ field = "", problem = "" }) => `${field.replace(/^body\.?/, "")}: ${problem}`.replace(/^: /, ""));
  return named.length > 0 ? named.join("; ") : sentence(error);
}

interface EndProps {
  readonly end: End;
  /** The server's time (s since the epoch). */
  readonly now: number;
  readonly onChange: (end: End) => void;
}

function EndFields({ end, now, onChange }: EndProps): preact.JSX.Element {
  const evening = nextHour(EVENING, now);
  const presets: readonly (readonly [string, End])[] = [
    [t("end.never"), { type: "never" }],
    [t("end.quarter"), { type: "after", seconds: 15 * 60 }],
    [t("end.hour"), { type: "after", seconds: 3600 }],
    [t("end.evening"), { type: "at", stamp: evening }],
  ];
  const chosen = JSON.stringify(end);
  return (
    <fieldset>
      <legend>{t("field.end")}</legend>
      <div class="choices" role="group" aria-label={t("field.end")}>
        {presets.map(([text, preset]) => (
          <button type="button" key={text} aria-pressed={JSON.stringify(preset) === chosen} onClick={() => onChange(preset)}>{text}</button>
        ))}
      </div>
      <label class="field">{t("end.own")}
        <Typed value={end.type === "at" ? localTime(end.stamp) : ""} onTyped={({ value }) => {
          const stamp = new Date(value).getTime() / 1000;
          onChange(Number.isFinite(stamp) ? { type: "at", stamp } : { type: "never" });
        }}>
          {(typed) => <input type="datetime-local" step="1" {...typed} />}
        </Typed>
      </label>
      <p class="muted">{endText(end)}</p>
    </fieldset>
  );
}

/** Return a time as a field of date and time has it. */
function localTime(stamp: number): string {
  const date = new Date(stamp * 1000);
  const two = (value: number): string => String(value).padStart(2, "0");
  return `${date.getFullYear()}-${two(date.getMonth() + 1)}-${two(date.getDate())}T${two(date.getHours())}:${two(date.getMinutes())}:${two(date.getSeconds())}`;
}
