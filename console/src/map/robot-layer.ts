// Robots, their paths, obstacles and scans. A pose moves the points of some lines: unlike a style, they change without the
// page's styles being computed anew, and a canvas over the whole map would be copied for each frame.
import L from "leaflet";
import type { PathValue, Point } from "../api/types";
import type { Live } from "../live/live";
import { drawInTurn, drawMoving, forgetDrawing } from "../frames";
import { firstMetres } from "./geometry";

const SVG = "http://www.w3.org/2000/svg";
const PANE = "moving";
/** A target of 24 pixels at least. */
const RADIUS_MIN_PX = 12;
const CAPTION_MAX = 24;
const CAPTION_PX = 3;
const ANGLE_STEP = Math.PI / 60;
const NOWHERE = L.point(NaN, NaN);
const CAPTION_STAYS_PX = 2;
const BORDER_PX = 5;
/** The arrow that looks ahead, in a body of the radius 1. */
const FRONT: readonly Point[] = [[0.6, 0], [-0.3, 0.42], [-0.3, -0.42]];

const toLatLng = (point: Point): L.LatLngTuple => [point[1], point[0]];

/** The tone of a mode: whether all is well, something slows the robot, or it stands. */
export function tone(mode: string | undefined): "good" | "caution" | "stopped" {
  if (mode === "NORMAL") return "good";
  if (mode === undefined || mode === "PROTECTIVE_STOP" || mode === "FAULT") return "stopped";
  return "caution";
}

/** A robot of two dots, which are lines without length and with round ends, one on the other, with an arrow in them. */
interface Parts {
  readonly root: SVGElement;
  readonly edge: SVGElement;
  readonly body: SVGElement;
  readonly front: SVGElement;
  readonly caption: SVGElement;
}

function makeParts(): Parts {
  const make = (tag: "g" | "polygon" | "polyline" | "text", name: string): SVGElement => {
    const made = document.createElementNS(SVG, tag);
    made.setAttribute("class", name);
    return made;
  };
  const parts = {
    root: make("g", ""), edge: make("polyline", "edge"), body: make("polyline", "body"), front: make("polygon", "front"),
    caption: make("text", ""),
  };
  parts.root.append(parts.edge, parts.body, parts.front, parts.caption);
  return parts;
}

/** Return the corners of a shape as SVG writes them, turned by an angle (rad, against the clock) and drawn around a pixel. */
function corners(shape: readonly Point[], at: L.Point, radius: number, angle: number): string {
  const [ahead, aside] = [radius * Math.cos(angle), radius * Math.sin(angle)];
  return shape.map(([x, y]) => `${(at.x + x * ahead - y * aside).toFixed(1)},${(at.y - x * aside - y * ahead).toFixed(1)}`).join(" ");
}

/** One robot on the map. */
class RobotDrawing {
  private readonly parts = makeParts();
  private readonly rest: L.Polyline;
  private readonly released: L.Polyline;
  private readonly obstacles: L.Polyline;
  private readonly scan: L.Polyline;
  private readonly goal: L.CircleMarker;
  private look = "";
  private drawnPath: PathValue | undefined;
  private drawnLength = 0;
  private radius = RADIUS_MIN_PX;
  private drawnAt = NOWHERE;
  private drawnAngle = 0;
  private drawnCaption = NOWHERE;

  constructor(
    private readonly map: L.Map,
    private readonly live: Live,
    private readonly id: string,
    renderer: L.Renderer,
    private readonly bodies: SVGElement,
    onChoose: () => void,
  ) {
    const line = (className: string): L.Polyline =>
      L.polyline([], { renderer, className, interactive: false, noClip: true, smoothFactor: 0 }).addTo(map);
    this.scan = line("dots scan");
    this.obstacles = line("dots obstacle");
    this.rest = line("path rest");
    this.released = line("path released");
    this.goal = L.circleMarker([0, 0], { renderer, className: "goal", radius: 7, interactive: false });
    const { root } = this.parts;
    root.addEventListener("click", (event) => {
      L.DomEvent.stop(event);
      // A drag of the map may begin on a robot. Leaflet's types lack this method of its handler.
      if (!(this.map.dragging as L.Handler & { moved: () => boolean }).moved()) onChoose();
    });
    root.addEventListener("pointerenter", () => {
      if (this.bodies.lastElementChild !== root) this.bodies.append(root); // above those that it overlaps
    });
    this.bodies.append(root);
    this.scale();
    this.path();
    this.points();
    this.state(false);
  }

