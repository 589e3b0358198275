// A visit as this browser's session has it, asked for each second; and what becomes of it.
import { useCallback, useEffect, useState } from "preact/hooks";
import { Problem, request } from "../api/client";
import type { PublicPlace, Visit, VisitBody } from "../api/types";

const PERIOD_MS = 1000;

export interface Visiting {
  /** Undefined: not known yet; null: there is none. */
  readonly visit: Visit | null | undefined;
  readonly places: readonly PublicPlace[];
  /** The identifier of what was refused last; empty: nothing. */
  readonly problem: string;
  readonly ask: (body: VisitBody) => void;
  readonly go: () => void;
  readonly end: () => void;
  /** Leave a visit that is over. */
  readonly forget: () => void;
}

const isOver = (visit: Visit): boolean => visit.state === "arrived" || visit.state === "ended";

export function useVisit(onExpired: () => void): Visiting {
  const [visit, setVisit] = useState<Visit | null | undefined>(undefined);
  const [places, setPlaces] = useState<readonly PublicPlace[]>([]);
  const [problem, setProblem] = useState("");
  const [left, setLeft] = useState(false);

  const failed = useCallback((error: unknown): void => {
    if (error instanceof Problem && error.status === 401) onExpired();
    else setProblem(error instanceof Problem ? error.code : "unreachable");
  }, []);

  const look = useCallback(async (): Promise<void> => {
    try {
      const found = (await request<Visit>("GET", "visits/mine")).value;
      setVisit(found);
      setProblem((now) => (now === "unreachable" ? "" : now));
    } catch (error) {
      if (!(error instanceof Problem && error.code === "no_visit")) return failed(error);
      // A fog node that was started anew has ended it.
      setVisit((before) => (before && !isOver(before) ? { ...before, state: "ended", end: null } : before ?? null));
      setProblem((now) => (now === "unreachable" ? "" : now));
    }
  }, []);

  useEffect(() => {
    void request<PublicPlace[]>("GET", "visits/places").then((answer) => setPlaces(answer.value), failed);
    void look();
    const timer = setInterval(() => void look(), PERIOD_MS);
    return () => clearInterval(timer);
  }, []);

  const act = (method: "POST" | "DELETE", path: string, body?: VisitBody): void => {
    setProblem("");
    // What is over stays left until the answer is known: the visit before must not be shown as the new one.
    void request(method, path, body ? { body } : {}).then(async () => {
      await look();
      setLeft(false);
    }, failed);
  };
  return {
    visit: left && visit && isOver(visit) ? null : visit,
    places, problem,
    ask: (body) => act("POST", "visits", body),
    go: () => act("POST", "visits/mine/go"),
    end: () => act("DELETE", "visits/mine"),
    forget: () => {
      setProblem("");
      setLeft(true);
    },
  };
}
