// A zone while somebody edits it: what will be sent, and how it is brought together with what others did meanwhile.
import type { Shape, Zone, ZoneBody } from "../api/types";
import type { ShapeType } from "./shapes";

export type Schedule = NonNullable<Zone["schedule"]>;
export const DAYS = ["mon", "tue", "wed", "thu", "fri", "sat", "sun"] as const;

/** When a zone ends: as it was stored, never, some seconds after it was saved, or at a time (s since the epoch). */
export type End =
  | { readonly type: "never" }
  | { readonly type: "after"; readonly seconds: number }
  | { readonly type: "at"; readonly stamp: number };

/** The fields of a zone that an operator sets. */
export interface Fields {
  readonly kind: Zone["kind"];
  readonly shape: Shape | null;
  readonly factor: number;
  readonly speed: number;
  readonly reason: string;
  readonly end: End;
  readonly schedule: Schedule | null;
  /** Ids of the sets with which it is switched. */
  readonly sets: readonly string[];
  readonly enabled: boolean;
}

export interface Draft {
  /** The zone as it was read; null: a new one. */
  readonly base: Zone | null;
  /** Its id; empty: the service makes one. */
  readonly id: string;
  readonly type: ShapeType;
  readonly fields: Fields;
}

const FACTOR = 3;
const SPEED = 0.1;

export function newDraft(type: ShapeType): Draft {
  const fields: Fields = {
    kind: "BLOCKED", shape: null, factor: FACTOR, speed: SPEED, reason: "", end: { type: "never" }, schedule: null, sets: [], enabled: true,
  };
  return { base: null, id: "", type, fields };
}

export function draftOf(zone: Zone): Draft {
  return { base: zone, id: zone.id, type: zone.shape.type, fields: fieldsOf(zone) };
}

/** Return a new zone that is like this one, beside it. */
export function copyOf(zone: Zone, move: (shape: Shape) => Shape): Draft {
  const fields = fieldsOf(zone);
  const over = fields.end.type === "at" && fields.end.stamp * 1000 < Date.now();
  return {
    base: null, id: "", type: zone.shape.type,
    fields: { ...fields, shape: move(zone.shape), end: over ? { type: "never" } : fields.end },
  };
}

export function fieldsOf(zone: Zone): Fields {
  return {
    kind: zone.kind,
    shape: zone.shape,
    factor: zone.factor ?? FACTOR,
    speed: zone.speed ?? SPEED,
    reason: zone.reason,
    // A time to live counts on from where it is: its end is a moment like any other once it has begun.
    end: zone.expires_at !== null ? { type: "at", stamp: zone.expires_at }
      : zone.ttl_s !== null ? { type: "after", seconds: zone.ttl_s } : { type: "never" },
    schedule: zone.schedule,
    sets: zone.sets,
    enabled: zone.enabled,
  };
}

/** Return what is sent for a draft that has a shape, at `now` (s since the epoch, the server's). */
export function bodyOf({ base, id, fields }: Draft, shape: Shape, now: number): ZoneBody {
  // Fields that this page does not edit go back as they came.
  const { author: _author, version: _version, source: _source, active: _active, ...kept } = { ...base } as Zone & { active?: boolean };
  return {
    ...kept,
    id: id === "" ? null : id,
    kind: fields.kind,
    shape,
    factor: fields.kind === "PENALTY" ? fields.factor : null,
    speed: fields.kind === "SPEED_LIMIT" ? fields.speed : null,
    reason: fields.reason,
    starts_at: base?.starts_at ?? null,
    ...endOf(base, fields.end, now),
    schedule: fields.schedule,
    sets: [...fields.sets],
    enabled: fields.enabled,
  };
}

/** Return how an end is sent: as the time that is left, which needs no correct clock, unless it was a moment before. */
function endOf(base: Zone | null, end: End, now: number): Pick<ZoneBody, "expires_at" | "ttl_s"> {
  if (end.type === "never") return { expires_at: null, ttl_s: null };
  if (end.type === "after") return { expires_at: null, ttl_s: end.seconds };
  const asBefore = base !== null && base.ttl_s === null && base.expires_at === end.stamp;
  const toCome = (base?.starts_at ?? 0) > now;
  return asBefore || toCome || end.stamp <= now
    ? { expires_at: end.stamp, ttl_s: null }
    : { expires_at: null, ttl_s: Math.round((end.stamp - now) * 10) / 10 };
}

export type FieldName = keyof Fields;
const NAMES: readonly FieldName[] = ["kind", "shape", "factor", "speed", "reason", "end", "schedule", "sets", "enabled"];

const same = (a: unknown, b: unknown): boolean => JSON.stringify(a) === JSON.stringify(b);

/** Return the fields in which two versions differ; the factor and speed only where the kind has them. */
export function differing(mine: Fields, theirs: Fields): FieldName[] {
  const shown: Readonly<Partial<Record<FieldName, Zone["kind"]>>> = { factor: "PENALTY", speed: "SPEED_LIMIT" };
  return NAMES.filter((name) => {
    const only = shown[name];
    return !same(mine[name], theirs[name]) && (only === undefined || mine.kind === only || theirs.kind === only);
  });
}

export type Choice = "mine" | "theirs";

/** Return whose value to begin with for each field in which mine and theirs differ: of who changed it, mine if both did. */
export function suggested(base: Fields, mine: Fields, theirs: Fields): Map<FieldName, Choice> {
  return new Map(differing(mine, theirs).map((name) => [name, same(mine[name], base[name]) ? "theirs" : "mine"]));
}

/** Return the fields that the choices make of two versions. */
export function merged(mine: Fields, theirs: Fields, choices: ReadonlyMap<FieldName, Choice>): Fields {
  const found: Record<string, unknown> = { ...mine };
  for (const [name, choice] of choices) if (choice === "theirs") found[name] = theirs[name];
  return found as unknown as Fields;
}

/** Return the next time (s since the epoch) at which it is this hour of the day. */
export function nextHour(hour: number, now: number): number {
  const date = new Date(now * 1000);
  date.setHours(hour, 0, 0, 0);
  if (date.getTime() <= now * 1000) date.setDate(date.getDate() + 1);
  return date.getTime() / 1000;
}

export type ZoneState = "active" | "expiring" | "off" | "toCome" | "resting" | "over";

const SOON_S = 15 * 60;

/** Return in which state a zone is; `now` in s since the epoch. Whether it is in force only the map-service says. */
export function stateOf(zone: Zone & { readonly active: boolean }, now: number): ZoneState {
  if (zone.active) return zone.expires_at !== null && zone.expires_at - now < SOON_S ? "expiring" : "active";
  if (!zone.enabled) return "off";
  if (zone.starts_at !== null && zone.starts_at > now) return "toCome";
  if (zone.expires_at !== null && zone.expires_at <= now) return "over";
  return "resting";
}
