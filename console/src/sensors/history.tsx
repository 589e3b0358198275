// The states of an area over time: a strip to see, and the same as a list to read.
import { useEffect, useState } from "preact/hooks";
import { request } from "../api/client";
import type { PeriodView } from "../api/types";
import { saidCause } from "../i18n/codes";
import { t } from "../i18n/i18n";
import { clockTime, duration } from "../text";

const PERIODS = 100;
const LISTED = 8;
const SPANS = [3600, 6 * 3600, 24 * 3600, 7 * 24 * 3600] as const;

export interface Piece {
  readonly state: PeriodView["period"]["state"];
  /** Where it begins and how long it is, as shares of the strip. */
  readonly from: number;
  readonly share: number;
  readonly overridden: boolean;
}

/** Return the pieces of a strip that ends now and is `span` s long. */
export function piecesOf(periods: readonly PeriodView[], now: number, span: number): Piece[] {
  const begin = now - span;
  return periods.flatMap(({ period, ended }) => {
    const [from, to] = [Math.max(period.began, begin), Math.min(ended ?? now, now)];
    return to <= from ? [] : [{ state: period.state, from: (from - begin) / span, share: (to - from) / span, overridden: period.overridden }];
  });
}

interface Props {
  readonly area: string;
  /** Changes whenever the history is longer. */
  readonly since: number;
  readonly now: number;
}

export function History({ area, since, now }: Props): preact.JSX.Element {
  const [periods, setPeriods] = useState<readonly PeriodView[] | null>(null);
  const [span, setSpan] = useState<number>(SPANS[0]);
  useEffect(() => {
    let wanted = true;
    const path = `areas/${encodeURIComponent(area)}/history?limit=${PERIODS}`;
    void request<PeriodView[]>("GET", path).then(({ value }) => wanted && setPeriods(value), () => wanted && setPeriods([]));
    return () => {
      wanted = false;
    };
  }, [area, since]);
  const pieces = piecesOf(periods ?? [], now, span);
  return (
    <section aria-label={t("sensors.history")}>
      <h3>{t("sensors.history")}</h3>
      <label class="field">{t("sensors.span")}
        <select value={String(span)} onChange={(event) => setSpan(Number(event.currentTarget.value))}>
          {SPANS.map((each) => <option key={each} value={String(each)}>{duration(each)}</option>)}
        </select>
      </label>
      <svg class="strip" viewBox="0 0 1000 24" preserveAspectRatio="none" role="img" aria-label={t("sensors.strip", { span: duration(span) })}>
        <rect class="none" width="1000" height="24" />
        {pieces.map(({ state, from, share, overridden }) => (
          <rect key={from} class={`${state} ${overridden ? "overridden" : ""}`} x={from * 1000} width={Math.max(share * 1000, 1)} height={overridden ? 16 : 24} />
        ))}
      </svg>
      <p class="ends muted"><span>{clockTime(now - span)}</span><span>{clockTime(now)}</span></p>
      {periods?.length === 0 && <p class="muted">{t("sensors.noHistory")}</p>}
      <ul class="rows">
        {(periods ?? []).slice(0, LISTED).map(({ period, lasted_s: lasted }) => (
          <li key={period.began} class="row">
            <span class={`swatch ${period.state}`} aria-hidden="true" />
            <span>{t(`state.${period.state}`)}{period.overridden && ` (${t("area.overridden")})`}</span>
            <span class="value">{clockTime(period.began)} · {duration(lasted)}</span>
            <span class="why clipped"><bdi>{saidCause(period.code, period.decided_by, period.cause)}</bdi></span>
          </li>
        ))}
      </ul>
    </section>
  );
}
