// A field for a number in metres or degrees, which may be empty while somebody types.
import { t } from "../i18n/i18n";
import type { Key } from "../i18n/i18n";

interface Props {
  readonly label: Key;
  readonly value: string;
  readonly onValue: (text: string) => void;
  readonly placeholder?: string;
}

export function NumberField({ label, value, onValue, placeholder }: Props): preact.JSX.Element {
  return (
    <label>{t(label)}
      <input
        type="number" step="any" inputMode="decimal" value={value} placeholder={placeholder}
        onInput={(event) => onValue(event.currentTarget.value)}
      />
    </label>
  );
}

/** Return the number that a field holds; null if it holds none. */
export function numberOf(text: string): number | null {
  if (text.trim() === "") return null;
  const value = Number(text);
  return Number.isFinite(value) ? value : null;
}

export const degrees = (radians: number): number => (radians * 180) / Math.PI;
export const radians = (angle: number): number => (angle * Math.PI) / 180;
