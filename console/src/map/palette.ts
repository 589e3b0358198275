// The map's colours, from the style sheet's variables, so that they follow the theme.

const probe = document.createElement("canvas").getContext("2d", { willReadFrequently: true });

/** Return the value of a variable of the style sheet. */
export function colour(name: string): string {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

function rgba(css: string): readonly [number, number, number, number] {
  if (!probe) return [0, 0, 0, 255];
  probe.clearRect(0, 0, 1, 1);
  probe.fillStyle = css;
  probe.fillRect(0, 0, 1, 1);
  const [r = 0, g = 0, b = 0, a = 255] = probe.getImageData(0, 0, 1, 1).data;
  return [r, g, b, a];
}

export const FREE = 0;
export const LETHAL = 254;
const INSCRIBED = 253;
export const UNKNOWN = 255;

/** Return the colour of each of the 256 costs, as pixels of an `ImageData` read as 32-bit numbers. */
export function costColours(): Uint32Array {
  const bytes = new Uint8ClampedArray(256 * 4);
  const [free, near, blocked, wall, unknown] = ["floor", "cost-near", "cost-inscribed", "wall", "unknown-cell"].map(
    (name) => rgba(colour(name)),
  );
  for (let cost = 0; cost < 256; cost++) {
    const share = cost / INSCRIBED;
    for (let channel = 0; channel < 4; channel++) {
      const value =
        cost === UNKNOWN ? unknown?.[channel]
        : cost === LETHAL ? wall?.[channel]
        : cost === INSCRIBED ? blocked?.[channel]
        : (free?.[channel] ?? 0) * (1 - share) + (near?.[channel] ?? 0) * share;
      bytes[cost * 4 + channel] = value ?? 0;
    }
  }
  return new Uint32Array(bytes.buffer);
}
