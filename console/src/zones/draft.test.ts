import { expect, test } from "vitest";
import type { Zone } from "../api/types";
import { bodyOf, draftOf, fieldsOf, merged, nextHour, stateOf, suggested } from "./draft";

const zone = (more: Partial<Zone> = {}): Zone => ({
  id: "wet", kind: "BLOCKED", shape: { type: "circle", centre: [1, 2], radius: 1 }, factor: null, speed: null, reason: "wet floor",
  author: "ana", starts_at: null, expires_at: null, ttl_s: null, schedule: null, sets: [], source: null,
  enabled: true, version: 3, ...more,
});

test("a zone that nobody changed is sent back as it was", () => {
  const before = zone({ starts_at: 5, expires_at: 99 });
  const { author: _author, version: _version, source: _source, ...rest } = before;
  expect(bodyOf(draftOf(before), before.shape, 50)).toEqual(rest);
});

test("a zone with a time to live keeps the rest of it, though something else of it changes", () => {
  const body = bodyOf(draftOf(zone({ ttl_s: 600, expires_at: 700 })), zone().shape, 300);
  expect(body).toMatchObject({ ttl_s: 400, expires_at: null });
});

test("a chosen time is sent as the time until then, so that the zone ends though the server's clock is not synchronized", () => {
  const draft = draftOf(zone());
  const chosen = { ...draft, fields: { ...draft.fields, end: { type: "at" as const, stamp: 1000 } } };
  expect(bodyOf(chosen, zone().shape, 400)).toMatchObject({ ttl_s: 600, expires_at: null });
  // A time in the past is for the service to refuse.
  expect(bodyOf(chosen, zone().shape, 2000)).toMatchObject({ ttl_s: null, expires_at: 1000 });
});

test("of two operators' changes each field begins with the value of the one who changed it", () => {
  const [base, mine, theirs] = [zone(), zone({ reason: "ice" }), zone({ kind: "PENALTY", factor: 4 })].map(fieldsOf);
  if (!base || !mine || !theirs) throw new Error("three versions");
  const choices = suggested(base, mine, theirs);
  expect([...choices]).toEqual([["kind", "theirs"], ["factor", "theirs"], ["reason", "mine"]]);
  expect(merged(mine, theirs, choices)).toMatchObject({ reason: "ice", kind: "PENALTY", factor: 4 });
  expect(suggested(base, fieldsOf(zone({ reason: "ice" })), fieldsOf(zone({ reason: "paint" }))).get("reason")).toBe("mine");
});

test("until six is today's six, or tomorrow's once it is over", () => {
  const noon = new Date(2026, 5, 1, 12).getTime() / 1000;
  expect(nextHour(18, noon) - noon).toBe(6 * 3600);
  expect(nextHour(12, noon) - noon).toBe(24 * 3600);
});

test("the state of a zone says why it is not in force, and when it soon is over", () => {
  const state = (active: boolean, more: Partial<Zone> = {}): string => stateOf({ ...zone(more), active }, 1000);
  expect([state(true), state(true, { expires_at: 1500 }), state(true, { expires_at: 9000 })]).toEqual(["active", "expiring", "active"]);
  expect([state(false, { enabled: false }), state(false, { starts_at: 2000 }), state(false, { expires_at: 900 }), state(false)])
    .toEqual(["off", "toCome", "over", "resting"]);
});
