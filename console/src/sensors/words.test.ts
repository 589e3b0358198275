import { expect, test } from "vitest";
import type { AreaState, AreaView } from "../api/types";
import { areaText, shownState } from "./words";

const definition: AreaView["definition"] = { id: "hall", label: "", polygon: [], nodes: [] } as never;

function areaOf(state: AreaState, shown?: AreaView["on_map"]): AreaView {
  const hazard = { area: "hall", state, severity: 0, penalty: 0, since: 1, seq: 1, epoch: 1, cause: "echo", free: [] } as never;
  return { definition, hazard, withheld: false, override: null, seen_share: 0.38, ...(shown === undefined ? {} : { on_map: shown }) };
}

const shownAs = (area: AreaView): readonly [AreaState, boolean] => [shownState(area), areaText(area).includes("not confirmed")];

test("an area is clear only while the map shows and confirms that it is", () => {
  expect(shownAs(areaOf("clear", { state: "clear", penalty: 0, confirmed: true }))).toEqual(["clear", false]);
  for (const shown of [
    null,
    { state: "clear", penalty: 0, confirmed: false },
    { state: "unknown", penalty: 90, confirmed: true },
    { state: "blocked", penalty: 254, confirmed: true },
  ] as const) expect(shownAs(areaOf("clear", shown)), JSON.stringify(shown)).toEqual(["unknown", true]);
});

test("what keeps robots out is shown at once, and an older server's word counts", () => {
  for (const state of ["blocked", "unknown"] as const) expect(shownAs(areaOf(state, null))).toEqual([state, false]);
  expect(shownAs(areaOf("clear"))).toEqual(["clear", false]);
});

test("a clear area says on how much of it its sensors would notice something", () => {
  expect(areaText(areaOf("clear"))).toMatch(/, sensors see 38 % of it$/);
  expect(areaText(areaOf("blocked"))).not.toContain("%");
  expect(areaText({ ...areaOf("clear"), seen_share: null })).not.toContain("%");
});
