// What moves: robots, their paths, obstacles and scans, on one canvas over the map, drawn at most once a frame.
import L from "leaflet";
import type { Live } from "../live/live";
import type { Point } from "../api/types";
import { firstMetres } from "./geometry";
import { colour } from "./palette";

const COLOURS = ["robot", "robot-old", "path", "obstacle", "scan", "goal", "card", "text", "good", "caution", "stopped"] as const;
type ColourName = (typeof COLOURS)[number];

/** The tone of a mode: whether all is well, something slows the robot, or it stands. */
export function tone(mode: string | undefined): "good" | "caution" | "stopped" {
  if (mode === "NORMAL") return "good";
  if (mode === undefined || mode === "PROTECTIVE_STOP" || mode === "FAULT") return "stopped";
  return "caution";
}

export class MovingLayer extends L.Layer {
  /** A path that is not sent yet. */
  preview: readonly Point[] = [];
  /** A pose that is not sent yet. */
  previewPose: { readonly at: Point; readonly theta: number } | null = null;
  selected: string | null = null;
  private readonly canvas = document.createElement("canvas");
  private readonly context = this.canvas.getContext("2d");
  private colours: Partial<Record<ColourName, string>> = {};
  private pending = 0;

  constructor(private readonly live: Live) {
    super();
    this.canvas.className = "moving";
    this.canvas.setAttribute("aria-hidden", "true");
    this.readColours();
  }

  override onAdd(map: L.Map): this {
    map.getPane("overlayPane")?.append(this.canvas);
    map.on("move zoom viewreset resize", this.drawNow, this);
    this.redraw();
    return this;
  }

  override onRemove(map: L.Map): this {
    map.off("move zoom viewreset resize", this.drawNow, this);
    this.canvas.remove();
    return this;
  }

  readColours(): void {
    for (const name of COLOURS) this.colours[name] = colour(name);
    this.redraw();
  }

  /** Draw in the next frame. */
  redraw(): void {
    if (this.pending === 0) this.pending = requestAnimationFrame(() => this.drawNow());
  }

  private pixel(point: Point): L.Point {
    return this._map.latLngToContainerPoint([point[1], point[0]]);
  }

