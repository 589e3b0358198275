// Numbers and times as text, in the user's language.
import { language } from "./i18n/i18n";

const formats = new Map<string, Intl.NumberFormat>();

/** Return the time of day of a stamp (s since the epoch), with the day if it is not today. */
export function clockTime(stamp: number, now: number = Date.now()): string {
  const date = new Date(stamp * 1000);
  const today = date.toDateString() === new Date(now).toDateString();
  return date.toLocaleString(language(), {
    hour: "2-digit", minute: "2-digit", second: "2-digit", hourCycle: "h23",
    ...(today ? {} : { day: "numeric", month: "short" }),
  });
}

/** Return a moment (s since the epoch) by the clocks of a time zone, which is named; this browser's, if it does not know it. */
export function zonedTime(stamp: number, zone: string): string {
  const format = (timeZone?: string): Intl.DateTimeFormat => new Intl.DateTimeFormat(language(), {
    weekday: "short", day: "numeric", month: "short", hour: "2-digit", minute: "2-digit", hourCycle: "h23", timeZone,
  });
  const at = new Date(stamp * 1000);
  try {
    return `${format(zone).format(at)} (${zone})`;
  } catch {
    const own = format();
    return `${own.format(at)} (${own.resolvedOptions().timeZone})`;
  }
}

/** Return a number with a fixed number of decimals. */
export function decimal(value: number, digits: number): string {
  // A format is expensive to make, and used many times a second.
  const key = `${language()} ${digits}`;
  const known = formats.get(key)
    ?? new Intl.NumberFormat(language(), { minimumFractionDigits: digits, maximumFractionDigits: digits });
  formats.set(key, known);
  return known.format(Math.abs(value) < 0.5 * 10 ** -digits ? 0 : value);  // no minus zero
}

export function metres(value: number | null | undefined, digits = 1): string {
  return value === null || value === undefined ? "–" : `${decimal(value, digits)} m`;
}

export function percent(share: number | null | undefined): string {
  return share === null || share === undefined ? "–" : `${decimal(share * 100, 0)} %`;
}

/** Return a duration in the largest unit that fits: 12 s, 3 min, 2 h. */
export function duration(seconds: number): string {
  if (seconds < 90) return `${decimal(Math.max(0, seconds), 0)} s`;
  if (seconds < 5400) return `${decimal(seconds / 60, 0)} min`;
  return `${decimal(seconds / 3600, 1)} h`;
}
