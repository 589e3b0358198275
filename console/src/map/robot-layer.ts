// Robots, their paths, obstacles and scans. A pose moves an element and draws nothing: ten robots at 10 Hz cost a browser
// little, while a canvas over the whole map would be copied for each frame.
import L from "leaflet";
import type { PathValue, Point } from "../api/types";
import type { Live } from "../live/live";
import { drawInTurn, drawMoving, forgetDrawing } from "../frames";
import { firstMetres } from "./geometry";

const SVG = "http://www.w3.org/2000/svg";
const PANE = "moving";
const RADIUS_MIN_PX = 9;
const CAPTION_MAX = 24;

const toLatLng = (point: Point): L.LatLngTuple => [point[1], point[0]];

/** The tone of a mode: whether all is well, something slows the robot, or it stands. */
export function tone(mode: string | undefined): "good" | "caution" | "stopped" {
  if (mode === "NORMAL") return "good";
  if (mode === undefined || mode === "PROTECTIVE_STOP" || mode === "FAULT") return "stopped";
  return "caution";
}

/** Return the drawing of a robot of the radius 10 that looks to the right. */
function drawing(): { root: HTMLElement; body: SVGElement; caption: HTMLElement } {
  const root = document.createElement("div");
  const body = document.createElementNS(SVG, "svg");
  body.setAttribute("viewBox", "-12 -12 24 24");
  body.setAttribute("aria-hidden", "true");
  const circle = document.createElementNS(SVG, "circle");
  circle.setAttribute("r", "9.5");
  const front = document.createElementNS(SVG, "path");
  front.setAttribute("d", "M7 0 L-3.5 4.8 L-3.5 -4.8 Z");
  body.append(circle, front);
  const caption = document.createElement("bdi");
  root.append(body, caption);
  return { root, body, caption };
}

/** A marker that keeps its place among the others: Leaflet sorts markers by their latitude at each move, for which the
 * browser paints the whole page anew. */
class MovingMarker extends L.Marker {
  protected _updateZIndex(): void {
    // Leaflet's hook; later ones lie above, a robot under the pointer by the style sheet.
  }
}

/** One robot on the map. */
class RobotDrawing {
  private readonly parts = drawing();
  private readonly marker: L.Marker;
  private readonly rest: L.Polyline;
  private readonly released: L.Polyline;
  private readonly obstacles: L.Polyline;
  private readonly scan: L.Polyline;
  private readonly goal: L.CircleMarker;
  private look = "";
  private drawnPath: PathValue | undefined;
  private drawnLength = 0;

  constructor(
    private readonly map: L.Map,
    private readonly live: Live,
    private readonly id: string,
    renderer: L.Renderer,
    onChoose: () => void,
  ) {
    const line = (className: string): L.Polyline =>
      L.polyline([], { renderer, className, interactive: false, noClip: true, smoothFactor: 0 }).addTo(map);
    this.scan = line("dots scan");
    this.obstacles = line("dots obstacle");
    this.rest = line("path rest");
    this.released = line("path released");
    this.goal = L.circleMarker([0, 0], { renderer, className: "goal", radius: 7, interactive: false });
    const icon = L.divIcon({ html: this.parts.root, className: "robot-mark", iconSize: [0, 0] });
    this.marker = new MovingMarker([0, 0], { icon, keyboard: false });
    this.marker.on("click", onChoose);
    this.parts.caption.textContent = id.slice(0, CAPTION_MAX);
    this.pose();
    this.path();
    this.points();
    this.state(false);
  }

  pose(): void {
    const pose = this.live.of.pose.get(this.id);
    if (!pose) {
      this.marker.remove();
      return;
    }
    this.marker.setLatLng([pose.y, pose.x]);
    if (!this.marker.getElement()) {
      this.marker.addTo(this.map);
      this.scale();
    }
    this.parts.body.style.transform = `rotate(${-pose.theta}rad)`;
  }

  /** Take over the map's scale: a robot is drawn as large as it is, but never too small to be hit. */
  scale(): void {
    const metre = this.map.getZoomScale(this.map.getZoom(), 0);
    const radius = Math.max(RADIUS_MIN_PX, (this.live.of.pose.get(this.id)?.radius ?? 0) * metre) * 1.2;
    this.parts.root.style.setProperty("--radius", `${radius}px`);
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
    this.parts.root.className = `robot-body ${look}`;
    for (const line of [this.rest, this.released]) line.getElement()?.classList.toggle("stale", old);
    for (const line of [this.released, this.goal]) line.getElement()?.classList.toggle("selected", selected);
  }

  remove(): void {
    for (const layer of [this.marker, this.rest, this.released, this.obstacles, this.scan, this.goal]) layer.remove();
  }
}

const PARTS = ["robot", "pose", "path", "obstacles", "scan"] as const;
type Part = (typeof PARTS)[number];

export class RobotLayer {
  private selected: string | null = null;
  private readonly drawings = new Map<string, RobotDrawing>();
  private readonly dirty = new Map<string, Set<Part>>();
  private readonly renderer: L.SVG;
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
    this.renderer = L.svg({ pane: PANE });
    this.previewLines = ["preview halo", "preview"].map((className) =>
      L.polyline([], { renderer: this.renderer, className, interactive: false }).addTo(map));
    this.arrow.className = "pose-arrow";
    const icon = L.divIcon({ html: this.arrow, className: "robot-mark", iconSize: [0, 0] });
    this.previewArrow = L.marker([0, 0], { icon, keyboard: false, interactive: false });
    map.on("zoomend", this.scale, this);
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
    this.map.off("zoomend", this.scale, this);
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
      else drawInTurn("marks", this.drawMarks); // it has come or gone
    }
  };

  private readonly drawMarks = (): void => {
    for (const [id, parts] of this.dirty) {
      let drawn = this.drawings.get(id);
      if (!this.live.of.pose.has(id)) {
        drawn?.remove();
        this.drawings.delete(id);
        continue;
      }
      if (!drawn) {
        drawn = new RobotDrawing(this.map, this.live, id, this.renderer, () => this.onRobot(id));
        this.drawings.set(id, drawn);
      }
      if (parts.has("path") || parts.has("robot")) drawn.path();
      if (parts.has("obstacles") || parts.has("scan")) drawn.points();
      if (parts.has("robot")) drawn.state(id === this.selected);
    }
    this.dirty.clear();
  };
}
