// The stop: at the same place on every view, without a dialog, and by key; it works without a login, too.
import { useEffect, useState } from "preact/hooks";
import { Problem, request, robotPath } from "./api/client";
import type { CommandOutcome } from "./api/types";
import type { Say } from "./context";
import { saidProblem } from "./i18n/codes";
import { t } from "./i18n/i18n";

/** How often (ms) it is looked whether a robot that was not stopped is stopped by now. */
const LOOK_MS = 500;
const STORED = "fognav.robots";

/** Remember the robots' ids, so that they can be stopped before a login. */
export function rememberRobots(ids: readonly string[]): void {
  localStorage.setItem(STORED, JSON.stringify(ids));
}

export function rememberedRobots(): string[] {
  try {
    const found: unknown = JSON.parse(localStorage.getItem(STORED) ?? "[]");
    return Array.isArray(found) ? found.filter((id): id is string => typeof id === "string") : [];
  } catch {
    return [];
  }
}

/** Return a problem's sentence for people. */
export function sentence(error: unknown): string {
  if (!(error instanceof Problem)) return String(error);
  return error.code === "unreachable" ? t("error.unreachable") : saidProblem(error);
}

interface Props {
  readonly robot: string | null;
  readonly robots: readonly string[];
  readonly say: Say;
  /** Whether a robot waits to be enabled; without it nobody knows. */
  readonly isStopped?: (id: string) => boolean;
}

export function StopBar({ robot, robots, say, isStopped }: Props): preact.JSX.Element {
  const [stopping, setStopping] = useState<readonly string[]>([]);
  // The robots that were not stopped, and what is said of each: all answers of one press matter, not only the last.
  const [failed, setFailed] = useState<ReadonlyMap<string, string>>(new Map());
  const forget = (id: string): void => setFailed((before) => new Map([...before].filter(([other]) => other !== id)));

  const stop = async (id: string): Promise<void> => {
    setStopping((now) => [...now, id]);
    try {
      await request<CommandOutcome>("POST", robotPath(id, "stop"), { timeout: 5_000 });
      forget(id);
      say(t("stop.done", { robot: id }), "done", isStopped && (() => isStopped(id)));
    } catch (error) {
      const text = t("stop.failed", { robot: id, reason: sentence(error) });
      setFailed((before) => new Map(before).set(id, text));
      say(text, "failed", isStopped && (() => !isStopped(id)));
    } finally {
      setStopping((now) => now.filter((other) => other !== id));
    }
  };
  const stopAll = (): void => robots.forEach((id) => void stop(id));

  useEffect(() => {
    if (failed.size === 0 || !isStopped) return undefined;
    const timer = setInterval(() => setFailed((before) => {
      const left = [...before].filter(([id]) => !isStopped(id));
      return left.length === before.size ? before : new Map(left);
    }), LOOK_MS);
    return () => clearInterval(timer);
  }, [failed, isStopped]);

  useEffect(() => {
    const pressed = (event: KeyboardEvent): void => {
      if (event.key !== "F9" || event.repeat) return;
      event.preventDefault();
      if (event.shiftKey) stopAll();
      else if (robot !== null) void stop(robot);
    };
    addEventListener("keydown", pressed);
    return () => removeEventListener("keydown", pressed);
  });

  return (
    <section class="stopbar" aria-label={t("stop.bar")} title={t("stop.keys")}>
      {failed.size > 0 && (
        <div class="unstopped" role="alert">
          <ul class="rows">
            {[...failed].map(([id, text]) => (
              <li key={id} class="row"><span>{text}</span><button onClick={() => forget(id)}>{t("stop.seen")}</button></li>
            ))}
          </ul>
        </div>
      )}
      <button class="stop" disabled={robot === null} aria-keyshortcuts="F9" onClick={() => robot !== null && void stop(robot)}>
        <span class="octagon" aria-hidden="true" />
        <span>{robot === null ? t("stop.none") : stopping.includes(robot) ? t("stop.sending") : t("stop.robot", { robot })}</span>
      </button>
      <button class="stop all" disabled={robots.length === 0} aria-keyshortcuts="Shift+F9" onClick={stopAll}>
        <span>{t("stop.all")}</span>
      </button>
    </section>
  );
}
