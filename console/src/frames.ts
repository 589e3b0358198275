// Spreads drawing over frames: one kind a frame, what moves every other time at least, while the others take turns. So a
// frame costs what the dearest kind costs, and never the sum of all; each comes about as soon.

/** Kinds of drawing that take turns: lines and marks of the map, its cells, the panels beside it. */
const KINDS = ["marks", "cells", "panels"] as const;
export type DrawingKind = (typeof KINDS)[number];

const moving = new Set<() => void>();
const waiting: Record<DrawingKind, Set<() => void>> = { marks: new Set(), cells: new Set(), panels: new Set() };
let pending = 0;
let turn = 0;
let moved = false;

/** Call `draw` in the next frame, once however often this is asked for until then. */
export function drawMoving(draw: () => void): void {
  moving.add(draw);
  request();
}

/** Call `draw` in one of the next frames, once however often this is asked for until then. */
export function drawInTurn(kind: DrawingKind, draw: () => void): void {
  waiting[kind].add(draw);
  request();
}

/** Forget what was to be drawn. */
export function forgetDrawing(draw: () => void): void {
  moving.delete(draw);
  for (const kind of KINDS) waiting[kind].delete(draw);
}

function request(): void {
  if (pending === 0) pending = requestAnimationFrame(frame);
}

function frame(): void {
  pending = 0;
  const others = moved && runOther();
  moved = !others && run(moving);
  if (!others && !moved) runOther();
  if (moving.size > 0 || KINDS.some((kind) => waiting[kind].size > 0)) request();
}

function runOther(): boolean {
  for (let looked = 0; looked < KINDS.length; looked++) {
    const kind = KINDS[turn++ % KINDS.length];
    if (kind !== undefined && run(waiting[kind])) return true;
  }
  return false;
}

function run(due: Set<() => void>): boolean {
  const draws = [...due];
  due.clear();
  for (const draw of draws) draw();
  return draws.length > 0;
}
