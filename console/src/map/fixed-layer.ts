// What stands still on the map: zones, areas with their hazards, sensor nodes and places.
import L from "leaflet";
import type { AreaView, NodeValue, Place, Point, Values } from "../api/types";
import { said } from "../i18n/codes";
import { t } from "../i18n/i18n";
import type { Live, Topic } from "../live/live";
import { areaText, isPartlyFree, shownState } from "../sensors/words";
import { beam, outline, toPoint } from "./geometry";

const toLatLng = (point: Point): L.LatLngTuple => [point[1], point[0]];
const TOPICS: readonly Topic[] = ["zone", "area", "node", "place"];

/** Return a label: from afar the id alone. Names come from people: they are text, and never HTML. */
function label(id: string, name = "", ...details: readonly string[]): HTMLElement {
  const element = document.createElement("span");
  const add = (text: string, kind: string): void => {
    const line = document.createElement("bdi");
    line.className = kind;
    line.textContent = text;
    element.append(line);
  };
  add(id, "from-afar");
  for (const text of [name || id, ...details]) if (text !== "") add(text, "nearby");
  return element;
}

const DECLUTTER_MS = 1_000;
/** Kinds of labels, the most important first: what keeps robots out, what may, where they are sent, what only is there. */
const RANKS = ["draft", "zone active", "area blocked", "area unknown", "place", "area", "zone"] as const;

function rankOf(classes: DOMTokenList): number {
  const found = RANKS.findIndex((kinds) => kinds.split(" ").every((kind) => classes.contains(kind)));
  return found < 0 ? RANKS.length : found;
}

const overlaps = (a: DOMRect, b: DOMRect): boolean => a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;

export class FixedLayer {
  private readonly shapes = new Map<string, L.LayerGroup>();
  private readonly dirty = new Set<string>();
  private pending = 0;
  private readonly stop: () => void;
  /** Zones that another layer draws, such as one that is being edited. */
  private hidden: ReadonlySet<string> = new Set();

  constructor(
    private readonly map: L.Map,
    private readonly live: Live,
    private readonly onZone: (id: string) => void,
  ) {
    const offs = TOPICS.map((topic) => live.on([topic], (key) => this.mark(topic, key)));
    map.on("zoomend", this.declutter, this);
    const timer = setInterval(() => this.declutter(), DECLUTTER_MS);
    this.stop = () => {
      clearInterval(timer);
      offs.forEach((off) => off());
      map.off("zoomend", this.declutter, this);
    };
    this.redrawAll();
  }

  hideZones(ids: ReadonlySet<string>): void {
    const changed = [...this.hidden, ...ids];
    this.hidden = ids;
    for (const id of changed) this.mark("zone", id);
  }

  redrawAll(): void {
    for (const topic of TOPICS) this.mark(topic, "");
  }

  remove(): void {
    this.stop();
    cancelAnimationFrame(this.pending);
    for (const group of this.shapes.values()) group.remove();
  }

  /** Draw an entry anew in the next frame; all of the topic without a key. */
  private mark(topic: Topic, key: string): void {
    if (key === "") {
      for (const known of this.shapes.keys()) if (known.startsWith(`${topic} `)) this.dirty.add(known);
      if (topic === "zone" || topic === "area" || topic === "node" || topic === "place") {
        for (const id of this.live.of[topic].keys()) this.dirty.add(`${topic} ${id}`);
      }
    } else this.dirty.add(`${topic} ${key}`);
    if (this.pending === 0) this.pending = requestAnimationFrame(() => this.drawDirty());
  }

  private drawDirty(): void {
    this.pending = 0;
    for (const name of this.dirty) {
      this.shapes.get(name)?.remove();
      this.shapes.delete(name);
      const group = this.make(name);
      if (group) this.shapes.set(name, group.addTo(this.map));
    }
    this.dirty.clear();
    this.declutter();
  }

