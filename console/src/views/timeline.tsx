// What happened, newest first, by whom; and the last hour on a map.
import { useState } from "preact/hooks";
import type { TimelineEntry } from "../api/types";
import { mayOperate, useConsole, useRead } from "../context";
import { t } from "../i18n/i18n";
import { detailText, entryText, KINDS, undoable } from "../past/entries";
import { Replay } from "../past/replay";
import { sentence } from "../stop";
import { clockTime } from "../text";
import { undoEntry } from "../zones/requests";
import "../zones/zones.css";

const PAGE = 50;
const MOST = 500;
const AGAIN_MS = 10_000;

export function TimelineView(): preact.JSX.Element {
  const { session, say } = useConsole();
  const [kind, setKind] = useState("");
  const [limit, setLimit] = useState(PAGE);
  const [replays, setReplays] = useState(false);
  const query = `limit=${limit}${kind === "" ? "" : `&kind=${kind}`}`;
  const { value: entries, problem } = useRead<TimelineEntry[]>(`timeline?${query}`, ["record"], AGAIN_MS);
  const undone = undoable(entries ?? []);
  const undo = (entry: TimelineEntry): void => {
    const service = undone.get(entry.entry);
    if (!service) return;
    void undoEntry(service, entry.id, entry.entry).then(
      () => say(t("timeline.undone", { what: entryText(entry) })),
      (error: unknown) => say(t("timeline.notUndone", { reason: sentence(error) }), "failed"),
    );
  };
  return (
    <>
      <h2>{t("view.timeline")}</h2>
      <div class="choices"><button aria-pressed={replays} onClick={() => setReplays(!replays)}>{t("replay.title")}</button></div>
      {replays && <Replay />}
      <label class="field">{t("timeline.filter")}
        <select value={kind} onChange={(event) => setKind(event.currentTarget.value)}>
          <option value="">{t("timeline.all")}</option>
          {KINDS.map((each) => <option key={each} value={each}>{t(`filter.${each}`)}</option>)}
        </select>
      </label>
      {problem !== "" && <p class="problem" role="alert">{problem}</p>}
      {entries === null && problem === "" && <p class="muted">{t("connection.loading")}</p>}
      {entries?.length === 0 && <p class="muted">{t("timeline.none")}</p>}
      <ol class="rows timeline">
        {(entries ?? []).map((entry, index) => (
          <li key={entry.entry || `${entry.kind} ${entry.id} ${entry.at} ${index}`} class="row">
            <time dateTime={new Date(entry.at * 1000).toISOString()} class="muted">{clockTime(entry.at)}</time>
            <span class="happened"><bdi>{entryText(entry)}</bdi></span>
            {entry.who !== "" && <span class="muted"><bdi>{entry.who}</bdi></span>}
            {undone.has(entry.entry) && mayOperate(session) && (
              <button aria-label={t("timeline.undoOf", { what: entryText(entry) })} onClick={() => undo(entry)}>{t("undo")}</button>
            )}
            {detailText(entry) !== "" && <span class="why clipped"><bdi>{detailText(entry)}</bdi></span>}
          </li>
        ))}
      </ol>
      {entries && entries.length >= limit && limit < MOST && <button onClick={() => setLimit(limit + PAGE)}>{t("timeline.more")}</button>}
    </>
  );
}
