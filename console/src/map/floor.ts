// The map of the floor: Leaflet on a plane of metres (latitude is y, longitude is x), with the layers of the console.
import L from "leaflet";
import type { Point } from "../api/types";
import type { Live } from "../live/live";
import { CostLayer } from "./cost-layer";
import { FixedLayer } from "./fixed-layer";
import { box } from "./geometry";
import { RobotLayer } from "./robot-layer";

export interface FloorHandlers {
  readonly onRobot: (id: string) => void;
  readonly onZone: (id: string) => void;
}

/** What a click on the floor means while somebody picks or draws, instead of a choice of what lies there. */
export type Pick = (point: Point) => void;

/** A drag on the floor, from where it began to where it is; a click is one that ends where it began. */
export type Drag = (from: Point, to: Point, done: boolean) => void;

/** Below so many pixels a metre labels are short (Leaflet's zoom is the binary logarithm). */
const NEARBY_ZOOM = Math.log2(20);

export class Floor {
  readonly map: L.Map;
  readonly robots: RobotLayer;
  readonly fixed: FixedLayer;
  private plan: CostLayer | null = null;
  private costs: CostLayer | null = null;
  private shownMap = "";
  private readonly stops: (() => void)[] = [];
  private pick: Pick | null = null;
  private endDrag: (() => void) | null = null;
  private selected: string | null = null;
  private follows = false;
  private costsShown = true;
  private fitted = false;

  constructor(
    readonly element: HTMLElement,
    private readonly live: Live,
    handlers: FloorHandlers,
  ) {
    // Positions in the plane: one in space gets a layer of its own, and each layer costs time in each frame.
    (L.Browser as { ie3d: boolean }).ie3d = true;
    this.map = L.map(element, {
      crs: L.CRS.Simple,
      attributionControl: false,
      // Layers are drawn at once in their new place: nothing to wait for, and nothing that moves by itself.
      zoomAnimation: false,
      fadeAnimation: false,
      inertia: false,
      zoomSnap: 0.25,
      zoomDelta: 0.5,
      wheelPxPerZoomLevel: 120,
      minZoom: 0,
      maxZoom: 9,
      zoomControl: false,
      boxZoom: false,
    });
    this.map.createPane("plan").classList.add("below");
    this.map.createPane("costs").classList.add("below");
    this.map.setView([0, 0], 3);
    // Before the layers: what their labels cover depends on how long they are.
    const distance = (): void => void element.classList.toggle("afar", this.map.getZoom() < NEARBY_ZOOM);
    this.map.on("zoomend", distance);
    distance();
    this.robots = new RobotLayer(this.map, live, handlers.onRobot);
    this.fixed = new FixedLayer(this.map, live, handlers.onZone);
    this.map.on("click", (event) => this.click(event));
    this.map.on("dragstart", () => this.follow(false));
    this.stops.push(
      live.on(["pose"], (id) => {
        if (this.follows && id === this.selected) this.centre();
      }),
      live.on(["map"], () => this.takeMap()),
      live.on(["costmap"], (key) => this.takeTile(key)),
      live.on(["ready"], () => {
        this.fitOnce();
        this.showCells();
      }),
    );
    const resize = new ResizeObserver(() => {
      this.map.invalidateSize({ animate: false });
      this.fitOnce();
    });
    resize.observe(element);
    this.stops.push(() => resize.disconnect());
    this.takeMap();
    for (const key of live.tiles.keys()) this.takeTile(key);
  }

  remove(): void {
    for (const stop of this.stops) stop();
    this.fixed.remove();
    this.robots.remove();
    this.plan?.remove();
    this.costs?.remove();
    this.map.remove();
  }

  /** Take over the theme's colours. */
  recolour(): void {
    this.plan?.recolour();
    this.costs?.recolour();
  }

  select(robot: string | null): void {
    this.selected = robot;
    this.robots.select(robot);
    if (this.follows) this.centre();
  }

  follow(follows: boolean): void {
    if (this.follows === follows) return;
    this.follows = follows;
    this.element.dispatchEvent(new Event("followchange"));
    if (follows) this.centre();
  }

  get following(): boolean {
    return this.follows;
  }

  showCosts(shown: boolean): void {
    this.costsShown = shown;
    this.showCells();
  }

  /** Show a path that is not sent yet; none with an empty one. */
  preview(points: readonly Point[]): void {
    this.robots.preview(points);
  }

  /** Show a pose that is not sent yet; none with null. */
  previewPose(at: Point | null, theta = 0): void {
    this.robots.previewPose(at, theta);
  }

