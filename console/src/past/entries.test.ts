import { expect, test, vi } from "vitest";
import { Problem } from "../api/client";
import type { PeriodView, TimelineEntry } from "../api/types";
import { piecesOf } from "../sensors/history";
import { stagesOf } from "../sensors/latency";
import { saidProblem } from "../i18n/codes";
import { setLanguage } from "../i18n/i18n";
import { detailText, undoable } from "./entries";

const entry = (kind: string, id: string, action: string, name: string): TimelineEntry =>
  ({ at: 0, kind, id, action, who: "ana", text: "", codes: [], decided_by: null, overridden: false, entry: name, before: null, after: null });

test("only the latest change of a record that somebody decided can be undone", () => {
  const found = undoable([
    entry("mission", "r1", "reached", "9-0.mission"), entry("zone", "wet", "replace", "8-0.zone"), entry("override", "hall", "override", "7-0.override"),
    entry("zone", "wet", "create", "6-0.zone"), entry("mission", "r1", "goal", "5-0.mission"), entry("robot", "r1", "enable", "4-0.robot"),
    entry("hazard", "hall", "blocked", ""),
  ]);
  expect([...found]).toEqual([["8-0.zone", "zones"], ["7-0.override", "areas"]]);
});

test("what programs tell by an identifier is said in the user's language, and all else as they say it", () => {
  const echo = { ...entry("hazard", "hall", "blocked", ""), text: "node n1: an echo at 0.86 m", codes: ["something_near"], decided_by: "n1" };
  const fault = { ...entry("fault", "r1", "began", ""), text: "bumper pressed; it hums", codes: ["bumper", "newer_than_the_page"] };
  const stops = { ...entry("stop", "r1", "stop", "1-0.stop"), after: { kind: "disable", repeats: { ana: 2, others: 1 }, period_s: 600 } };
  const sent = [{ place: "lab" }, { place: null, pose: { x: 1, y: 2.04, theta: 0 } }].map((goal) => ({ ...entry("mission", "r1", "goal", "2-0.mission"), after: { goal } }));
  const refused = new Problem(409, "command_refused", "a fault must be reset first", { refusal: "fault_latched", causes: ["bumper"] });
  expect([echo, fault, stops, ...sent, entry("mission", "r1", "cancel", "3-0.mission")].map(detailText)).toEqual(
    [echo.text, fault.text, "3 times more within 10 min: ana 2, others 1", "lab", "1.0, 2.0", ""],
  );
  expect(saidProblem(refused)).toBe("a fault must be reset first");
  vi.stubGlobal("document", { documentElement: {} });
  setLanguage("pt", false);
  expect([echo, fault].map(detailText)).toEqual(["n1: há um eco mais perto do que o limite", fault.text]);
  expect(saidProblem(refused)).toBe("É preciso repor primeiro a avaria: O para-choques está premido");
  setLanguage("en", false);
  vi.unstubAllGlobals();
});

test("a strip of an area's history shows what lies in its time, and nothing more", () => {
  const period = (began: number, ended: number | null): PeriodView =>
    ({ period: { began, state: "clear", penalty: 0, cause: "", overridden: false, code: "", decided_by: null }, ended, lasted_s: 1 });
  const pieces = piecesOf([period(950, null), period(850, 950), period(100, 850), period(10, 90)], 1000, 200);
  expect(pieces.map(({ from, share }) => [from, share])).toEqual([[0.75, 0.25], [0.25, 0.5], [0, 0.25]]);
});

test("a stage of which a stamp is missing has no duration, and neither has the whole", () => {
  const trace = { area: "hall", epoch: 1, seq: 2, first_reading: 10, confirmed: 10.5, costmap_published: 10.75, plan_published: 0, path_received: 0, first_command: 0 };
  expect(stagesOf(trace)).toEqual({ stages: [0.5, 0.25, null, null, null], total: null });
});
