// Makes the pictures of costmap and plan, away from the thread that draws the page: of a tile's PNG comes the picture of
// the block of cells in which it lies, which the page only has to show.
import type { Drawn, Work } from "./cost-work";

interface Block {
  readonly context: OffscreenCanvasRenderingContext2D;
  /** The costs, row 0 at the top, for another theme's colours. */
  readonly costs: Uint8Array;
  readonly x: number;
  readonly y: number;
  readonly width: number;
  readonly height: number;
}

interface Window {
  readonly left: number;
  readonly top: number;
  readonly right: number;
  readonly bottom: number;
}

const scope = self as unknown as { postMessage: (drawn: Drawn, transfer: Transferable[]) => void };
const blocks = new Map<string, Block>();
const scratch = new OffscreenCanvas(1, 1);
const scratchContext = scratch.getContext("2d", { willReadFrequently: true });
let size = { width: 0, height: 0, block: 1 };
let colours: Uint32Array = new Uint32Array(256);
/** Pictures are decoded one after the other: a later tile of a block must not be overtaken. */
let before = Promise.resolve();
let waiting = 0;
const changed = new Set<Block>();

self.onmessage = ({ data }: MessageEvent<Work>): void => {
  waiting++;
  before = before
    .then(() => work(data))
    .catch((error: unknown) => console.warn("a part of the map can't be drawn:", error))
    .then(async () => {
      // Of many tiles at once, as in the beginning, each block is handed over once.
      if (--waiting === 0) await present();
    });
};

async function present(): Promise<void> {
  const due = [...changed];
  changed.clear();
  for (const { context, x, y } of due) {
    const picture = await createImageBitmap(context.canvas);
    scope.postMessage({ x, y, picture }, [picture]);
  }
}

async function work(asked: Work): Promise<void> {
  if (asked.kind === "begin") size = asked;
  else if (asked.kind === "colours") {
    colours = asked.colours;
    for (const block of blocks.values()) paint(block, { left: 0, top: 0, right: block.width, bottom: block.height });
  } else await draw(asked);
}

/** Draw a grey PNG whose first pixel is the cell (column, top), counted from the map's upper edge. */
async function draw({ png, column, top, costs }: Extract<Work, { kind: "draw" }>): Promise<void> {
  const blob = typeof png === "string" ? new Blob([Uint8Array.from(atob(png), (char) => char.charCodeAt(0))]) : png;
  const image = await createImageBitmap(blob, { colorSpaceConversion: "none", premultiplyAlpha: "none" });
  const { width, height } = image;
  scratch.width = width;
  scratch.height = height;
  scratchContext?.drawImage(image, 0, 0);
  image.close();
  const pixels = scratchContext?.getImageData(0, 0, width, height).data;
  if (!pixels) throw new Error("the browser has no canvas");
  const window = { left: column, top, right: column + width, bottom: top + height };
  for (let y = top - (top % size.block); y < window.bottom; y += size.block) {
    for (let x = column - (column % size.block); x < window.right; x += size.block) {
      const block = blockAt(x, y);
      paint(block, fill(block, pixels, costs, window));
    }
  }
}

/** Copy what of a window lies in a block; return where, from the block's corner. */
function fill(block: Block, pixels: Uint8ClampedArray, costs: Uint8Array, window: Window): Window {
  const { x, y } = block;
  const left = Math.max(window.left, x);
  const top = Math.max(window.top, y);
  const right = Math.min(window.right, x + block.width);
  const bottom = Math.min(window.bottom, y + block.height);
  for (let row = top; row < bottom; row++) {
    let from = ((row - window.top) * (window.right - window.left) + left - window.left) * 4;
    let to = (row - y) * block.width + left - x;
    for (let cell = left; cell < right; cell++, from += 4, to++) block.costs[to] = costs[pixels[from] ?? 0] ?? 0;
  }
  return { left: left - x, top: top - y, right: right - x, bottom: bottom - y };
}

function paint(block: Block, { left, top, right, bottom }: Window): void {
  const width = right - left;
  const height = bottom - top;
  if (width <= 0 || height <= 0) return;
  const image = block.context.createImageData(width, height);
  const pixels = new Uint32Array(image.data.buffer);
  for (let row = 0; row < height; row++) {
    const from = (top + row) * block.width + left;
    for (let cell = 0; cell < width; cell++) pixels[row * width + cell] = colours[block.costs[from + cell] ?? 0] ?? 0;
  }
  block.context.putImageData(image, left, top);
  changed.add(block);
}

function blockAt(x: number, y: number): Block {
  const key = `${x} ${y}`;
  const known = blocks.get(key);
  if (known) return known;
  const width = Math.min(size.block, size.width - x);
  const height = Math.min(size.block, size.height - y);
  const context = new OffscreenCanvas(width, height).getContext("2d");
  if (!context) throw new Error("the browser has no canvas");
  const block = { context, costs: new Uint8Array(width * height).fill(255), x, y, width, height };
  blocks.set(key, block);
  return block;
}
