// The plan and the costmap as canvases of one pixel per cell, which the browser scales. A thread of their own makes
// their pictures, of the tiles of the stream.
import L from "leaflet";
import type { MapGeometry, Tile } from "../api/types";
import { drawInTurn, forgetDrawing } from "../frames";
import type { Drawn, Work } from "./cost-work";
import { costColours, FREE, LETHAL, UNKNOWN } from "./palette";

/** Cells on an edge of one canvas: a change hands over all of its canvas. */
const BLOCK = 512;

/** A canvas on the map, scaled with it. */
class CanvasOverlay extends L.ImageOverlay {
  constructor(
    private readonly canvas: HTMLCanvasElement,
    bounds: L.LatLngBounds,
    pane: string,
  ) {
    super("", bounds, { pane, interactive: false, className: "cells" });
  }

  // Leaflet's hook, which makes the image; everything else works on any element.
  protected _initImage(): void {
    const own = this as unknown as { _image: HTMLElement };
    own._image = this.canvas;
    this.canvas.classList.add("leaflet-image-layer", "cells");
    this.canvas.setAttribute("aria-hidden", "true");
  }
}

interface Block {
  /** Pictures are handed to it whole, since a canvas that is drawn on is copied for every frame. */
  readonly shown: ImageBitmapRenderingContext;
  readonly overlay: L.ImageOverlay;
  /** A newer picture that is to be shown. */
  next: ImageBitmap | null;
}

const SAME = Uint8Array.from({ length: 256 }, (_, grey) => grey);
const OF_PLAN = SAME.map((grey) => (grey > 250 ? FREE : grey < 5 ? LETHAL : UNKNOWN));

/** A grid of costs on the map. */
export class CostLayer {
  private readonly blocks = new Map<string, Block>();
  private shown = true;
  private readonly worker = new Worker(new URL("./cost-worker.ts", import.meta.url), { type: "module" });

  constructor(
    private readonly map: L.Map,
    private readonly geometry: MapGeometry,
    private readonly pane: string,
  ) {
    this.worker.onmessage = ({ data: { x, y, picture } }: MessageEvent<Drawn>) => {
      this.block(x, y).next = picture;
      drawInTurn("cells", this.present);
    };
    this.ask({ kind: "begin", width: geometry.width, height: geometry.height, block: BLOCK });
    this.recolour();
  }

  /** Draw a tile of the stream. */
  patch(tile: Tile): void {
    const top = this.geometry.height - tile.row - tile.height;
    this.ask({ kind: "draw", png: tile.png, column: tile.column, top, costs: SAME });
  }

  /** Draw the plan's picture: white is free, black occupied, grey unknown. */
  drawPlan(png: Blob): void {
    this.ask({ kind: "draw", png, column: 0, top: 0, costs: OF_PLAN });
  }

  private ask(work: Work): void {
    this.worker.postMessage(work);
  }

  private readonly present = (): void => {
    for (const block of this.blocks.values()) {
      if (block.next) block.shown.transferFromImageBitmap(block.next);
      block.next = null;
    }
  };

  private block(x: number, y: number): Block {
    const key = `${x} ${y}`;
    const known = this.blocks.get(key);
    if (known) return known;
    const width = Math.min(BLOCK, this.geometry.width - x);
    const height = Math.min(BLOCK, this.geometry.height - y);
    const canvas = document.createElement("canvas");
    canvas.width = width;
    canvas.height = height;
    const shown = canvas.getContext("bitmaprenderer");
    if (!shown) throw new Error("the browser has no canvas");
    const { resolution, origin_x, origin_y } = this.geometry;
    const topEdge = origin_y + (this.geometry.height - y) * resolution;
    const leftEdge = origin_x + x * resolution;
    const bounds = L.latLngBounds(
      [topEdge - height * resolution, leftEdge],
      [topEdge, leftEdge + width * resolution],
    );
    const overlay = new CanvasOverlay(canvas, bounds, this.pane);
    if (this.shown) overlay.addTo(this.map);
    const block = { shown, overlay, next: null };
    this.blocks.set(key, block);
    return block;
  }

  /** Take over the theme's colours. */
  recolour(): void {
    this.ask({ kind: "colours", colours: costColours() });
  }

  show(shown: boolean): void {
    this.shown = shown;
    for (const { overlay } of this.blocks.values()) {
      if (shown) overlay.addTo(this.map);
      else overlay.remove();
    }
  }

  remove(): void {
    this.worker.terminate();
    forgetDrawing(this.present);
    for (const { overlay } of this.blocks.values()) overlay.remove();
    this.blocks.clear();
  }
}
