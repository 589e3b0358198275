// Drawing and changing shapes, in metres: what clicks, drags, keys and typed numbers do to them.
import type { Point, Shape } from "../api/types";
import { box, moved, outline } from "../map/geometry";

export type ShapeType = Shape["type"];
export const SHAPE_TYPES: readonly ShapeType[] = ["rectangle", "polygon", "circle", "corridor"];

/** Stands for the whole shape where a number stands for one of its points. */
export const WHOLE = -1;

/** Of a new corridor: as usual corridors are wide. A strip that leaves a gap beside it closes nothing. */
const DEFAULT_WIDTH = 3;
const DEFAULT_SIZE = 2;
const LEAST_SIZE = 0.1;
const FEWEST: Readonly<Record<ShapeType, number>> = { rectangle: 2, polygon: 3, circle: 2, corridor: 2 };

type Pair = [number, number];

/** Round to whole centimetres: nobody places a zone more exactly, and numbers stay readable. */
export function rounded([x, y]: Point): Pair {
  // Adding 0 makes 0 of -0.
  return [Math.round(x * 100) / 100 + 0, Math.round(y * 100) / 100 + 0];
}

/** Return a shape's points that can be moved one by one: corners, or centre and a point of the edge of a circle. */
export function shapePoints(shape: Shape): Point[] {
  switch (shape.type) {
    case "rectangle":
    case "polygon":
      return outline(shape);
    case "circle":
      return [shape.centre, [shape.centre[0] + shape.radius, shape.centre[1]]];
    case "corridor":
      return shape.line;
  }
}

/** Return the shape with one of its points elsewhere; `WHOLE` moves all of it by its middle. */
export function withPoint(shape: Shape, index: number, to: Point): Shape {
  const target = rounded(to);
  if (index === WHOLE) {
    const [x, y] = middle(shape);
    return movedBy(shape, target[0] - x, target[1] - y);
  }
  switch (shape.type) {
    case "rectangle": {
      // The opposite corner stays; a rectangle without area would be refused.
      const fixed = outline(shape)[(index + 2) % 4] ?? shape.opposite;
      const away = (value: number, from: number): number =>
        Math.abs(value - from) >= LEAST_SIZE ? value : from + (value < from ? -LEAST_SIZE : LEAST_SIZE);
      return rectangle([away(target[0], fixed[0]), away(target[1], fixed[1])], fixed);
    }
    case "polygon":
      return { ...shape, points: shape.points.map((point, i) => (i === index ? target : point)) };
    case "circle":
      return index === 0 ? { ...shape, centre: target } : { ...shape, radius: radiusTo(shape.centre, target) };
    case "corridor":
      return { ...shape, line: shape.line.map((point, i) => (i === index ? target : point)) };
  }
}

/** Return the shape with a point moved by (dx, dy). */
export function nudged(shape: Shape, index: number, dx: number, dy: number): Shape {
  if (index === WHOLE) return movedBy(shape, dx, dy);
  const at = shapePoints(shape)[index];
  if (!at) return shape;
  // A circle's edge has no direction of its own: to the right or up is larger, whichever point is shown.
  return withPoint(shape, index, shape.type === "circle" && index === 1 ? [at[0] + dx + dy, at[1]] : [at[0] + dx, at[1] + dy]);
}

/** Whether corners can be added and taken away. */
export function hasCorners(shape: Shape): boolean {
  return shape.type === "polygon" || shape.type === "corridor";
}

/** Return the places where a corner can be put in, by the corner before. */
export function gaps(shape: Shape): Point[] {
  if (!hasCorners(shape)) return [];
  const points = shapePoints(shape);
  const ends = shape.type === "polygon" ? points.length : points.length - 1;
  return points.slice(0, ends).map((a, i) => {
    const b = points[(i + 1) % points.length] ?? a;
    return rounded([(a[0] + b[0]) / 2, (a[1] + b[1]) / 2]);
  });
}

/** Return the shape with a corner more behind this one; without a place half-way to the next, or as far beyond the end. */
export function withCornerAfter(shape: Shape, index: number, at?: Point): Shape {
  const points = shapePoints(shape);
  const gap = gaps(shape)[index];
  const [before, last] = [points[index - 1], points[index]];
  if (!hasCorners(shape) || !last) return shape;
  const beyond: Point = before ? [2 * last[0] - before[0], 2 * last[1] - before[1]] : [last[0] + 1, last[1]];
  return withPoints(shape, [...points.slice(0, index + 1), rounded(at ?? gap ?? beyond), ...points.slice(index + 1)]);
}

