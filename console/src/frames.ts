// Spreads drawing over frames: what moves is drawn in each frame, everything else one kind a frame, in turn. So a frame
// costs what moves and the dearest kind, and never the sum of all kinds; each comes about as soon.

/** Kinds of drawing that take turns: lines and marks of the map, its cells, the panels beside it. */
const KINDS = ["marks", "cells", "panels"] as const;
export type DrawingKind = (typeof KINDS)[number];

const moving = new Set<() => void>();
const others: Record<DrawingKind, Set<() => void>> = { marks: new Set(), cells: new Set(), panels: new Set() };
let pending = 0;
let turn = 0;

/** Call `draw` in the next frame, once however often this is asked for until then. */
export function drawMoving(draw: () => void): void {
  moving.add(draw);
  request();
}

/** Call `draw` in one of the next frames, once however often this is asked for until then. */
export function drawInTurn(kind: DrawingKind, draw: () => void): void {
  others[kind].add(draw);
  request();
}

/** Forget what was to be drawn. */
export function forgetDrawing(draw: () => void): void {
  moving.delete(draw);
  for (const kind of KINDS) others[kind].delete(draw);
}

function request(): void {
  if (pending === 0) pending = requestAnimationFrame(frame);
}

function frame(): void {
  pending = 0;
  run(moving);
  for (let looked = 0; looked < KINDS.length; looked++) {
    const kind = KINDS[turn++ % KINDS.length];
    if (kind !== undefined && run(others[kind])) break;
  }
  if (KINDS.some((kind) => others[kind].size > 0)) request();
}

function run(due: Set<() => void>): boolean {
  const draws = [...due];
  due.clear();
  for (const draw of draws) draw();
  return draws.length > 0;
}