  /** Hide labels that would lie over more important ones, or under a robot's name; each second anew, as robots move. */
  private declutter(): void {
    const found = [...this.map.getPane("tooltipPane")?.querySelectorAll<HTMLElement>(".label") ?? []];
    // All are measured before the first is hidden: the browser lays the page out once.
    const kept = [...this.map.getContainer().querySelectorAll(".robot-body text")].map((name) => name.getBoundingClientRect());
    const labels = found.map((each) => ({ each, rank: rankOf(each.classList), box: each.getBoundingClientRect() }));
    labels.sort((a, b) => a.rank - b.rank);
    for (const { each, box } of labels) {
      const covered = kept.some((other) => overlaps(box, other));
      if (!covered) kept.push(box);
      if (covered !== each.classList.contains("covered")) each.classList.toggle("covered", covered);
    }
  }

  private make(name: string): L.LayerGroup | null {
    const space = name.indexOf(" ");
    const id = name.slice(space + 1);
    const { of } = this.live;
    switch (name.slice(0, space)) {
      case "zone": {
        const zone = of.zone.get(id);
        return zone && !this.hidden.has(id) ? this.zone(zone) : null;
      }
      case "area": {
        const area = of.area.get(id);
        return area ? this.area(area) : null;
      }
      case "node": {
        const node = of.node.get(id);
        return node ? this.node(node) : null;
      }
      default: {
        const place = of.place.get(id);
        return place ? this.place(id, place) : null;
      }
    }
  }

  private outlined(points: readonly Point[], kind: string, text: HTMLElement): [L.LayerGroup, L.Polygon] {
    const latLngs = points.map(toLatLng);
    // A dark edge below the light one can be told from any grey of the map.
    const halo = L.polygon(latLngs, { className: `halo ${kind}`, interactive: false });
    const shape = L.polygon(latLngs, { className: `shape ${kind}` });
    shape.bindTooltip(text, { permanent: true, direction: "center", className: `label ${kind}` });
    return [L.layerGroup([halo, shape]), shape];
  }

  private zone(zone: Values["zone"]): L.LayerGroup {
    const kind = `zone ${zone.kind.toLowerCase()} ${zone.active ? "active" : "inactive"}`;
    const state = zone.active ? t(`zone.${zone.kind}`) : t("zone.inactive");
    const [group, shape] = this.outlined(outline(zone.shape), kind, label(zone.id, "", state));
    shape.on("click", (event) => {
      L.DomEvent.stop(event);
      this.onZone(zone.id);
    });
    return group;
  }

  private area(area: AreaView): L.LayerGroup {
    const { definition } = area;
    const state = shownState(area);
    const text = label(definition.id, definition.label, state === "clear" ? "" : areaText(area));
    const [group] = this.outlined(definition.polygon.map(toPoint), `area ${state}`, text);
    if (isPartlyFree(area)) {
      for (const part of area.hazard?.free ?? []) {
        const latLngs = part.map((corner) => toLatLng(toPoint(corner)));
        group.addLayer(L.polygon(latLngs, { className: "shape area part-free", interactive: false }));
      }
    }
    return group;
  }

  private node(node: NodeValue): L.LayerGroup | null {
    if (node.x === undefined || node.y === undefined) return null;
    const at: Point = [node.x, node.y];
    const health = node.online === false ? "offline" : node.state;
    const cones = (node.sonars ?? []).map(({ angle, range_limit: range }) => {
      const outlined = beam(at, (node.theta ?? 0) + angle, range).map(toLatLng);
      return L.polygon(outlined, { className: `cone ${health}`, interactive: false });
    });
    const marker = L.circleMarker(toLatLng(at), { radius: 5, className: `node ${health}` });
    marker.bindTooltip(label(node.id, "", said(node.code, node.reason)));
    return L.layerGroup([...cones, marker]);
  }

  private place(id: string, place: Place): L.LayerGroup {
    const at = toLatLng([place.x, place.y]);
    const marker = L.circleMarker(at, { radius: 4, className: "place", interactive: false });
    marker.bindTooltip(label(id, place.label), { permanent: true, direction: "top", className: "label place" });
    return L.layerGroup([marker]);
  }
}