  pose(): void {
    const pose = this.live.of.pose.get(this.id);
    if (!pose) return;
    const { edge, body, front } = this.parts;
    const { x, y } = this.map.project([pose.y, pose.x]).subtract(this.map.getPixelOrigin());
    // What nobody would see is not drawn: a robot on the map of a whole floor moves half a pixel in some tenths of a second.
    const at = L.point(Math.round(2 * x) / 2, Math.round(2 * y) / 2);
    const angle = Math.round(pose.theta / ANGLE_STEP) * ANGLE_STEP;
    const moved = !at.equals(this.drawnAt);
    if (moved) {
      const dot = `${at.x},${at.y} ${at.x},${at.y}`;
      edge.setAttribute("points", dot);
      body.setAttribute("points", dot);
    }
    if (moved || angle !== this.drawnAngle) front.setAttribute("points", corners(FRONT, at, this.radius, angle));
    [this.drawnAt, this.drawnAngle] = [at, angle];
  }

  /** Draw the name where the robot is: words are dear to lay out, so they come some frames later, and not for one pixel. */
  caption(): void {
    const { caption } = this.parts;
    const at = L.point(Math.round(this.drawnAt.x), Math.round(this.drawnAt.y - this.radius - CAPTION_PX));
    if (at.distanceTo(this.drawnCaption) <= CAPTION_STAYS_PX) return;
    caption.setAttribute("x", String(at.x));
    caption.setAttribute("y", String(at.y));
    this.drawnCaption = at;
  }

  /** Take over the map's scale: a robot is drawn as large as it is, but never too small to be hit. */
  scale(): void {
    const metre = this.map.getZoomScale(this.map.getZoom(), 0);
    this.radius = Math.max(RADIUS_MIN_PX, (this.live.of.pose.get(this.id)?.radius ?? 0) * metre * 1.2);
    this.parts.edge.setAttribute("stroke-width", String(2 * this.radius));
    this.parts.body.setAttribute("stroke-width", String(2 * this.radius - BORDER_PX));
    this.drawnAt = this.drawnCaption = NOWHERE;
    this.pose();
    this.caption();
  }

  path(): void {
    const path = this.live.of.path.get(this.id);
    const points = path?.points ?? [];
    if (path !== this.drawnPath) this.rest.setLatLngs(points.map(toLatLng));
    // What is released grows without a new path: then the robot's plan has it.
    const plan = this.live.of.robot.get(this.id)?.plan;
    const length = plan && plan.plan_id === path?.plan_id ? plan.released_length : path?.released_length ?? 0;
    if (path === this.drawnPath && length === this.drawnLength) return;
    this.drawnPath = path;
    this.drawnLength = length;
    this.released.setLatLngs(firstMetres(points, length).map(toLatLng));
  }

  points(): void {
    for (const [line, found] of [[this.obstacles, this.live.of.obstacles], [this.scan, this.live.of.scan]] as const) {
      // Lines without length, whose round ends are dots.
      line.setLatLngs((found.get(this.id)?.points ?? []).map((point) => [toLatLng(point), toLatLng(point)]));
    }
  }

  state(selected: boolean): void {
    const robot = this.live.of.robot.get(this.id);
    const goal = robot?.goal?.pose;
    if (goal) this.goal.setLatLng([goal.y, goal.x]).addTo(this.map);
    else this.goal.remove();
    const old = this.live.oldRobot(this.id);
    const lost = this.live.of.pose.get(this.id)?.localized === false;
    const look = `${old ? "stale" : tone(robot?.state?.mode)}${selected ? " selected" : ""}${lost ? " lost" : ""}`;
    if (look === this.look) return;
    this.look = look;
    this.parts.root.setAttribute("class", `robot-body leaflet-interactive ${look}`);
    this.parts.caption.textContent = this.id.slice(0, CAPTION_MAX) + (old || lost ? " ?" : "");
    for (const line of [this.rest, this.released]) line.getElement()?.classList.toggle("stale", old);
    for (const line of [this.released, this.goal]) line.getElement()?.classList.toggle("selected", selected);
  }

  remove(): void {
    this.parts.root.remove();
    for (const layer of [this.rest, this.released, this.obstacles, this.scan, this.goal]) layer.remove();
  }
}

/** So many robots get their marks in a frame; further ones in a later one. */
const MARKS_A_FRAME = 4;
const PARTS = ["robot", "pose", "path", "obstacles", "scan"] as const;
type Part = (typeof PARTS)[number];