/** Return the shape without a corner, the same one if it needs it. */
export function withoutCorner(shape: Shape, index: number): Shape {
  const points = shapePoints(shape);
  if (!hasCorners(shape) || points.length <= FEWEST[shape.type] || !points[index]) return shape;
  return withPoints(shape, points.filter((_, i) => i !== index));
}

/** Return the middle of the box around a shape. */
export function middle(shape: Shape): Point {
  const [left, bottom, right, top] = box(shape.type === "circle" ? [shape.centre] : shapePoints(shape));
  return rounded([(left + right) / 2, (bottom + top) / 2]);
}

export interface Sketch {
  /** Clicks that make no shape yet. */
  readonly points: readonly Point[];
  readonly shape: Shape | null;
  /** Whether another click adds to the shape. */
  readonly more: boolean;
}

/** Return what is drawn after one more click: a shape as soon as there are enough points. */
export function sketched(type: ShapeType, sketch: Sketch, click: Point): Sketch {
  const at = rounded(click);
  if (sketch.shape && hasCorners(sketch.shape)) {
    const points = shapePoints(sketch.shape);
    return { points: [], shape: withPoints(sketch.shape, [...points, at]), more: true };
  }
  const last = sketch.points.at(-1);
  // A double click is one point.
  if (last && Math.hypot(last[0] - at[0], last[1] - at[1]) < LEAST_SIZE) return sketch;
  const points = [...sketch.points, at];
  const shape = shapeOf(type, points);
  return { points: shape ? [] : points, shape, more: shape === null || hasCorners(shape) };
}

/** Return the shape that some points make, null if they are too few. */
export function shapeOf(type: ShapeType, points: readonly Point[]): Shape | null {
  const [a, b] = points;
  if (points.length < FEWEST[type] || !a || !b) return null;
  switch (type) {
    case "rectangle":
      return a[0] === b[0] || a[1] === b[1] ? null : rectangle(b, a);
    case "circle":
      return { type, centre: rounded(a), radius: radiusTo(a, b) };
    case "polygon":
      return { type, points: points.map(rounded) };
    case "corridor":
      return { type, line: points.map(rounded), width: DEFAULT_WIDTH };
  }
}

/** Return a shape of usual size around a point: to begin without clicks. */
export function shapeAt(type: ShapeType, [x, y]: Point, size = DEFAULT_SIZE): Shape {
  const half = size / 2;
  const corners: Point[] = [[x - half, y - half], [x + half, y - half], [x + half, y + half], [x - half, y + half]];
  switch (type) {
    case "rectangle":
      return rectangle([x + half, y + half], [x - half, y - half]);
    case "polygon":
      return { type, points: corners.map(rounded) };
    case "circle":
      return { type, centre: rounded([x, y]), radius: half };
    case "corridor":
      return { type, line: [rounded([x - size, y]), rounded([x + size, y])], width: DEFAULT_WIDTH };
  }
}

function rectangle(one: Point, other: Point): Shape {
  const [a, b] = [rounded(one), rounded(other)];
  return {
    type: "rectangle",
    corner: [Math.min(a[0], b[0]), Math.min(a[1], b[1])],
    opposite: [Math.max(a[0], b[0]), Math.max(a[1], b[1])],
  };
}

function movedBy(shape: Shape, dx: number, dy: number): Shape {
  const there = moved(shape, dx, dy);
  switch (there.type) {
    case "rectangle":
      return { ...there, corner: rounded(there.corner), opposite: rounded(there.opposite) };
    case "circle":
      return { ...there, centre: rounded(there.centre) };
    case "polygon":
    case "corridor":
      return withPoints(there, shapePoints(there));
  }
}

function withPoints(shape: Shape, points: readonly Point[]): Shape {
  if (shape.type === "polygon") return { ...shape, points: points.map(rounded) };
  return shape.type === "corridor" ? { ...shape, line: points.map(rounded) } : shape;
}

function radiusTo(centre: Point, edge: Point): number {
  return Math.max(LEAST_SIZE, Math.round(Math.hypot(edge[0] - centre[0], edge[1] - centre[1]) * 100) / 100);
}
