import { expect, test } from "vitest";
import { Live } from "./live";
import { EventParser, waitBefore } from "./stream";

const stream = [
  "event: hello\nid: run:1\ndata: {\"run\":\"a\",\"fresh\":true,\"site\":\"estig\"}\n\n",
  ": comment\r\nevent: zone\r\nid: run:2\r\ndata: {\"id\":\"wet\",\r\ndata: \"value\":null}\r\n\r\n",
  "event: time\ndata: {\"stamp\":1}\n\n",
].join("");

test("events are the same, wherever the network cuts the stream", () => {
  const whole = new EventParser().push(stream);
  expect(whole.map(({ event, id }) => [event, id])).toEqual([["hello", "run:1"], ["zone", "run:2"], ["time", null]]);
  expect(JSON.parse(whole[1]?.data ?? "")).toEqual({ id: "wet", value: null });
  for (let cut = 1; cut < stream.length; cut++) {
    const parser = new EventParser();
    expect([...parser.push(stream.slice(0, cut)), ...parser.push(stream.slice(cut))]).toEqual(whole);
  }
});

test("tries to connect come less and less often, and never further apart than five seconds", () => {
  expect(waitBefore(0, 1)).toBeLessThanOrEqual(500);
  expect(waitBefore(50, 1)).toBeLessThanOrEqual(5_000);
  expect(waitBefore(3, 0)).toBeGreaterThan(waitBefore(0, 0));
});

const say = (live: Live, event: string, data: unknown): void =>
  live.take({ event, data: JSON.stringify(data), id: null });

test("a fresh stream replaces all that was known, a resumed one adds to it", () => {
  const live = new Live("", () => 0);
  say(live, "hello", { run: "a", fresh: true, site: "estig" });
  say(live, "zone", { id: "wet", value: { id: "wet" } });
  say(live, "hello", { run: "a", fresh: false, site: "estig" });
  expect([...live.of.zone.keys()]).toEqual(["wet"]);
  say(live, "zone", { id: "wet", value: null });
  expect(live.of.zone.size).toBe(0);
  say(live, "zone", { id: "dry", value: { id: "dry" } });
  say(live, "hello", { run: "b", fresh: true, site: "estig" });
  expect(live.of.zone.size).toBe(0);
});

test("a robot of which nothing came for two seconds is old, and so is everything once the server is silent", () => {
  let now = 0;
  const live = new Live("", () => now);
  say(live, "hello", { run: "a", fresh: true, site: "estig" });
  say(live, "ready", {});
  say(live, "pose", { id: "r1", value: {} });
  expect(live.oldRobot("r1")).toBe(false);
  now = 2_500;
  say(live, "time", { stamp: 2.5 });
  expect([live.old, live.oldRobot("r1")]).toEqual([false, true]);
  say(live, "pose", { id: "r1", value: {} });
  expect(live.oldRobot("r1")).toBe(false);
  now = 5_000;
  expect([live.old, live.oldRobot("r1")]).toEqual([true, true]);
});

test("only what a robot says itself, while this page listens, is a sign of its life", () => {
  let now = 0;
  const live = new Live("", () => now);
  const robot = (clock: number, goal: string | null): void => say(live, "robot", { id: "r1", value: { state: { clock }, goal } });
  say(live, "hello", { run: "a", fresh: true, site: "estig" });
  robot(1, null);
  say(live, "pose", { id: "r1", value: {} });
  expect(live.robotAge("r1")).toBe(Infinity);
  say(live, "ready", {});
  now = 1_000;
  robot(1, "a goal of the planner");
  expect(live.robotAge("r1")).toBe(Infinity);
  robot(2, null);
  expect(live.robotAge("r1")).toBe(0);
  now = 5_000;
  robot(2, "another");
  expect([live.robotAge("r1"), live.oldRobot("r1")]).toEqual([4_000, true]);
  say(live, "vitals", { id: "r1", value: {} });
  expect(live.oldRobot("r1")).toBe(false);
  // What comes first after a broken connection was said at any time since.
  now = 9_000;
  say(live, "hello", { run: "a", fresh: false, site: "estig" });
  say(live, "pose", { id: "r1", value: {} });
  expect(live.robotAge("r1")).toBe(4_000);
});

test("a robot is stopped when it was heard just now, is not enabled, and does not move all the same", () => {
  let now = 0;
  const live = new Live("", () => now);
  const stopped = (mode: string, enabled: boolean): boolean => {
    say(live, "robot", { id: "r1", value: { id: "r1", state: { mode, enabled } } });
    return live.isStopped("r1");
  };
  expect(live.isStopped("r1")).toBe(false);
  say(live, "ready", {});
  expect(["HOLD", "PROTECTIVE_STOP", "FAULT"].map((mode) => stopped(mode, false))).toEqual([true, true, true]);
  expect(["EGRESS", "DOCK", "TELEOP"].map((mode) => stopped(mode, false))).toEqual([false, false, false]);
  expect(stopped("HOLD", true)).toBe(false);
  expect(stopped("HOLD", false)).toBe(true);
  now = 2_500;
  expect(live.isStopped("r1")).toBe(false);
});

test("an event that only a newer server knows is passed over", () => {
  const live = new Live("", () => 0);
  expect(() => say(live, "weather", { sun: true })).not.toThrow();
});
