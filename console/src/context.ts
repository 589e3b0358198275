// What every view can use: the live state, who is logged in, the map, and messages to the user.
import { createContext } from "preact";
import { useContext, useEffect, useReducer, useRef, useState } from "preact/hooks";
import { request } from "./api/client";
import type { Session } from "./api/types";
import { drawInTurn } from "./frames";
import type { Live, Topic } from "./live/live";
import type { Floor } from "./map/floor";
import type { Scenario } from "./scenario";
import { sentence } from "./stop";

/**
 * Say something in the live region: a result of what the user did, or a change that matters. It goes after a while, and
 * once what it speaks of does not hold any more; the timeline keeps it.
 */
export type Say = (text: string, kind?: "done" | "failed", holds?: () => boolean) => void;

export interface Console {
  readonly live: Live;
  readonly session: Session;
  /** The map; null until it is drawn for the first time. */
  readonly floor: Floor | null;
  /** The robot that stop button and commands are for; null: none is known. */
  readonly robot: string | null;
  /** All robots, sorted. */
  readonly robots: readonly string[];
  readonly chooseRobot: (id: string) => void;
  /** What a demo does; null in a real system. */
  readonly scenario: Scenario | null;
  readonly say: Say;
  readonly logOut: () => void;
}

export const ConsoleContext = createContext<Console | null>(null);

export function useConsole(): Console {
  const found = useContext(ConsoleContext);
  if (!found) throw new Error("used outside of the console");
  return found;
}

export function mayOperate(session: Session): boolean {
  return session.role === "operator" || session.role === "admin";
}

const PERIOD_MS = 400;

const waiting = new Set<() => void>();
let timer: ReturnType<typeof setTimeout> | undefined;

/** So many components are drawn in a frame; further ones in a later one. */
const COMPONENTS_A_FRAME = 4;

function redrawNow(): void {
  let left = COMPONENTS_A_FRAME;
  for (const each of waiting) {
    if (left-- === 0) {
      drawInTurn("panels", redrawNow);
      return;
    }
    waiting.delete(each);
    each();
  }
}

/** Draw components anew together, at most twice or three times a second: a person reads no faster. */
function redrawSoon(redraw: () => void): void {
  waiting.add(redraw);
  timer ??= setTimeout(() => {
    timer = undefined;
    drawInTurn("panels", redrawNow);
  }, PERIOD_MS);
}

/** Draw the component anew when something in these topics changes; with `only`, when what has this id does. */
export function useLive(topics: readonly Topic[], only?: string): Live {
  const { live } = useConsole();
  const [, count] = useReducer((before: number) => before + 1, 0);
  const key = topics.join(" ");
  useEffect(() => {
    const redraw = (): void => count(0);
    const off = live.on(key.split(" ") as Topic[], (id) => {
      if (only === undefined || id === only || id === "") redrawSoon(redraw);
    });
    redrawSoon(redraw);
    return () => {
      off();
      waiting.delete(redraw);
    };
  }, [live, key, only]);
  return live;
}

/** Draw the component anew once a second, for ages and what becomes old. */
export function useSeconds(): void {
  const [, count] = useReducer((before: number) => before + 1, 0);
  useEffect(() => {
    const redraw = (): void => count(0);
    const every = setInterval(() => redrawSoon(redraw), 1000);
    return () => {
      clearInterval(every);
      waiting.delete(redraw);
    };
  }, []);
}

interface Read<T> {
  /** null: it was not read yet. */
  readonly value: T | null;
  /** Why it could not be read the last time; empty if it could. */
  readonly problem: string;
}

/** So long (ms) after a change it is read again: changes come together. */
const SOON_MS = 500;

/** Return what a path of REST has, read again when something in these topics changes, every `period` ms, and by `again`. */
export function useRead<T>(path: string, topics: readonly Topic[], period?: number): Read<T> & { readonly again: () => void } {
  const { live } = useConsole();
  const [read, setRead] = useState<Read<T>>({ value: null, problem: "" });
  const [turn, again] = useReducer((count: number) => count + 1, 0);
  const key = topics.join(" ");
  useEffect(() => {
    let wanted = true;
    let soon: ReturnType<typeof setTimeout> | undefined;
    const look = (): void => {
      soon = undefined;
      void request<T>("GET", path).then(
        ({ value }) => wanted && setRead({ value, problem: "" }),
        (error: unknown) => wanted && setRead((before) => ({ ...before, problem: sentence(error) })),
      );
    };
    look();
    const off = live.on(key.split(" ") as Topic[], () => void (soon ??= setTimeout(look, SOON_MS)));
    const timer = period === undefined ? undefined : setInterval(look, period);
    return () => {
      wanted = false;
      off();
      clearInterval(timer);
      clearTimeout(soon);
    };
  }, [live, path, key, period, turn]);
  return { ...read, again: () => again(0) };
}

/** Bring a panel into view when it opens, with the focus in its first field. */
export function useShown(): preact.RefObject<HTMLFormElement | null> {
  const element = useRef<HTMLFormElement>(null);
  useEffect(() => {
    element.current?.querySelector<HTMLElement>("select, input")?.focus({ preventScroll: true });
    element.current?.scrollIntoView({ block: "nearest" });
  }, []);
  return element;
}
