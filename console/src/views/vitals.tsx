// How a robot's computer does: CPU beside what it took when it drove alone, Wi-Fi and battery, over the last ten minutes.
// Charts are SVG of our own: three lines that change every two seconds need no library (ADR 67).
import { useEffect, useState } from "preact/hooks";
import { request } from "../api/client";
import type { Vitals } from "../api/types";
import { useConsole } from "../context";
import { t } from "../i18n/i18n";
import { clockTime, decimal, percent } from "../text";
import { alone, drives, machine, withFog } from "./baseline.json";

const SPAN_S = 600;
/** Vitals come every 2 s: a longer gap is a gap in the line. */
const GAP_S = 7;
const WIDTH = 300;
const HEIGHT = 48;

const signal = (dbm: number | null): string => (dbm === null ? t("vitals.noWifi") : `${decimal(dbm, 0)} dBm`);
const sum = ({ cpu: shares }: Vitals): number => Object.values(shares).reduce((all, share) => all + share, 0);
const cpu = (share: number): string => `${decimal(share, 1)} %`;

/** Return CPU and Wi-Fi in one line. */
export const vitalsText = (vitals: Vitals): string => `CPU ${cpu(sum(vitals))} · ${vitals.wifi_dbm === null ? "" : "Wi-Fi "}${signal(vitals.wifi_dbm)}`;

/** Return what came in the last ten minutes: what the server has kept, then what came since. */
function useHistory(id: string): readonly Vitals[] {
  const { live } = useConsole();
  const [history, setHistory] = useState<readonly Vitals[]>([]);
  useEffect(() => {
    let wanted = true;
    const add = (found: readonly Vitals[]): void => setHistory((before) => {
      const known = new Set(before.map(({ stamp }) => stamp));
      const all = [...before, ...found.filter(({ stamp }) => !known.has(stamp))].sort((a, b) => a.stamp - b.stamp);
      return all.filter(({ stamp }) => stamp > (all.at(-1)?.stamp ?? 0) - SPAN_S);
    });
    const take = (key: string): void => {
      const newest = live.of.vitals.get(id);
      if (newest && (key === id || key === "")) add([newest]);
    };
    const off = live.on(["vitals"], take);
    take("");
    // Without it the chart begins now.
    request<Vitals[]>("GET", `vitals/${encodeURIComponent(id)}`).then(({ value }) => wanted && add(value), () => undefined);
    return () => {
      wanted = false;
      off();
    };
  }, [live, id]);
  return history;
}

export function VitalsFacts({ id }: { readonly id: string }): preact.JSX.Element {
  const history = useHistory(id);
  const last = history.at(-1);
  if (!last) return <p class="muted">{t("vitals.none")}</p>;
  const processes = Object.entries(last.cpu).map(([name, share]) => `${name} ${cpu(share)}`).join(", ");
  return (
    <section class="vitals" aria-label={t("vitals.title")}>
      <Chart label={t("robot.cpu")} now={cpu(sum(last))} history={history} of={sum} low={0} high={alone * 1.5} line={alone} text={cpu} />
      <p class="muted">{t("vitals.baseline", { alone: cpu(alone), fog: cpu(withFog), drives: decimal(drives, 0), machine })} {processes}</p>
      <Chart label={t("robot.wifi")} now={signal(last.wifi_dbm)} history={history} of={(each) => each.wifi_dbm} low={-90} high={-30} text={signal} />
      <Chart label={t("robot.battery")} now={percent(last.battery)} history={history} of={(each) => each.battery} low={0} high={1} text={percent} />
    </section>
  );
}

interface ChartProps {
  readonly label: string;
  /** The newest value in words. */
  readonly now: string;
  readonly history: readonly Vitals[];
  readonly of: (vitals: Vitals) => number | null;
  /** What the lower and the upper edge show, unless a value lies beyond. */
  readonly low: number;
  readonly high: number;
  /** A value to compare with, drawn dashed. */
  readonly line?: number;
  readonly text: (value: number) => string;
}

function Chart({ label, now, history, of, low, high, line, text }: ChartProps): preact.JSX.Element | null {
  const found = history.flatMap((each) => {
    const value = of(each);
    return value === null ? [] : [{ at: each.stamp, value }];
  });
  const values = found.map(({ value }) => value);
  const [bottom, top] = [Math.min(low, ...values), Math.max(high, ...values)];
  const end = history.at(-1)?.stamp ?? 0;
  const y = (value: number): string => (HEIGHT - (HEIGHT * (value - bottom)) / (top - bottom)).toFixed(1);
  const drawn = found.map(({ at, value }, i) => {
    const goesOn = i > 0 && at - (found[i - 1]?.at ?? 0) < GAP_S;
    return `${goesOn ? "L" : "M"}${(WIDTH - (WIDTH * (end - at)) / SPAN_S).toFixed(1)} ${y(value)}`;
  }).join("");
  const from = found[0] ? clockTime(found[0].at) : "";
  const about = found.length > 1
    ? t("vitals.range", { what: label, from, low: text(Math.min(...values)), high: text(Math.max(...values)) }) : "";
  return (
    <figure>
      <figcaption><span class="muted">{label}</span> <span class="value">{now}</span></figcaption>
      {found.length > 1 && (
        <svg viewBox={`0 0 ${WIDTH} ${HEIGHT}`} preserveAspectRatio="none" role="img" aria-label={about}>
          {line !== undefined && <path class="baseline" d={`M0 ${y(line)}H${WIDTH}`} />}
          <path d={drawn} />
        </svg>
      )}
    </figure>
  );
}
