import { expect, test } from "vitest";
import type { PeriodView, TimelineEntry } from "../api/types";
import { piecesOf } from "../sensors/history";
import { stagesOf } from "../sensors/latency";
import { undoable } from "./entries";

const entry = (kind: string, id: string, action: string, name: string): TimelineEntry =>
  ({ at: 0, kind, id, action, who: "ana", text: "", entry: name, before: null, after: null });

test("only the latest change of a record that somebody decided can be undone", () => {
  const found = undoable([
    entry("mission", "r1", "reached", "9-0.mission"), entry("zone", "wet", "replace", "8-0.zone"), entry("override", "hall", "override", "7-0.override"),
    entry("zone", "wet", "create", "6-0.zone"), entry("mission", "r1", "goal", "5-0.mission"), entry("robot", "r1", "enable", "4-0.robot"),
    entry("hazard", "hall", "blocked", ""),
  ]);
  expect([...found]).toEqual([["8-0.zone", "zones"], ["7-0.override", "areas"]]);
});

test("a strip of an area's history shows what lies in its time, and nothing more", () => {
  const period = (began: number, ended: number | null): PeriodView =>
    ({ period: { began, state: "clear", penalty: 0, cause: "", overridden: false }, ended, lasted_s: 1 });
  const pieces = piecesOf([period(950, null), period(850, 950), period(100, 850), period(10, 90)], 1000, 200);
  expect(pieces.map(({ from, share }) => [from, share])).toEqual([[0.75, 0.25], [0.25, 0.5], [0, 0.25]]);
});

test("a stage of which a stamp is missing has no duration, and neither has the whole", () => {
  const trace = { area: "hall", epoch: 1, seq: 2, first_reading: 10, confirmed: 10.5, costmap_published: 10.75, plan_published: 0, path_received: 0, first_command: 0 };
  expect(stagesOf(trace)).toEqual({ stages: [0.5, 0.25, null, null, null], total: null });
});