export class RobotLayer {
  private selected: string | null = null;
  private readonly drawings = new Map<string, RobotDrawing>();
  private readonly dirty = new Map<string, Set<Part>>();
  private readonly renderer: L.SVG;
  private readonly bodies = document.createElementNS(SVG, "g");
  private readonly previewLines: readonly L.Polyline[];
  private readonly previewArrow: L.Marker;
  private readonly arrow = document.createElement("div");
  private readonly stops: (() => void)[];

  constructor(
    private readonly map: L.Map,
    private readonly live: Live,
    private readonly onRobot: (id: string) => void,
  ) {
    map.createPane(PANE);
    this.renderer = L.svg({ pane: PANE }).addTo(map);
    // Beside Leaflet's group of lines, above them: pixels are the same there.
    this.renderer.getPane()?.querySelector("svg")?.append(this.bodies);
    this.previewLines = ["preview halo", "preview"].map((className) =>
      L.polyline([], { renderer: this.renderer, className, interactive: false }).addTo(map));
    this.arrow.className = "pose-arrow";
    const icon = L.divIcon({ html: this.arrow, className: "robot-mark", iconSize: [0, 0] });
    this.previewArrow = L.marker([0, 0], { icon, keyboard: false, interactive: false });
    map.on("zoomend viewreset", this.scale, this);
    this.stops = [
      ...PARTS.map((part) => live.on([part], (id) => this.mark(part, id))),
      live.on(["connection"], () => this.markStates()),
    ];
    const timer = setInterval(() => this.markStates(), 1000); // they become old without any event
    this.stops.push(() => clearInterval(timer));
    for (const part of PARTS) this.mark(part, "");
  }

  select(robot: string | null): void {
    this.selected = robot;
    this.markStates();
  }

  preview(points: readonly Point[]): void {
    for (const line of this.previewLines) line.setLatLngs(points.map(toLatLng));
  }

  previewPose(at: Point | null, theta: number): void {
    if (!at) {
      this.previewArrow.remove();
      return;
    }
    this.previewArrow.setLatLng(toLatLng(at)).addTo(this.map);
    this.arrow.style.transform = `rotate(${-theta}rad)`;
  }

  remove(): void {
    for (const stop of this.stops) stop();
    this.map.off("zoomend viewreset", this.scale, this);
    forgetDrawing(this.drawPoses);
    forgetDrawing(this.drawMarks);
    for (const drawn of this.drawings.values()) drawn.remove();
  }

  private scale(): void {
    for (const drawn of this.drawings.values()) drawn.scale();
  }

  private markStates(): void {
    for (const id of this.drawings.keys()) this.mark("robot", id);
  }

  /** Draw a part of a robot anew in the next frame; of all robots without an id. */
  private mark(part: Part, id: string): void {
    if (part === "pose") drawMoving(this.drawPoses);
    else drawInTurn("marks", this.drawMarks);
    const ids = id === "" ? new Set([...this.drawings.keys(), ...this.live.of.pose.keys()]) : [id];
    for (const each of ids) {
      const parts = this.dirty.get(each) ?? new Set();
      this.dirty.set(each, parts.add(part));
    }
  }

  private readonly drawPoses = (): void => {
    for (const [id, parts] of this.dirty) {
      if (!parts.delete("pose")) continue;
      const drawn = this.drawings.get(id);
      if (drawn && this.live.of.pose.has(id)) drawn.pose();
      drawInTurn("marks", this.drawMarks); // it has come or gone, and its name follows it
    }
  };

  private readonly drawMarks = (): void => {
    let left = MARKS_A_FRAME;
    for (const [id, parts] of [...this.dirty]) {
      const moves = parts.has("pose"); // where it is drawn comes first
      if (moves && parts.size === 1) continue;
      if (left-- === 0) {
        drawInTurn("marks", this.drawMarks);
        return;
      }
      this.dirty.delete(id);
      if (moves) this.dirty.set(id, new Set<Part>(["pose"]));
      this.drawMark(id, parts);
    }
  };

  private drawMark(id: string, parts: ReadonlySet<Part>): void {
    let drawn = this.drawings.get(id);
    if (!this.live.of.pose.has(id)) {
      drawn?.remove();
      this.drawings.delete(id);
      return;
    }
    if (!drawn) {
      drawn = new RobotDrawing(this.map, this.live, id, this.renderer, this.bodies, () => this.onRobot(id));
      this.drawings.set(id, drawn);
    }
    drawn.caption();
    if (parts.has("path") || parts.has("robot")) drawn.path();
    if (parts.has("obstacles") || parts.has("scan")) drawn.points();
    if (parts.has("robot")) drawn.state(id === this.selected);
  }
}
