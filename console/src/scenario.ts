// A demo's scenario: what it does with the robot, and what only the simulator knows. A real system has none.
import L from "leaflet";
import { useEffect, useState } from "preact/hooks";
import { request } from "./api/client";
import type { Point } from "./api/types";
import type { Floor } from "./map/floor";
import { ofDemo } from "./router";

export interface Scenario {
  readonly phase: string;
  readonly speed: number;
  readonly seed: number;
  readonly distance: number | null;
  readonly clearance: number | null;
  readonly barriers: readonly (readonly Point[])[];
  /** How long each stage from reading to path took (ms). */
  readonly stages: Readonly<Record<string, number>>;
  readonly hazard_to_path: number | null;
  /** CPU (%) and memory (MB) of each process. */
  readonly processes: Readonly<Record<string, readonly [number, number]>>;
  readonly outcome: readonly [string, string] | null;
  readonly events: readonly (readonly [number, string])[];
  readonly trail_from: number;
  readonly trail: readonly Point[];
}

const PERIOD_MS = 500;
const toLatLng = ([x, y]: Point): L.LatLngTuple => [y, x];

/** Read the scenario while a demo is shown, and draw its barriers and where the robot drove; null without any. */
export function useScenario(floor: Floor | null): Scenario | null {
  const [scenario, setScenario] = useState<Scenario | null>(null);
  useEffect(() => {
    if (!floor || !ofDemo()) return;
    const trail = L.polyline([], { className: "trail", interactive: false, smoothFactor: 0 }).addTo(floor.map);
    const barriers = L.polygon([], { className: "barrier", interactive: false }).addTo(floor.map);
    let driven: Point[] = [];
    let timer: ReturnType<typeof setTimeout>;
    let ended = false;
    const read = async (): Promise<void> => {
      try {
        const { value } = await request<Scenario>("GET", `scenario?trail=${driven.length}`);
        if (ended) return;
        driven = [...driven.slice(0, value.trail_from), ...value.trail];
        if (value.trail.length > 0) trail.setLatLngs(driven.map(toLatLng));
        barriers.setLatLngs(value.barriers.map((corners) => [corners.map(toLatLng)]));
        setScenario(value);
      } catch {
        // The demo has ended, or starts its services anew: the connection's state says so.
      }
      if (!ended) timer = setTimeout(() => void read(), PERIOD_MS);
    };
    void read();
    return () => {
      ended = true;
      clearTimeout(timer);
      trail.remove();
      barriers.remove();
    };
  }, [floor]);
  return scenario;
}
