// Shapes of zones as outlines, in metres.
import type { Point, Shape } from "../api/types";

const ROUND_STEPS = 8;

/** Return points of an arc around `centre`, from the direction `from` counter-clockwise by `sweep` (rad). */
function arc(centre: Point, radius: number, from: number, sweep: number, steps: number): Point[] {
  return Array.from({ length: steps + 1 }, (_, i) => {
    const angle = from + (sweep * i) / steps;
    return [centre[0] + radius * Math.cos(angle), centre[1] + radius * Math.sin(angle)] as const;
  });
}

/** Return the outline of all that is within half a width of a line, with round ends. */
export function corridorOutline(line: readonly Point[], width: number): Point[] {
  const side = (points: readonly Point[]): Point[] => {
    const found: Point[] = [];
    for (let i = 0; i + 1 < points.length; i++) {
      const [a, b] = [points[i], points[i + 1]];
      if (!a || !b || (a[0] === b[0] && a[1] === b[1])) continue;
      const right = Math.atan2(b[1] - a[1], b[0] - a[0]) - Math.PI / 2;
      const offset: Point = [(width / 2) * Math.cos(right), (width / 2) * Math.sin(right)];
      found.push([a[0] + offset[0], a[1] + offset[1]], [b[0] + offset[0], b[1] + offset[1]]);
      if (i + 2 === points.length) found.push(...arc(b, width / 2, right, Math.PI, ROUND_STEPS));
    }
    return found;
  };
  return [...side(line), ...side([...line].reverse())];
}

/** Half of a sonar's beam (rad), as in `fog_contracts.cones`: the HC-SR04's is 15 degrees wide. */
const BEAM_HALF_ANGLE = Math.PI / 24;

/** Return the outline of what a sonar sees that looks from `at` into a direction (rad), up to its range (m). */
export function beam(at: Point, direction: number, range: number): Point[] {
  return [at, ...arc(at, range, direction - BEAM_HALF_ANGLE, 2 * BEAM_HALF_ANGLE, 4)];
}

/** Return the corners of a shape's outline. */
export function outline(shape: Shape): Point[] {
  switch (shape.type) {
    case "polygon":
      return shape.points.map(toPoint);
    case "rectangle": {
      const [[left, bottom], [right, top]] = [toPoint(shape.corner), toPoint(shape.opposite)];
      return [[left, bottom], [right, bottom], [right, top], [left, top]];
    }
    case "circle":
      return arc(toPoint(shape.centre), shape.radius, 0, 2 * Math.PI, 48).slice(1);
    case "corridor":
      return corridorOutline(shape.line.map(toPoint), shape.width);
  }
}

/** Return the shape moved by (dx, dy). */
export function moved(shape: Shape, dx: number, dy: number): Shape {
  const shift = (point: readonly unknown[]): [number, number] => {
    const [x, y] = toPoint(point);
    return [x + dx, y + dy];
  };
  switch (shape.type) {
    case "polygon":
      return { ...shape, points: shape.points.map(shift) };
    case "rectangle":
      return { ...shape, corner: shift(shape.corner), opposite: shift(shape.opposite) };
    case "circle":
      return { ...shape, centre: shift(shape.centre) };
    case "corridor":
      return { ...shape, line: shape.line.map(shift) };
  }
}

/** Read a point of a message: OpenAPI knows pairs only as lists. */
export function toPoint(pair: readonly unknown[]): Point {
  return [Number(pair[0]), Number(pair[1])];
}

/** Return the part of a path's corners that is `length` metres long, from its beginning. */
export function firstMetres(points: readonly Point[], length: number): Point[] {
  const found: Point[] = [];
  let rest = length;
  for (let i = 0; i < points.length; i++) {
    const point = points[i];
    const before = points[i - 1];
    if (!point) break;
    const step = before ? Math.hypot(point[0] - before[0], point[1] - before[1]) : 0;
    if (before && step > rest) {
      const share = rest / step;
      found.push([before[0] + share * (point[0] - before[0]), before[1] + share * (point[1] - before[1])]);
      break;
    }
    found.push(point);
    rest -= step;
  }
  return found;
}

/** Return the smallest box around points: left, bottom, right, top. */
export function box(points: readonly Point[]): [number, number, number, number] {
  const xs = points.map(([x]) => x);
  const ys = points.map(([, y]) => y);
  return [Math.min(...xs), Math.min(...ys), Math.max(...xs), Math.max(...ys)];
}
