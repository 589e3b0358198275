// The console once somebody is logged in: tabs, the map, the panel of the view, messages and the stop bar.
import { useCallback, useEffect, useMemo, useRef, useState } from "preact/hooks";
import type { Session } from "./api/types";
import { type Console, ConsoleContext, type Say } from "./context";
import { type Language, language, setLanguage, t } from "./i18n/i18n";
import { Live } from "./live/live";
import { Floor } from "./map/floor";
import { Patterns } from "./map/patterns";
import { MapTools } from "./map/tools";
import { go, ofDemo, routeHash, useRoute, type View, VIEWS } from "./router";
import { useScenario } from "./scenario";
import { rememberedRobots, rememberRobots, StopBar } from "./stop";
import { duration } from "./text";
import { onTheme, setTheme, theme, type Theme } from "./theme";
import { FloorsView, useFloorCount } from "./views/floors";
import { MapView } from "./views/map";
import { RobotsView } from "./views/robots";
import { ScenarioView } from "./views/scenario";
import { SchedulesView } from "./views/schedules";
import { SensorsView } from "./views/sensors";
import { TimelineView } from "./views/timeline";
import { ZonesView } from "./views/zones";

const PANELS: Readonly<Record<View, () => preact.JSX.Element>> = {
  map: MapView,
  zones: ZonesView,
  robots: RobotsView,
  schedules: SchedulesView,
  sensors: SensorsView,
  timeline: TimelineView,
  floors: FloorsView,
  scenario: ScenarioView,
};

interface Props {
  readonly session: Session;
  readonly onExpired: () => void;
  readonly onLogOut: () => void;
}

interface Said {
  readonly text: string;
  readonly kind: "done" | "failed";
  readonly holds?: (() => boolean) | undefined;
}

const NOTHING: Said = { text: "", kind: "done" };
/** How long a message stays. */
const STAYS_MS = { done: 20_000, failed: 60_000 } as const;
/** The stream tells a moment later what a request has changed: only then is it seen whether a message holds. */
const TOLD_MS = 3_000;

export function ConsoleApp({ session, onExpired, onLogOut }: Props): preact.JSX.Element {
  const route = useRoute();
  const live = useMemo(() => new Live("api/v1/events"), []);
  const [floor, setFloor] = useState<Floor | null>(null);
  const [chosen, setChosen] = useState<string | null>(null);
  const [robots, setRobots] = useState<readonly string[]>(rememberedRobots);
  const [said, setSaid] = useState<Said>(NOTHING);
  const [, setSpoken] = useState<Language>(language);
  const element = useRef<HTMLDivElement>(null);

  useEffect(() => {
    const off = live.on(["connection"], (connection) => connection === "refused" && onExpired());
    live.start();
    return () => {
      off();
      live.close();
    };
  }, [live]);

  useEffect(() => {
    const look = (): void => {
      const heard = [...live.of.robot.keys(), ...live.of.pose.keys()];
      setRobots((before) => {
        // Until the server has told of all robots, those of before can be stopped all the same, and no button passes from
        // the chosen robot to another.
        const ids = [...new Set(live.ready ? heard : [...before, ...heard])].sort();
        if (before.join("\n") === ids.join("\n")) return before;
        if (ids.length > 0) rememberRobots(ids);
        return ids;
      });
    };
    look();
    const known = (id: string): boolean => live.of.robot.has(id) || live.of.pose.has(id);
    let before = "";
    return live.on(["robot", "pose", "ready"], (id) => {
      // A hundred poses a second are of robots that are known.
      if (id !== "" && known(id) && before.includes(`\n${id}\n`)) return;
      look();
      before = `\n${[...live.of.robot.keys(), ...live.of.pose.keys()].join("\n")}\n`;
    });
  }, [live]);

  const robot = chosen !== null && robots.includes(chosen) ? chosen : robots[0] ?? null;
  const say = useCallback<Say>((text, kind = "done", holds) => setSaid({ text, kind, holds }), []);
  const isStopped = useCallback((id: string): boolean => live.isStopped(id), [live]);
  useEffect(() => {
    if (said.text === "") return undefined;
    const since = performance.now();
    const timer = setInterval(() => {
      const age = performance.now() - since;
      if (age > STAYS_MS[said.kind] || (age > TOLD_MS && said.holds?.() === false)) setSaid(NOTHING);
    }, 500);
    return () => clearInterval(timer);
  }, [said]);

  useEffect(() => {
    if (!element.current) return;
    const made = new Floor(element.current, live, {
      onRobot: (id) => {
        setChosen(id);
        go("robots", id);
      },
      onZone: (id) => go("zones", id),
    });
    setFloor(made);
    const off = onTheme(() => made.recolour());
    return () => {
      off();
      made.remove();
    };
  }, [live]);

  useEffect(() => floor?.select(robot), [floor, robot]);

  const scenario = useScenario(floor);
  const value: Console = {
    live, session, floor, robot, robots, scenario, say, logOut: onLogOut,
    chooseRobot: setChosen,
  };
  const several = useFloorCount() > 1;
  const Panel = PANELS[route.view];
  return (
    <ConsoleContext.Provider value={value}>
      <div class="shell" data-view={route.view}>
        <Patterns />
        <a class="skip" href="#content" onClick={(event) => {
          event.preventDefault();
          document.getElementById("content")?.focus();
        }}>{t("skip")}</a>
        <header>
          <h1>{t("app.name")} <span class="site">{live.site}</span></h1>
          <ConnectionState live={live} />
          <Settings onLanguage={setSpoken} />
        </header>
        <nav aria-label={t("app.name")}>
          {VIEWS.filter((view) => (view !== "scenario" || ofDemo()) && (view !== "floors" || several)).map((view) => (
            <a key={view} href={routeHash(view)} aria-current={view === route.view ? "page" : undefined}>
              <span class={`icon ${view}`} aria-hidden="true" />{t(`view.${view}`)}
            </a>
          ))}
        </nav>
        <section class="stage" aria-label={t("view.map")}>
          <div ref={element} class="floor" role="application" aria-label={t("map.label")} tabIndex={0} />
          {floor && <MapTools />}
        </section>
        <main id="content" tabIndex={-1} aria-label={t(`view.${route.view}`)}><Panel /></main>
        <p class={`said ${said.kind}`} role="status" aria-live="polite"><span>{said.text}</span></p>
        <StopBar robot={robot} robots={robots} say={say} isStopped={isStopped} />
      </div>
    </ConsoleContext.Provider>
  );
}

