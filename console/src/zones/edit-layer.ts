// The draft on the map: its shape, and handles to take hold of by mouse, touch and keys.
import L from "leaflet";
import type { Point, Shape } from "../api/types";
import { t } from "../i18n/i18n";
import type { Floor } from "../map/floor";
import { box, outline } from "../map/geometry";
import type { Editor } from "./editor";
import { gaps, hasCorners, middle, shapeOf, shapePoints, WHOLE } from "./shapes";

const toLatLng = ([x, y]: Point): L.LatLngTuple => [y, x];
const toPoint = (at: L.LatLng): Point => [at.lng, at.lat];
/** Between two corners that are nearer on the screen (px) there is no handle to put in another. */
const GAP_PX = 90;
const ARROWS: Readonly<Record<string, Point>> = {
  ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, 1], ArrowDown: [0, -1],
};

export class EditLayer {
  private readonly shapes = L.layerGroup();
  private readonly rubber = L.layerGroup();
  /** By what they are for: `point 2`, `gap 0`, `whole`. */
  private readonly handles = new Map<string, L.Marker>();
  private readonly stops: (() => void)[] = [];
  private dragged = "";
  /** How far the handle of the whole is from the shape's middle while it is dragged. */
  private grip: Point = [0, 0];
  private readonly size = matchMedia("(pointer: coarse)").matches ? 44 : 24;
  private readonly map: L.Map;

  constructor(private readonly floor: Floor, private readonly editor: Editor) {
    this.map = floor.map;
    this.shapes.addTo(this.map);
    this.rubber.addTo(this.map);
    const draw = (): void => this.draw();
    const follow = (event: L.LeafletMouseEvent): void => this.stretch(toPoint(event.latlng));
    const pressed = (event: KeyboardEvent): void => {
      if (event.key !== "Enter" || event.target !== floor.element || editor.mode === "none") return;
      event.preventDefault();
      editor.click(this.centre());
    };
    this.map.on("zoomend", draw).on("mousemove", follow);
    floor.element.addEventListener("keydown", pressed);
    this.stops.push(
      editor.on(draw),
      () => this.map.off("zoomend", draw).off("mousemove", follow),
      () => floor.element.removeEventListener("keydown", pressed),
    );
    this.draw();
  }

  remove(): void {
    for (const stop of this.stops) stop();
    this.shapes.remove();
    this.rubber.remove();
    for (const handle of this.handles.values()) handle.remove();
    this.floor.setPick(null);
    this.floor.fixed.hideZones(new Set());
    this.floor.element.classList.remove("aiming");
  }

  /** The middle of what the map shows, where its crosshair is. */
  centre(): Point {
    return toPoint(this.map.getCenter());
  }

  private draw(): void {
    const { draft, shape, sketch, theirs, mode } = this.editor;
    this.floor.setPick(draft && mode !== "none" ? (at) => this.editor.click(at) : null);
    this.floor.element.classList.toggle("aiming", draft !== null && mode !== "none");
    const base = draft?.base?.id;
    this.floor.fixed.hideZones(new Set(base === undefined ? [] : [base]));
    this.shapes.clearLayers();
    this.rubber.clearLayers();
    if (theirs) this.outlined(theirs.shape, "theirs");
    if (draft && shape) this.outlined(shape, `draft ${draft.fields.kind.toLowerCase()}`);
    if (sketch.length > 0) this.line(sketch);
    this.drawHandles(draft === null ? null : shape);
  }

  private outlined(shape: Shape, kind: string): void {
    const points = outline(shape).map(toLatLng);
    L.polygon(points, { className: `halo ${kind}`, interactive: false }).addTo(this.shapes);
    L.polygon(points, { className: `shape zone ${kind}`, interactive: false }).addTo(this.shapes);
  }

  private line(points: readonly Point[]): void {
    for (const kind of ["halo", "sketch"]) {
      L.polyline(points.map(toLatLng), { className: kind, interactive: false }).addTo(this.shapes);
      for (const at of points) L.circleMarker(toLatLng(at), { radius: 4, className: kind, interactive: false }).addTo(this.shapes);
    }
  }

  /** Show what a click here would make. */
  private stretch(to: Point): void {
    const { draft, sketch, mode } = this.editor;
    this.rubber.clearLayers();
    if (!draft || mode !== "add" || sketch.length === 0) return;
    const shape = shapeOf(draft.type, [...sketch, to]);
    const points = (shape ? outline(shape) : [...sketch, to]).map(toLatLng);
    const options = { className: "rubber", interactive: false };
    (shape ? L.polygon(points, options) : L.polyline(points, options)).addTo(this.rubber);
  }

