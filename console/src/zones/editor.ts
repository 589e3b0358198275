// The zone that is being edited: one at a time, kept while the user looks at other views; form and map show and change it.
import type { Point, Shape, Zone } from "../api/types";
import { type Draft, draftOf, type Fields } from "./draft";
import { hasCorners, nudged, shapePoints, type ShapeType, sketched, WHOLE, withCornerAfter, withoutCorner, withPoint } from "./shapes";

/** What a click on the map does. */
export type ClickMode = "add" | "move" | "none";

const STEPS_MAX = 200;

export class Editor {
  draft: Draft | null = null;
  /** Clicks that make no shape yet. */
  sketch: readonly Point[] = [];
  /** The point that buttons and arrow keys move; `WHOLE` for the shape. */
  selected = WHOLE;
  mode: ClickMode = "none";
  /** How far (m) one press of an arrow moves. */
  step = 0.25;
  /** Another operator's version of the zone, to be compared; undefined: there is none, null: the zone is gone. */
  theirs: Zone | null | undefined = undefined;
  private past: Draft[] = [];
  private readonly listeners = new Set<() => void>();

  on(listener: () => void): () => void {
    this.listeners.add(listener);
    return () => void this.listeners.delete(listener);
  }

  get shape(): Shape | null {
    return this.draft?.fields.shape ?? null;
  }

  get canUndo(): boolean {
    return this.past.length > 0 || this.sketch.length > 0;
  }

  start(draft: Draft): void {
    this.draft = draft;
    this.sketch = [];
    this.past = [];
    this.selected = WHOLE;
    this.theirs = undefined;
    this.mode = draft.fields.shape === null ? "add" : "none";
    this.tell();
  }

  end(): void {
    this.draft = null;
    this.sketch = [];
    this.past = [];
    this.theirs = undefined;
    this.mode = "none";
    this.tell();
  }

  /** Change fields; `fluent` joins the change to the last one, as while something is dragged. */
  set(change: Partial<Fields>, fluent = false): void {
    if (!this.draft) return;
    if (!fluent) this.past = [...this.past, this.draft].slice(-STEPS_MAX);
    this.draft = { ...this.draft, fields: { ...this.draft.fields, ...change } };
    this.tell();
  }

  rename(id: string): void {
    if (!this.draft) return;
    this.draft = { ...this.draft, id };
    this.tell();
  }

  /** Begin to draw another kind of shape. */
  redraw(type: ShapeType): void {
    if (!this.draft) return;
    this.past = [...this.past, this.draft].slice(-STEPS_MAX);
    this.draft = { ...this.draft, type, fields: { ...this.draft.fields, shape: null } };
    this.sketch = [];
    this.selected = WHOLE;
    this.mode = "add";
    this.tell();
  }

  /** Take back the last step. */
  undo(): void {
    if (this.sketch.length > 0) this.sketch = this.sketch.slice(0, -1);
    else {
      const before = this.past.pop();
      if (!before) return;
      this.draft = before;
      if (before.fields.shape === null) this.mode = "add";
    }
    this.select(this.selected);
  }

  setMode(mode: ClickMode): void {
    this.mode = mode;
    this.tell();
  }

  select(index: number): void {
    this.selected = this.shape && index < shapePoints(this.shape).length ? index : WHOLE;
    this.tell();
  }

  /** A click on the floor, or Enter with the map's middle. */
  click(at: Point): void {
    const { draft, shape } = this;
    if (!draft) return;
    if (this.mode === "move" && shape) this.movePoint(this.selected, at);
    if (this.mode !== "add") return;
    const next = sketched(draft.type, { points: this.sketch, shape, more: true }, at);
    this.sketch = next.points;
    if (!next.more) this.mode = "none";
    if (next.shape !== shape) {
      this.set({ shape: next.shape });
      this.select(next.shape && hasCorners(next.shape) ? shapePoints(next.shape).length - 1 : WHOLE);
    } else this.tell();
  }

  /** Put a shape there without clicks. */
  place(shape: Shape): void {
    this.sketch = [];
    this.mode = "none";
    this.set({ shape });
  }

  movePoint(index: number, to: Point, fluent = false): void {
    if (this.shape) this.set({ shape: withPoint(this.shape, index, to) }, fluent);
  }

  /** Move the selected point, or all, by whole steps. */
  nudge(index: number, right: number, up: number): void {
    if (this.shape) this.set({ shape: nudged(this.shape, index, right * this.step, up * this.step) });
  }

  addCorner(after: number, at?: Point): void {
    if (!this.shape) return;
    this.set({ shape: withCornerAfter(this.shape, after, at) });
    this.select(after + 1);
  }

  removeCorner(index: number): void {
    if (!this.shape) return;
    const without = withoutCorner(this.shape, index);
    if (without === this.shape) return;
    this.set({ shape: without });
    this.select(Math.max(0, index - 1));
  }

  compare(theirs: Zone | null): void {
    this.theirs = theirs;
    this.tell();
  }

  /** Go on from another operator's version, with these fields. */
  rebase(theirs: Zone | null, fields: Fields): void {
    if (!this.draft) return;
    this.theirs = undefined;
    const base = theirs ? draftOf(theirs) : { ...this.draft, base: null };
    this.draft = { ...base, type: fields.shape?.type ?? base.type, fields };
    this.select(this.selected);
  }

  private tell(): void {
    for (const listener of [...this.listeners]) listener();
  }
}

/** One draft for the whole console. */
export const editor = new Editor();
