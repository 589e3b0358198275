// The plan and the costmap as canvases of one pixel per cell, which the browser scales; a tile changes its cells only.
import L from "leaflet";
import type { MapGeometry, Tile } from "../api/types";
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
  readonly context: OffscreenCanvasRenderingContext2D;
  /** What is seen: pictures are handed to it whole, since a canvas that is drawn on is copied for every frame. */
  readonly shown: ImageBitmapRenderingContext;
  readonly overlay: L.ImageOverlay;
  /** The costs, row 0 at the top, for another theme's colours. */
  readonly costs: Uint8Array;
  readonly width: number;
  readonly height: number;
}

/** A grid of costs on the map. */
export class CostLayer {
  private readonly blocks = new Map<string, Block>();
  private colours = costColours();
  private shown = true;
  private readonly changed = new Set<Block>();
  private pending = 0;
  private readonly scratch = document.createElement("canvas");

  constructor(
    private readonly map: L.Map,
    private readonly geometry: MapGeometry,
    private readonly pane: string,
  ) {}

  /** Draw a tile of the stream. */
  async patch(tile: Tile): Promise<void> {
    const bytes = Uint8Array.from(atob(tile.png), (char) => char.charCodeAt(0));
    const top = this.geometry.height - tile.row - tile.height;
    await this.draw(new Blob([bytes], { type: "image/png" }), tile.column, top);
  }

  /** Draw the plan's picture: white is free, black occupied, grey unknown. */
  async drawPlan(png: Blob): Promise<void> {
    await this.draw(png, 0, 0, (grey) => (grey > 250 ? FREE : grey < 5 ? LETHAL : UNKNOWN));
  }

  /** Draw a grey PNG whose first pixel is the cell (column, top), counted from the map's upper edge. */
  private async draw(png: Blob, column: number, top: number, cost?: (grey: number) => number): Promise<void> {
    const image = await createImageBitmap(png, { colorSpaceConversion: "none", premultiplyAlpha: "none" });
    const { width, height } = image;
    this.scratch.width = width;
    this.scratch.height = height;
    const context = this.scratch.getContext("2d", { willReadFrequently: true });
    if (!context) return;
    context.drawImage(image, 0, 0);
    image.close();
    const pixels = context.getImageData(0, 0, width, height).data;
    if (cost) for (let i = 0; i < pixels.length; i += 4) pixels[i] = cost(pixels[i] ?? 0);
    for (let y = top - (top % BLOCK); y < top + height; y += BLOCK) {
      for (let x = column - (column % BLOCK); x < column + width; x += BLOCK) {
        this.fill(pixels, width, { left: column, top, right: column + width, bottom: top + height }, x, y);
      }
    }
  }

  /** Copy what of a window lies in the block at (x, y). */
  private fill(
    pixels: Uint8ClampedArray,
    stride: number,
    window: { left: number; top: number; right: number; bottom: number },
    x: number,
    y: number,
  ): void {
    const block = this.block(x, y);
    const left = Math.max(window.left, x);
    const top = Math.max(window.top, y);
    const right = Math.min(window.right, x + block.width);
    const bottom = Math.min(window.bottom, y + block.height);
    if (right <= left || bottom <= top) return;
    for (let row = top; row < bottom; row++) {
      let from = ((row - window.top) * stride + left - window.left) * 4;
      let to = (row - y) * block.width + left - x;
      for (let cell = left; cell < right; cell++, from += 4, to++) block.costs[to] = pixels[from] ?? 0;
    }
    this.paint(block, left - x, top - y, right - left, bottom - top);
  }

  private paint(block: Block, left: number, top: number, width: number, height: number): void {
    const image = block.context.createImageData(width, height);
    const pixels = new Uint32Array(image.data.buffer);
    for (let row = 0; row < height; row++) {
      const from = (top + row) * block.width + left;
      for (let cell = 0; cell < width; cell++) {
        pixels[row * width + cell] = this.colours[block.costs[from + cell] ?? 0] ?? 0;
      }
    }
    block.context.putImageData(image, left, top);
    this.changed.add(block);
    if (this.pending === 0) this.pending = requestAnimationFrame(() => void this.present());
  }

  private async present(): Promise<void> {
    this.pending = 0;
    const changed = [...this.changed];
    this.changed.clear();
    for (const block of changed) block.shown.transferFromImageBitmap(await createImageBitmap(block.context.canvas));
  }

  private block(x: number, y: number): Block {
    const key = `${x} ${y}`;
    const known = this.blocks.get(key);
    if (known) return known;
    const width = Math.min(BLOCK, this.geometry.width - x);
    const height = Math.min(BLOCK, this.geometry.height - y);
    const canvas = document.createElement("canvas");
    canvas.width = width;
    canvas.height = height;
    const context = new OffscreenCanvas(width, height).getContext("2d");
    const shown = canvas.getContext("bitmaprenderer");
    if (!context || !shown) throw new Error("the browser has no canvas");
    const { resolution, origin_x, origin_y } = this.geometry;
    const topEdge = origin_y + (this.geometry.height - y) * resolution;
    const leftEdge = origin_x + x * resolution;
    const bounds = L.latLngBounds(
      [topEdge - height * resolution, leftEdge],
      [topEdge, leftEdge + width * resolution],
    );
    const overlay = new CanvasOverlay(canvas, bounds, this.pane);
    if (this.shown) overlay.addTo(this.map);
    const block = { context, shown, overlay, costs: new Uint8Array(width * height).fill(255), width, height };
    this.blocks.set(key, block);
    return block;
  }

  /** Take over the theme's colours. */
  recolour(): void {
    this.colours = costColours();
    for (const block of this.blocks.values()) this.paint(block, 0, 0, block.width, block.height);
  }

  show(shown: boolean): void {
    this.shown = shown;
    for (const { overlay } of this.blocks.values()) {
      if (shown) overlay.addTo(this.map);
      else overlay.remove();
    }
  }

  remove(): void {
    for (const { overlay } of this.blocks.values()) overlay.remove();
    this.blocks.clear();
  }
}
