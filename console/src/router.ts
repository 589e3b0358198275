// Which view is shown stands behind the address's #, so that it can be bookmarked and the browser's "back" works.
import { useEffect, useState } from "preact/hooks";

export const VIEWS = ["map", "zones", "robots", "schedules", "sensors", "timeline", "floors", "scenario"] as const;
export type View = (typeof VIEWS)[number];

export interface Route {
  readonly view: View;
  /** What of the view is chosen, such as a robot or a zone; empty: nothing. */
  readonly chosen: string;
}

export function parseRoute(hash: string): Route {
  const [view = "", ...rest] = hash.replace(/^#\/?/, "").split("/");
  const found = VIEWS.find((name) => name === view) ?? "map";
  let chosen = rest.join("/");
  try {
    chosen = decodeURIComponent(chosen);
  } catch {
    // Not encoded by us: taken as it is.
  }
  return { view: found, chosen };
}

export function routeHash(view: View, chosen = ""): string {
  return `#/${view}${chosen === "" ? "" : `/${encodeURIComponent(chosen)}`}`;
}

export function go(view: View, chosen = ""): void {
  location.hash = routeHash(view, chosen);
}

export function useRoute(): Route {
  const [route, setRoute] = useState(() => parseRoute(location.hash));
  useEffect(() => {
    const changed = (): void => setRoute(parseRoute(location.hash));
    addEventListener("hashchange", changed);
    return () => removeEventListener("hashchange", changed);
  }, []);
  return route;
}

/** What fills the page: the console, a visit that starts at a place, or the codes that are printed for visits. */
export interface Page {
  readonly name: "console" | "visit" | "codes";
  readonly place: string;
}

export function parsePage(hash: string): Page {
  const found = /^#\/(visit|codes)(?:\/([^?]*))?/.exec(hash);
  if (!found) return { name: "console", place: "" };
  return { name: found[1] as "visit" | "codes", place: found[2] ?? "" };
}

export function usePage(): Page {
  const [page, setPage] = useState(() => parsePage(location.hash));
  useEffect(() => {
    const changed = (): void => setPage(parsePage(location.hash));
    addEventListener("hashchange", changed);
    return () => removeEventListener("hashchange", changed);
  }, []);
  return page;
}

/** Return the address of the visits from a place that a code has: what is behind the # reaches no server's log. */
export const visitHash = (place: string, token: string): string => `#/visit/${place}?login=${encodeURIComponent(token)}`;

const SCENARIO = "fognav.scenario";

/** Whether this browser's tab was opened by a demo, which has a scenario to show. */
export const ofDemo = (): boolean => sessionStorage.getItem(SCENARIO) !== null;

/** Take the one-time login out of the address, so that neither history nor a shared screen keeps it. */
export function takeLogin(): string | null {
  const found = /^#(\/visit\/[^?]*)?\??login=([^&]+)(&scenario)?$/.exec(location.hash);
  if (!found?.[2]) return null;
  if (found[3]) sessionStorage.setItem(SCENARIO, "");
  history.replaceState(null, "", `#${found[1] ?? "/map"}`);
  return decodeURIComponent(found[2]);
}
