import { expect, test } from "vitest";
import { parseRoute, routeHash } from "../router";
import { beam, box, firstMetres, moved, outline } from "./geometry";

test("a corridor's outline is half a width away from its line on all sides", () => {
  const [left, bottom, right, top] = box(outline({ type: "corridor", line: [[0, 0], [10, 0]], width: 2 }));
  expect([left, bottom, right, top].map((value) => Math.round(value * 1000) / 1000)).toEqual([-1, -1, 11, 1]);
});

test("a sonar's beam is 15 degrees wide in all", () => {
  const edges = beam([1, 2], 0, 3).slice(1).map(([x, y]) => (Math.atan2(y - 2, x - 1) * 180) / Math.PI);
  expect([Math.min(...edges), Math.max(...edges)].map((angle) => Math.round(angle * 100) / 100)).toEqual([-7.5, 7.5]);
});

test("a shape that is moved keeps its form", () => {
  const circle = moved({ type: "circle", centre: [1, 2], radius: 3 }, 10, -10);
  expect(circle).toEqual({ type: "circle", centre: [11, -8], radius: 3 });
  expect(outline(moved({ type: "rectangle", corner: [0, 0], opposite: [2, 1] }, 1, 1))).toEqual([[1, 1], [3, 1], [3, 2], [1, 2]]);
});

test("the released part of a path ends on the path", () => {
  expect(firstMetres([[0, 0], [4, 0], [4, 4]], 6)).toEqual([[0, 0], [4, 0], [4, 2]]);
  expect(firstMetres([[0, 0], [4, 0]], 100)).toEqual([[0, 0], [4, 0]]);
});

test("an address leads to its view and what is chosen there, whatever its name", () => {
  for (const name of ["r1", "a/b", "<script>", "água 100%"]) {
    expect(parseRoute(routeHash("zones", name))).toEqual({ view: "zones", chosen: name });
  }
  expect(parseRoute("#/nowhere/%zz")).toEqual({ view: "map", chosen: "%zz" });
});
