// Zones: the list is what everybody can use, the map beside it shows the same. One zone is looked at or edited at a time.
import { useEffect, useReducer, useRef, useState } from "preact/hooks";
import type { AppliedChange, Values, Zone } from "../api/types";
import { mayOperate, useConsole, useLive, useSeconds } from "../context";
import { t } from "../i18n/i18n";
import { outline } from "../map/geometry";
import { go, routeHash, useRoute } from "../router";
import { sentence } from "../stop";
import { shapeText } from "../zones/conflict";
import { copyOf, draftOf, newDraft, stateOf } from "../zones/draft";
import { EditLayer } from "../zones/edit-layer";
import { editor } from "../zones/editor";
import { applied, type Change, remove, save, undo } from "../zones/requests";
import { scheduleText } from "../zones/schedule";
import { SetList, SourceList } from "../zones/sets";
import { nudged, SHAPE_TYPES, WHOLE } from "../zones/shapes";
import { appliedText, endText, stateText } from "../zones/words";
import { ZoneForm } from "../zones/zone-form";
import "../zones/zones.css";

/** Stands in the address where a zone's id would: ids have no plus. */
const DRAFT = "+draft";
const SHOWN_MAX = 200;
const COPY_M = 0.5;
/** Within how many milliseconds the stream tells of a change that was made here. */
const TOLD_WITHIN_MS = 3_000;

/** The last change of this page, kept while the user looks at other views. */
let last: Change | null = null;
/** The zone that was saved just now: the map stays where the person looked while drawing it. */
let saved = "";

/** Forget what was changed here: who logs in next has not done it. */
export function forgetChanges(): void {
  last = null;
  saved = "";
}

export function ZonesView(): preact.JSX.Element {
  const { floor, live, session, say } = useConsole();
  const { chosen } = useRoute();
  const operates = mayOperate(session);
  const [, redraw] = useReducer((count: number) => count + 1, 0);
  useEffect(() => editor.on(() => redraw(0)), []);
  useEffect(() => {
    if (!floor || !operates) return;
    const layer = new EditLayer(floor, editor);
    return () => layer.remove();
  }, [floor, operates]);
  const edits = operates && chosen === DRAFT && editor.draft !== null;

  const show = (zone: Zone): void => floor?.show(outline(zone.shape));
  const made = (change: Change, text: string): void => {
    last = change;
    say(text);
    redraw(0);
  };
  const failed = (error: unknown, zone: string): void => say(t("zones.failed", { zone, reason: sentence(error) }), "failed");
  const actions: Actions = {
    show,
    edit: (zone) => {
      editor.start(draftOf(zone));
      floor?.reveal(outline(zone.shape));
      go("zones", DRAFT);
    },
    copy: (zone) => {
      editor.start(copyOf(zone, (shape) => nudged(shape, WHOLE, COPY_M, -COPY_M)));
      go("zones", DRAFT);
    },
    remove: (zone) => void remove(zone).then(() => {
      made({ id: zone.id, before: zone, after: null }, t("zones.removed", { zone: zone.id }));
      go("zones");
    }, (error: unknown) => failed(error, zone.id)),
    toggle: (zone) => {
      const draft = draftOf(zone);
      void save({ ...draft, fields: { ...draft.fields, enabled: !zone.enabled } }, live.serverTime || Date.now() / 1000).then((saved) => {
        if ("zone" in saved) made({ id: zone.id, before: zone, after: saved.zone }, t(saved.zone.enabled ? "zones.on" : "zones.off", { zone: zone.id }));
        else say(t("zones.overtaken", { zone: zone.id }), "failed");
      }, (error: unknown) => failed(error, zone.id));
    },
  };
  const takeBack = (change: Change): void => void undo(change).then(() => {
    last = null;
    say(t("zones.undone", { zone: change.id }));
    redraw(0);
  }, (error: unknown) => failed(error, change.id));

  if (edits) {
    return (
      <ZoneForm
        editor={editor}
        onSaved={(change) => {
          editor.end();
          saved = change.id;
          made(change, t("zones.saved", { zone: change.id }));
          go("zones", change.id);
        }}
        onCancel={() => {
          const base = editor.draft?.base?.id ?? "";
          editor.end();
          go("zones", base);
        }}
      />
    );
  }
  return (
    <>
      {last && operates && <UndoBar change={last} onUndo={takeBack} />}
      {chosen === "" || chosen === DRAFT ? <ZoneList actions={actions} /> : <ZoneCard id={chosen} actions={actions} />}
    </>
  );
}