  private drawNow(): void {
    cancelAnimationFrame(this.pending);
    this.pending = 0;
    const { context, canvas } = this;
    if (!this._map || !context) return;
    const size = this._map.getSize();
    const ratio = window.devicePixelRatio || 1;
    if (canvas.width !== Math.round(size.x * ratio) || canvas.height !== Math.round(size.y * ratio)) {
      canvas.width = Math.round(size.x * ratio);
      canvas.height = Math.round(size.y * ratio);
      canvas.style.width = `${size.x}px`;
      canvas.style.height = `${size.y}px`;
    }
    L.DomUtil.setPosition(canvas, this._map.containerPointToLayerPoint([0, 0]));
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, size.x, size.y);
    const { of } = this.live;
    for (const [robot, scan] of of.scan) if (!this.live.oldRobot(robot)) this.dots(scan.points, "scan", 2);
    for (const obstacles of of.obstacles.values()) this.dots(obstacles.points, "obstacle", 4);
    for (const [robot, path] of of.path) this.path(robot, path.points, path.released_length);
    if (this.preview.length > 1) {
      this.line(this.preview, "card", 7, []);
      this.line(this.preview, "goal", 4, [2, 6]);
    }
    if (this.previewPose) this.arrow(this.previewPose.at, this.previewPose.theta);
    for (const [robot, { goal }] of of.robot) if (goal) this.goal([goal.pose.x, goal.pose.y], robot);
    for (const id of of.pose.keys()) this.robot(id);
  }

  private dots(points: readonly Point[], name: ColourName, size: number): void {
    if (!this.context) return;
    this.context.fillStyle = this.colours[name] ?? "";
    for (const point of points) {
      const { x, y } = this.pixel(point);
      this.context.fillRect(x - size / 2, y - size / 2, size, size);
    }
  }

  private line(points: readonly Point[], name: ColourName, width: number, dash: readonly number[]): void {
    const { context } = this;
    if (!context || points.length < 2) return;
    context.beginPath();
    points.forEach((point, i) => {
      const { x, y } = this.pixel(point);
      if (i === 0) context.moveTo(x, y);
      else context.lineTo(x, y);
    });
    context.strokeStyle = this.colours[name] ?? "";
    context.lineWidth = width;
    context.lineJoin = "round";
    context.setLineDash([...dash]);
    context.stroke();
    context.setLineDash([]);
  }

  /** The part that the robot may drive is a solid line, the rest is dashed. */
  private path(robot: string, points: readonly Point[], released: number): void {
    const name = this.live.oldRobot(robot) ? "robot-old" : "path";
    this.line(points, name, 2, [3, 6]);
    this.line(firstMetres(points, released), name, robot === this.selected ? 5 : 3.5, []);
  }

  /** An arrow of a size that can be seen at any zoom. */
  private arrow(at: Point, theta: number): void {
    const { context, colours } = this;
    if (!context) return;
    const { x, y } = this.pixel(at);
    context.save();
    context.translate(x, y);
    context.rotate(-theta);
    context.beginPath();
    context.arc(0, 0, 10, 0, 2 * Math.PI);
    context.moveTo(10, 0);
    context.lineTo(44, 0);
    context.moveTo(32, -9);
    context.lineTo(44, 0);
    context.lineTo(32, 9);
    for (const [width, name] of [[8, "card"], [4, "goal"]] as const) {
      context.lineWidth = width;
      context.strokeStyle = colours[name] ?? "";
      context.stroke();
    }
    context.restore();
  }

  private goal(at: Point, robot: string): void {
    const { context } = this;
    if (!context) return;
    const { x, y } = this.pixel(at);
    context.beginPath();
    context.arc(x, y, robot === this.selected ? 10 : 7, 0, 2 * Math.PI);
    context.lineWidth = 3;
    context.strokeStyle = this.colours.goal ?? "";
    context.stroke();
  }

  private robot(id: string): void {
    const { context, colours } = this;
    const pose = this.live.of.pose.get(id);
    if (!context || !pose) return;
    const state = this.live.of.robot.get(id)?.state;
    const old = this.live.oldRobot(id);
    const at = this.pixel([pose.x, pose.y]);
    const edge = this.pixel([pose.x + pose.radius, pose.y]);
    const size = Math.max(9, edge.x - at.x);
    context.save();
    context.translate(at.x, at.y);
    context.rotate(-pose.theta);
    context.beginPath();
    context.arc(0, 0, size, 0, 2 * Math.PI);
    context.fillStyle = (old ? colours["robot-old"] : colours.robot) ?? "";
    context.fill();
    context.lineWidth = id === this.selected ? 4 : 2;
    context.strokeStyle = (old ? colours["robot-old"] : colours[tone(state?.mode)]) ?? "";
    context.stroke();
    context.beginPath();
    context.moveTo(size * 0.75, 0);
    context.lineTo(-size * 0.35, size * 0.5);
    context.lineTo(-size * 0.35, -size * 0.5);
    context.closePath();
    context.fillStyle = colours.card ?? "";
    context.fill();
    context.restore();
    this.caption(id + (old || !pose.localized ? " ?" : ""), at.x, at.y - size - 9);
  }

  private caption(text: string, x: number, y: number): void {
    const { context, colours } = this;
    if (!context) return;
    context.font = "600 12px system-ui, 'DejaVu Sans', sans-serif";
    context.textAlign = "center";
    context.textBaseline = "middle";
    context.lineWidth = 4;
    context.strokeStyle = colours.card ?? "";
    context.strokeText(text, x, y);
    context.fillStyle = colours.text ?? "";
    context.fillText(text, x, y);
  }
}
