// The last hour once more: a map of its own that shows what the events said then.
import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import { request } from "../api/client";
import { t } from "../i18n/i18n";
import { Live } from "../live/live";
import { Floor } from "../map/floor";
import { sentence } from "../stop";
import { clockTime } from "../text";

interface Frame {
  readonly stamp: number;
  readonly events: readonly { readonly event: string; readonly data: unknown }[];
}

interface Recording {
  readonly begin: number | null;
  readonly end: number | null;
  readonly step_s: number;
  readonly frames: readonly Frame[];
}

/** So much (s) is fetched at a time. */
const AHEAD_S = 60;
/** A frame is shown for so long while it plays. */
const FRAME_MS = 500;

/** Show frames on a state of everything; the first one replaces what it knows. */
function show(live: Live, frame: Frame, fresh: boolean): void {
  const take = (event: string, data: unknown): void => live.take({ event, data: JSON.stringify(data), id: null });
  if (fresh) take("hello", { run: "past", fresh: true, site: "" });
  if (fresh) take("ready", {}); // what follows is of that time
  for (const { event, data } of frame.events) take(event, data);
  take("time", { stamp: frame.stamp });
}

export function Replay(): preact.JSX.Element {
  const element = useRef<HTMLDivElement>(null);
  // Nothing in it grows old: time stands still between two frames.
  const live = useMemo(() => new Live("", () => 0), []);
  const [span, setSpan] = useState<Recording | null>(null);
  const [at, setAt] = useState<number | null>(null);
  const [plays, setPlays] = useState(false);
  const [problem, setProblem] = useState("");
  const queue = useRef<Frame[]>([]);

  useEffect(() => {
    if (!element.current) return;
    const floor = new Floor(element.current, live, { onRobot: () => undefined, onZone: () => undefined });
    void request<Recording>("GET", "recording").then(({ value }) => setSpan(value), (error: unknown) => setProblem(sentence(error)));
    return () => floor.remove();
  }, [live]);

  const seek = async (to: number): Promise<void> => {
    setAt(to);
    setPlays(false);
    try {
      const { value } = await request<Recording>("GET", `recording?from=${to}&to=${to + AHEAD_S}`);
      const [first, ...rest] = value.frames;
      if (!first) return;
      show(live, first, true);
      queue.current = rest;
      setProblem("");
    } catch (error) {
      setProblem(sentence(error));
    }
  };
  const step = async (now: number): Promise<void> => {
    if (queue.current.length === 0) {
      const { value } = await request<Recording>("GET", `recording?from=${now}&to=${now + AHEAD_S}`);
      setSpan((before) => (before ? { ...before, begin: value.begin, end: value.end } : value));
      // The first frame is the state of its time, which is shown already.
      queue.current = value.frames.slice(1);
    }
    const next = queue.current.shift();
    if (!next) {
      setPlays(false);
      return;
    }
    show(live, next, false);
    setAt(next.stamp);
  };
  useEffect(() => {
    if (!plays || at === null) return;
    const timer = setTimeout(() => void step(at).catch((error: unknown) => {
      setPlays(false);
      setProblem(sentence(error));
    }), FRAME_MS);
    return () => clearTimeout(timer);
  }, [plays, at]);

  const [begin, end] = [span?.begin ?? null, span?.end ?? null];
  return (
    <section class="replay" aria-label={t("replay.title")}>
      <div ref={element} class="floor past" role="img" aria-label={t("replay.map", { time: at === null ? "–" : clockTime(at) })} />
      {begin !== null && end !== null ? (
        <div class="scrubber">
          <input
            type="range" min={begin} max={end} step={span?.step_s ?? 5} value={at ?? end} aria-label={t("replay.time")}
            aria-valuetext={clockTime(at ?? end)} onChange={(event) => void seek(event.currentTarget.valueAsNumber)}
          />
          <div class="choices">
            <button onClick={() => void seek(Math.max(begin, (at ?? end) - AHEAD_S))}>{t("replay.back")}</button>
            <button aria-pressed={plays} onClick={() => {
              if (at === null) void seek(begin).then(() => setPlays(true));
              else setPlays(!plays);
            }}>{t(plays ? "replay.pause" : "replay.play")}</button>
            <button onClick={() => void seek(Math.min(end, (at ?? begin) + AHEAD_S))}>{t("replay.on")}</button>
            <b class="value">{at === null ? t("replay.choose") : clockTime(at)}</b>
          </div>
        </div>
      ) : <p class="muted">{problem === "" ? t("replay.none") : ""}</p>}
      <p class="problem" role="alert">{problem}</p>
    </section>
  );
}