interface Actions {
  readonly show: (zone: Zone) => void;
  readonly edit: (zone: Zone) => void;
  readonly copy: (zone: Zone) => void;
  readonly remove: (zone: Zone) => void;
  readonly toggle: (zone: Zone) => void;
}

function UndoBar({ change, onUndo }: { readonly change: Change; readonly onUndo: (change: Change) => void }): preact.JSX.Element {
  const what = change.after === null ? "removed" : change.before === null ? "added" : "changed";
  return (
    <p class="undo card"><span>{t(`undo.${what}`, { zone: change.id })}</span> <button onClick={() => onUndo(change)}>{t("undo")}</button></p>
  );
}

function ZoneList({ actions }: { readonly actions: Actions }): preact.JSX.Element {
  const { session } = useConsole();
  const live = useLive(["zone", "ready"]);
  useSeconds();
  const [filter, setFilter] = useState("");
  useEffect(() => void (saved = ""), []);
  const now = live.serverTime || Date.now() / 1000;
  const wanted = filter.trim().toLowerCase();
  const zones = [...live.of.zone.values()]
    .filter((zone) => wanted === "" || `${zone.id} ${zone.reason} ${zone.author}`.toLowerCase().includes(wanted))
    .sort((a, b) => Number(b.active) - Number(a.active) || a.id.localeCompare(b.id));
  const operates = mayOperate(session);
  return (
    <>
      <h2>{t("view.zones")}</h2>
      {operates && (
        <div class="choices" role="group" aria-label={t("zones.new")}>
          <span class="muted">{t("zones.new")}</span>
          {SHAPE_TYPES.map((type) => (
            <button key={type} class="primary" onClick={() => {
              editor.start(newDraft(type));
              go("zones", DRAFT);
            }}>{t(`shape.${type}`)}</button>
          ))}
        </div>
      )}
      {operates && editor.draft && <p class="notice">{t("zones.unsaved")} <button onClick={() => go("zones", DRAFT)}>{t("zones.goOn")}</button></p>}
      {live.of.zone.size > 10 && (
        <label class="field">{t("zones.filter")}
          <input type="search" value={filter} onInput={(event) => setFilter(event.currentTarget.value)} />
        </label>
      )}
      {live.ready && live.of.zone.size === 0 && <p class="muted">{t("zones.none")}</p>}
      <ul class="rows zones">
        {zones.slice(0, SHOWN_MAX).map((zone) => (
          <li key={zone.id} class="zone-row">
            <div class="row">
              <span class={`swatch zone ${zone.kind.toLowerCase()}`} aria-hidden="true" />
              <a href={routeHash("zones", zone.id)}><bdi>{zone.id}</bdi></a>
              <span>{t(`zone.${zone.kind}`)}</span>
              <span class={`value state ${stateOf(zone, now)}`}>{stateText(zone, now)}</span>
            </div>
            {zone.reason !== "" && <p class="why clipped"><bdi>{zone.reason}</bdi></p>}
            <div class="row-actions">
              <button aria-label={t("zones.showOf", { zone: zone.id })} onClick={() => actions.show(zone)}>{t("zones.show")}</button>
              {operates && <button aria-label={t("zones.editOf", { zone: zone.id })} onClick={() => actions.edit(zone)}>{t("zones.edit")}</button>}
              {operates && <button aria-label={t("zones.removeOf", { zone: zone.id })} onClick={() => actions.remove(zone)}>{t("zones.remove")}</button>}
            </div>
          </li>
        ))}
      </ul>
      {zones.length > SHOWN_MAX && <p class="muted">{t("zones.others", { number: zones.length - SHOWN_MAX })}</p>}
      <SetList />
      <SourceList />
    </>
  );
}

