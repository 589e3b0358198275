// What the page asks the thread that makes pictures of costs, and what it gets.

export type Work =
  | { readonly kind: "begin"; readonly width: number; readonly height: number; readonly block: number }
  | { readonly kind: "colours"; readonly colours: Uint32Array }
  | {
    readonly kind: "draw";
    /** In base64 as in the stream, or whole. */
    readonly png: Blob | string;
    readonly column: number;
    readonly top: number;
    /** The cost that each grey of the picture means. */
    readonly costs: Uint8Array;
  };

/** The picture of the block of cells whose first one is (x, y), counted from the map's upper left corner. */
export interface Drawn {
  readonly x: number;
  readonly y: number;
  readonly picture: ImageBitmap;
}