  /** Send clicks to `pick` until it is set to null. */
  setPick(pick: Pick | null): void {
    this.pick = pick;
    this.element.classList.toggle("picking", pick !== null);
  }

  /** Send drags and clicks to `drag`, instead of moving the map, until it is set to null. */
  setDrag(drag: Drag | null): void {
    this.endDrag?.();
    this.endDrag = null;
    this.element.classList.toggle("picking", drag !== null);
    if (!drag) return;
    const { element, map } = this;
    let from: Point | null = null;
    const point = (event: PointerEvent): Point => {
      const { lat, lng } = map.mouseEventToLatLng(event);
      return [lng, lat];
    };
    const down = (event: PointerEvent): void => {
      if (!event.isPrimary || event.button !== 0) return;
      from = point(event);
      element.setPointerCapture(event.pointerId);
      drag(from, from, false);
    };
    const move = (event: PointerEvent): void => {
      if (from && event.isPrimary) drag(from, point(event), false);
    };
    const up = (event: PointerEvent): void => {
      if (!from || !event.isPrimary) return;
      drag(from, point(event), true);
      from = null;
    };
    map.dragging.disable();
    element.addEventListener("pointerdown", down);
    element.addEventListener("pointermove", move);
    element.addEventListener("pointerup", up);
    this.pick = () => undefined;
    this.endDrag = () => {
      element.removeEventListener("pointerdown", down);
      element.removeEventListener("pointermove", move);
      element.removeEventListener("pointerup", up);
      map.dragging.enable();
      this.pick = null;
    };
  }

  /** Show the whole map. */
  fit(): void {
    const geometry = this.live.map?.geometry;
    if (!geometry) return;
    const { origin_x: x, origin_y: y, width, height, resolution } = geometry;
    this.map.fitBounds([[y, x], [y + height * resolution, x + width * resolution]], { animate: false, padding: [8, 8] });
  }

  /** Show points with some margin. */
  show(points: readonly Point[]): void {
    if (points.length === 0) return;
    const [left, bottom, right, top] = box(points);
    this.map.fitBounds([[bottom, left], [top, right]], { animate: false, maxZoom: 5, padding: [60, 60] });
  }

  /** Show points as `show` does, unless all of them are seen already: then the map stays where the person looks. */
  reveal(points: readonly Point[]): void {
    if (points.length === 0) return;
    const [left, bottom, right, top] = box(points);
    if (!this.map.getBounds().contains([[bottom, left], [top, right]])) this.show(points);
  }

  private fitOnce(): void {
    const { x, y } = this.map.getSize();
    if (this.fitted || !this.live.map || x === 0 || y === 0) return;
    this.fitted = true;
    this.fit();
  }

  private centre(): void {
    const pose = this.selected === null ? undefined : this.live.of.pose.get(this.selected);
    if (pose) this.map.panTo([pose.y, pose.x], { animate: false });
  }

  private click(event: L.LeafletMouseEvent): void {
    this.pick?.([event.latlng.lng, event.latlng.lat]);
  }

  /** Begin with another map: its plan is one picture, everything after comes in tiles. */
  private takeMap(): void {
    const info = this.live.map;
    if (!info) return;
    const { geometry } = info;
    const key = JSON.stringify([info.site, info.epoch, geometry]);
    if (key === this.shownMap) return;
    this.shownMap = key;
    this.plan?.remove();
    this.costs?.remove();
    this.plan = new CostLayer(this.map, geometry, "plan");
    this.costs = new CostLayer(this.map, geometry, "costs");
    this.showCells();
    const { plan } = this;
    void fetch("api/v1/map.png", { cache: "no-cache" })
      .then((response) => (response.ok ? response.blob() : Promise.reject(new Error(`HTTP ${response.status}`))))
      .then((png) => plan.drawPlan(png))
      .catch((error: unknown) => console.warn("the plan can't be shown:", error));
    for (const tile of this.live.tiles.keys()) this.takeTile(tile);
    this.fitOnce();
  }

  /** The costmap shows the plan, too: only one of them is there to be painted. */
  private showCells(): void {
    const costs = this.costsShown && this.live.tiles.size > 0;
    this.costs?.show(costs);
    this.plan?.show(!costs);
  }

  private takeTile(key: string): void {
    const tile = this.live.tiles.get(key);
    if (tile) this.costs?.patch(tile);
    if (this.live.tiles.size === 1) this.showCells();
  }
}