function ZoneCard({ id, actions }: { readonly id: string; readonly actions: Actions }): preact.JSX.Element {
  const { session, floor } = useConsole();
  const live = useLive(["zone", "ready"]);
  useSeconds();
  const zone = live.of.zone.get(id);
  const now = live.serverTime || Date.now() / 1000;
  const known = zone !== undefined;
  // A zone that was saved just now is told a moment later.
  const opened = useRef(Date.now());
  const wasKnown = useRef(false);
  wasKnown.current ||= known;
  const isGone = live.ready && (wasKnown.current || Date.now() - opened.current > TOLD_WITHIN_MS);
  // Whoever comes by a link sees where it is.
  useEffect(() => {
    if (zone && saved !== id) floor?.reveal(outline(zone.shape));
  }, [id, known, floor]);
  return (
    <>
      <p><a href={routeHash("zones")}>{t("zones.all")}</a></p>
      {zone ? <Facts zone={zone} now={now} /> : <p>{isGone ? t("zones.gone", { zone: id }) : t("connection.loading")}</p>}
      {zone && (
        <div class="actions">
          <button onClick={() => actions.show(zone)}>{t("zones.show")}</button>
          {mayOperate(session) && (
            <>
              <button class="primary" onClick={() => actions.edit(zone)}>{t("zones.edit")}</button>
              <button onClick={() => actions.copy(zone)}>{t("zones.copy")}</button>
              <button aria-pressed={zone.enabled} onClick={() => actions.toggle(zone)}>{t(zone.enabled ? "zones.switchOff" : "zones.switchOn")}</button>
              <button class="danger" onClick={() => actions.remove(zone)}>{t("zones.remove")}</button>
            </>
          )}
        </div>
      )}
    </>
  );
}

function Facts({ zone, now }: { readonly zone: Values["zone"]; readonly now: number }): preact.JSX.Element {
  const { end } = draftOf(zone).fields;
  const { factor, speed } = zone;
  return (
    <>
      <h2 class="named"><bdi>{zone.id}</bdi></h2>
      <dl class="facts">
        <dt>{t("field.kind")}</dt>
        <dd>{t(`zone.${zone.kind}`)}{factor !== null && ` × ${factor}`}{speed !== null && ` ${speed} m/s`}</dd>
        <dt>{t("field.state")}</dt><dd class={`state ${stateOf(zone, now)}`}>{stateText(zone, now)}</dd>
        <dt>{t("field.applied")}</dt><dd><Applied zone={zone} /></dd>
        <dt>{t("field.reason")}</dt><dd><bdi>{zone.reason || "–"}</bdi></dd>
        <dt>{t("field.author")}</dt><dd><bdi>{zone.author || "–"}</bdi></dd>
        <dt>{t("field.end")}</dt><dd>{endText(end)}</dd>
        {zone.schedule && <><dt>{t("field.schedule")}</dt><dd>{scheduleText(zone.schedule)}</dd></>}
        {zone.sets.length > 0 && <><dt>{t("field.sets")}</dt><dd><bdi>{zone.sets.join(", ")}</bdi></dd></>}
        {zone.source !== null && <><dt>{t("field.source")}</dt><dd><bdi>{zone.source}</bdi></dd></>}
        <dt>{t("field.shape")}</dt><dd>{shapeText(zone.shape)}</dd>
      </dl>
    </>
  );
}

const APPLIED_MS = 1_000;

/** Which robots drive by a map with the zone's latest change; asked until all do. */
function Applied({ zone }: { readonly zone: Values["zone"] }): preact.JSX.Element {
  const [change, setChange] = useState<AppliedChange | null>(null);
  useEffect(() => {
    let timer: ReturnType<typeof setTimeout> | undefined;
    let wanted = true;
    const ask = async (): Promise<void> => {
      const found = await applied(zone.id).catch(() => null);
      if (!wanted) return;
      setChange(found);
      if (!found?.robots.every((robot) => robot.applied)) timer = setTimeout(() => void ask(), APPLIED_MS);
    };
    void ask();
    return () => {
      wanted = false;
      clearTimeout(timer);
    };
  }, [zone.id, zone.version, zone.active]);
  return <span role="status">{change ? appliedText(change) : "–"}</span>;
}