  /** Return where which handles are. No two cover each other, however small the shape is on the screen. */
  private handlesOf(shape: Shape): Map<string, Point> {
    const wanted = new Map<string, Point>();
    const points = shapePoints(shape);
    const selected = points[this.editor.selected];
    const kept: Point[] = selected ? [selected] : [];
    const free = (at: Point): boolean => kept.every((other) => this.pixels(other, at) >= this.size);
    gaps(shape).forEach((at, i) => {
      const [a, b] = [points[i], points[(i + 1) % points.length]];
      if (a && b && this.pixels(a, b) > GAP_PX) wanted.set(`gap ${i}`, at);
    });
    points.forEach((at, i) => {
      if (at !== selected && !free(at)) return;
      wanted.set(`point ${i}`, at);
      kept.push(at);
    });
    if (shape.type !== "circle") {
      const others = [...wanted.values()];
      const clear = others.every((other) => this.pixels(other, middle(shape)) >= this.size);
      wanted.set("whole", clear ? middle(shape) : this.below(shape));
    }
    return wanted;
  }

  /** Return a point below a shape, away from its handles. */
  private below(shape: Shape): Point {
    const [, bottom] = box(shapePoints(shape));
    const at = this.map.latLngToLayerPoint([bottom, middle(shape)[0]]);
    return toPoint(this.map.layerPointToLatLng(at.add([0, this.size * 1.2])));
  }

  private drawHandles(shape: Shape | null): void {
    const wanted = shape ? this.handlesOf(shape) : new Map<string, Point>();
    if (this.dragged !== "") wanted.set(this.dragged, wanted.get(this.dragged) ?? [0, 0]);
    for (const [name, handle] of this.handles) {
      if (wanted.has(name)) continue;
      const focused = handle.getElement() === document.activeElement;
      handle.remove();
      this.handles.delete(name);
      // Who worked with the keys goes on with the corner before.
      if (focused) this.handles.get(`point ${Math.max(0, this.editor.selected)}`)?.getElement()?.focus();
    }
    for (const [name, at] of wanted) {
      const handle = this.handles.get(name) ?? this.makeHandle(name, at);
      if (name !== this.dragged) handle.setLatLng(toLatLng(at));
      const index = indexOf(name);
      const label = shape ? handleLabel(shape, name, index, at) : "";
      const element = handle.getElement();
      element?.setAttribute("aria-label", label);
      element?.classList.toggle("selected", !name.startsWith("gap") && index === this.editor.selected);
    }
  }

  private makeHandle(name: string, at: Point): L.Marker {
    const kind = name.split(" ")[0] ?? "";
    const handle = L.marker(toLatLng(at), {
      icon: L.divIcon({ className: `handle ${kind}`, iconSize: [this.size, this.size] }),
      draggable: kind !== "gap",
      keyboard: true,
      zIndexOffset: { point: 2000, whole: 1000 }[kind] ?? 0,
    }).addTo(this.map);
    this.handles.set(name, handle);
    const index = indexOf(name);
    handle.on("click", () => (kind === "gap" ? this.editor.addCorner(index) : this.editor.select(index)));
    handle.on("dragstart", () => {
      this.dragged = name;
      const [from, shape] = [toPoint(handle.getLatLng()), this.editor.shape];
      const [x, y] = kind === "whole" && shape ? middle(shape) : from;
      this.grip = [from[0] - x, from[1] - y];
      this.editor.select(index);
      // The whole drag is one step to take back.
      this.editor.set({});
    });
    handle.on("drag", () => {
      const [x, y] = toPoint(handle.getLatLng());
      this.editor.movePoint(index, [x - this.grip[0], y - this.grip[1]], true);
    });
    handle.on("dragend", () => {
      this.dragged = "";
      this.draw();
    });
    const element = handle.getElement();
    element?.setAttribute("role", "button");
    element?.addEventListener("focus", () => kind !== "gap" && this.editor.select(index));
    element?.addEventListener("keydown", (event) => this.pressed(event, kind, index));
    return handle;
  }

  private pressed(event: KeyboardEvent, kind: string, index: number): void {
    const arrow = ARROWS[event.key];
    const { editor } = this;
    if (kind === "gap" && (event.key === "Enter" || event.key === " ")) editor.addCorner(index);
    else if (kind !== "gap" && arrow) editor.nudge(index, arrow[0], arrow[1]);
    else if (kind === "point" && (event.key === "Delete" || event.key === "Backspace")) editor.removeCorner(index);
    else return;
    // The map does not move, too.
    event.preventDefault();
    event.stopPropagation();
  }

  private pixels(a: Point, b: Point): number {
    return this.map.latLngToLayerPoint(toLatLng(a)).distanceTo(this.map.latLngToLayerPoint(toLatLng(b)));
  }
}

function indexOf(name: string): number {
  return name === "whole" ? WHOLE : Number(name.split(" ")[1]);
}

function handleLabel(shape: Shape, name: string, index: number, [x, y]: Point): string {
  if (name === "whole") return t("edit.whole");
  const at = { number: index + 1, x: x.toFixed(2), y: y.toFixed(2) };
  return name.startsWith("gap") ? t("edit.insertAfter", at) : `${pointName(shape, index)}, ${at.x}, ${at.y}`;
}

/** Return what a point of a shape is called. */
export function pointName(shape: Shape, index: number): string {
  if (shape.type === "circle") return t(index === 0 ? "edit.centre" : "edit.edge");
  return t(hasCorners(shape) && shape.type === "corridor" ? "edit.point" : "edit.corner", { number: index + 1 });
}