/** Whether what is shown is today's: said in words, and by grey. */
function ConnectionState({ live }: { readonly live: Live }): preact.JSX.Element {
  const [, setTick] = useState(0);
  useEffect(() => {
    const look = (): void => setTick((count) => count + 1);
    const off = live.on(["connection", "ready"], look);
    const timer = setInterval(look, 500);
    return () => {
      off();
      clearInterval(timer);
    };
  }, [live]);
  const state = live.connection === "open" ? (live.old ? "old" : live.ready ? "open" : "loading") : live.connection;
  useEffect(() => void document.documentElement.classList.toggle("old", live.old), [live.old]);
  const text = state === "refused" ? t("login.expired")
    : state === "old" ? t("connection.old", { age: duration(live.silence / 1000) }) : t(`connection.${state}`);
  return <p class={`connection ${state}`} role="status">{text}</p>;
}

function Settings({ onLanguage }: { readonly onLanguage: (to: Language) => void }): preact.JSX.Element {
  return (
    <ConsoleContext.Consumer>
      {(console) => console && (
        <details class="settings">
          <summary>{t("settings")}</summary>
          <div class="card">
            <p>{t("user", { name: console.session.name, role: t(`role.${console.session.role}`) })}</p>
            <label>{t("language")}
              <select value={language()} onChange={(event) => {
                const to = event.currentTarget.value as Language;
                setLanguage(to);
                onLanguage(to);
                console.floor?.fixed.redrawAll();
              }}>
                <option value="en" lang="en">English</option>
                <option value="pt" lang="pt">Português</option>
              </select>
            </label>
            <label>{t("theme")}
              <select value={theme()} onChange={(event) => setTheme(event.currentTarget.value as Theme)}>
                <option value="auto">{t("theme.auto")}</option>
                <option value="light">{t("theme.light")}</option>
                <option value="dark">{t("theme.dark")}</option>
              </select>
            </label>
            <p class="muted">{t("stop.keys")}</p>
            <button onClick={console.logOut}>{t("logout")}</button>
          </div>
        </details>
      )}
    </ConsoleContext.Consumer>
  );
}
