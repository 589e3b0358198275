// What a visitor sees, on a tablet at a place or on their phone: choose, wait, follow, arrived. Large, and nothing else.
import { useEffect, useReducer, useRef, useState } from "preact/hooks";
import type { PublicPlace, Visit } from "../api/types";
import { language, maybe, setLanguage, t } from "../i18n/i18n";
import { duration, metres } from "../text";
import { setTheme, theme } from "../theme";
import { useVisit } from "./requests";
import "./visit.css";

/** After so long the end of a visit makes place for the next visitor at a tablet. */
const LEAVE_MS = 60_000;

interface Props {
  /** Where the code was scanned; empty: not known. */
  readonly place: string;
  readonly onExpired: () => void;
}

export function VisitApp({ place, onExpired }: Props): preact.JSX.Element {
  const { visit, places, problem, ask, go, end, forget } = useVisit(onExpired);
  const [here, setHere] = useState(place);
  const redraw = useRedraw();
  useEffect(() => setHere(place), [place]);
  const name = (id: string): string => places.find((each) => each.id === id)?.label || id;
  // The next visitor at a tablet stands where it hangs.
  const leave = (): void => {
    setHere(place);
    forget();
  };
  const over = visit?.state === "arrived" || visit?.state === "ended";
  useEffect(() => {
    if (!over) return undefined;
    const timer = setTimeout(leave, LEAVE_MS);
    return () => clearTimeout(timer);
  }, [over]);
  const known = places.some((each) => each.id === here);
  return (
    <Frame
      title={visit ? headline(visit) : t(known ? "visit.whither" : "visit.where")} state={visit?.state ?? "choose"}
      onChange={redraw}
    >
      {visit === undefined ? null : visit === null ? (
        <Choice
          places={places} here={known ? here : ""} onHere={setHere}
          onGoal={(goal) => ask({ start: here, goal })}
        />
      ) : <Progress visit={visit} name={name} />}
      {visit?.state === "ready" && <button class="primary huge" onClick={go}>{t("visit.go")}</button>}
      {visit && !over && (
        <button class="danger" onClick={end}>{t(visit.state === "leading" ? "visit.stop" : "visit.cancel")}</button>
      )}
      {visit && over && <button class="primary" onClick={leave}>{t("visit.again")}</button>}
      <p class="problem" role="alert">{problem === "" ? "" : maybe(`visit.problem.${problem}`) ?? t("visit.end.failed")}</p>
    </Frame>
  );
}

/** What who comes without a valid code reads. */
export function NoCode(): preact.JSX.Element {
  return <Frame title={t("visit.noCode")} state="choose" onChange={useRedraw()}><p>{t("visit.noCodeHow")}</p></Frame>;
}

/** Return how to draw all anew, in another language or other colours. */
const useRedraw = (): (() => void) => useReducer((count: number) => count + 1, 0)[1] as () => void;

function headline({ state, robot }: Visit): string {
  const named = state === "coming" || state === "ready" || state === "leading";
  return named ? t(`visit.${state}`, { robot: robot ?? "" }) : t(`visit.${state}`);
}

function Progress({ visit, name }: { readonly visit: Visit; readonly name: (id: string) => string }): preact.JSX.Element {
  const { state, distance_m: distance, seconds, ahead, goal } = visit;
  const place = name(goal);
  return (
    <>
      {state === "ready" ? <p>{t("visit.readyHow", { place })}</p>
        : state === "ended" ? <p>{maybe(`visit.end.${visit.end ?? "lost"}`)}</p>
        : <p class="place">{state === "arrived" ? place : t("visit.to", { place })}</p>}
      {state === "waiting" && <p>{ahead === 0 ? t("visit.next") : t("visit.ahead", { count: ahead })}</p>}
      {state === "ready" && seconds !== null && <p>{t("visit.readyRest", { time: duration(seconds) })}</p>}
      {distance !== null && seconds !== null && (
        <p>{t("visit.rest", { distance: metres(distance, 0), time: duration(seconds) })}</p>
      )}
    </>
  );
}

interface ChoiceProps {
  readonly places: readonly PublicPlace[];
  readonly here: string;
  readonly onHere: (place: string) => void;
  readonly onGoal: (place: string) => void;
}

function Choice({ places, here, onHere, onGoal }: ChoiceProps): preact.JSX.Element {
  const label = ({ id, label: said }: PublicPlace): string => said || id;
  const found = places.find(({ id }) => id === here);
  const others = places.filter(({ id }) => id !== here);
  return (
    <>
      {found && <p>{t("visit.here")} <bdi class="place">{label(found)}</bdi></p>}
      <ul class="choices">
        {others.map((place) => (
          <li key={place.id}>
            <button onClick={() => (found ? onGoal(place.id) : onHere(place.id))}><bdi>{label(place)}</bdi></button>
          </li>
        ))}
      </ul>
      <p>{t(others.length === 0 ? "visit.noPlaces" : "visit.how")}</p>
      {found && <button class="quiet" onClick={() => onHere("")}>{t("visit.change")}</button>}
    </>
  );
}

interface FrameProps {
  readonly title: string;
  readonly state: string;
  /** Called when another language or other colours were chosen. */
  readonly onChange: () => void;
  readonly children: preact.ComponentChildren;
}

function Frame({ title, state, onChange, children }: FrameProps): preact.JSX.Element {
  const heading = useRef<HTMLHeadingElement>(null);
  // The button that had the focus may be gone: screen readers go on at what is new.
  useEffect(() => heading.current?.focus(), [state]);
  useEffect(() => void (document.title = title), [title]);
  const dark = theme() === "dark" || (theme() === "auto" && matchMedia("(prefers-color-scheme: dark)").matches);
  return (
    <div class={`visit ${state}`}>
      <header>
        {(["en", "pt"] as const).map((each) => (
          <button key={each} lang={each} aria-pressed={language() === each} onClick={() => {
            setLanguage(each);
            onChange();
          }}>{each === "en" ? "English" : "Português"}</button>
        ))}
        <button onClick={() => {
          setTheme(dark ? "light" : "dark");
          onChange();
        }}>{t(dark ? "visit.light" : "visit.dark")}</button>
      </header>
      <main>
        <h1 ref={heading} tabIndex={-1}>{title}</h1>
        {children}
      </main>
    </div>
  );
}
