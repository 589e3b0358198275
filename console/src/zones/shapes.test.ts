import { expect, test } from "vitest";
import type { Point, Shape } from "../api/types";
import { box, outline } from "../map/geometry";
import {
  gaps, middle, nudged, SHAPE_TYPES, shapeAt, type ShapeType, shapePoints, type Sketch, sketched, WHOLE, withCornerAfter, withoutCorner,
  withPoint,
} from "./shapes";

const EMPTY: Sketch = { points: [], shape: null, more: true };
const drawn = (type: ShapeType, ...clicks: Point[]): Sketch =>
  clicks.reduce((sketch, click) => (sketch.more ? sketched(type, sketch, click) : sketch), EMPTY);

// Numbers that look random and are the same in each run.
function randomNumbers(seed: number): () => number {
  let state = seed;
  return () => (state = (state * 16807) % 2147483647) / 2147483647;
}

test("clicks make a shape as soon as there are enough, and corners can follow", () => {
  expect(drawn("rectangle", [4, 3], [1, 1])).toEqual({ points: [], shape: { type: "rectangle", corner: [1, 1], opposite: [4, 3] }, more: false });
  expect(drawn("circle", [1, 1], [4, 5]).shape).toEqual({ type: "circle", centre: [1, 1], radius: 5 });
  expect(drawn("polygon", [0, 0], [1, 0])).toEqual({ points: [[0, 0], [1, 0]], shape: null, more: true });
  expect(drawn("polygon", [0, 0], [1, 0], [1, 1], [0, 1]).shape).toEqual({ type: "polygon", points: [[0, 0], [1, 0], [1, 1], [0, 1]] });
  expect(drawn("corridor", [0, 0], [9, 0]).shape).toMatchObject({ line: [[0, 0], [9, 0]] });
});

test("a double click is one corner", () => {
  expect(drawn("rectangle", [1, 1], [1.004, 1]).shape).toBeNull();
});

test("corners move, come and go, but never so many that nothing is left", () => {
  const triangle = shapeAt("polygon", [0, 0]);
  expect(shapePoints(withCornerAfter(triangle, 0))[1]).toEqual(gaps(triangle)[0]);
  const line: Shape = { type: "corridor", line: [[0, 0], [2, 0]], width: 1 };
  expect(shapePoints(withCornerAfter(line, 1))).toEqual([[0, 0], [2, 0], [4, 0]]);
  expect(withoutCorner(line, 0)).toBe(line);
  expect(shapePoints(withoutCorner(triangle, 0))).toHaveLength(3);
});

test("a rectangle's corner moves its two sides, and the opposite corner stays", () => {
  const shape: Shape = { type: "rectangle", corner: [0, 0], opposite: [2, 1] };
  expect(withPoint(shape, 0, [-1, -2])).toEqual({ type: "rectangle", corner: [-1, -2], opposite: [2, 1] });
  expect(withPoint(shape, 0, [5, 3])).toEqual({ type: "rectangle", corner: [2, 1], opposite: [5, 3] });
});

test("whatever is done to a shape, it keeps a size and whole centimetres, and comes back when moved back", () => {
  const random = randomNumbers(7);
  for (let run = 0; run < 100; run++) {
    let shape = shapeAt(SHAPE_TYPES[run % 4] ?? "circle", [random() * 40 - 20, random() * 40]);
    for (let step = 0; step < 12; step++) {
      const index = Math.floor(random() * (shapePoints(shape).length + 1)) - 1;
      const to: Point = [random() * 40, random() * 40];
      const change = Math.floor(random() * 4);
      if (change === 0) shape = withPoint(shape, index, to);
      else if (change === 1) shape = nudged(shape, index, random() - 0.5, random() - 0.5);
      else if (change === 2) shape = withCornerAfter(shape, index);
      else shape = withoutCorner(shape, index);
      const [left, bottom, right, top] = box(outline(shape));
      expect(Math.max(right - left, top - bottom)).toBeGreaterThan(0.09);
      for (const value of shapePoints(shape).flat()) expect(Math.abs(value * 100 - Math.round(value * 100))).toBeLessThan(1e-6);
    }
    const back = nudged(nudged(shape, WHOLE, 3.25, -1.5), WHOLE, -3.25, 1.5);
    expect(back).toEqual(shape.type === "rectangle" ? withPoint(shape, WHOLE, middle(shape)) : shape);
  }
});
