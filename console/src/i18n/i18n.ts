// Texts in the user's language. Each language has all keys: TypeScript checks it.
import { en } from "./en";
import { pt } from "./pt";

export type Key = keyof typeof en;
export type Language = "en" | "pt";

export const texts: Readonly<Record<Language, Readonly<Record<Key, string>>>> = { en, pt };

const STORED = "fognav.language";
let current: Language = "en";

/** Return the language to begin with: the one chosen before, else the browser's. */
export function preferred(stored: string | null, languages: readonly string[]): Language {
  if (stored === "en" || stored === "pt") return stored;
  const known = languages.map((name) => name.slice(0, 2).toLowerCase()).find((name) => name === "en" || name === "pt");
  return known === "pt" ? "pt" : "en";
}

export function language(): Language {
  return current;
}

export function setLanguage(to: Language, keep = true): void {
  current = to;
  document.documentElement.lang = to;
  if (keep) localStorage.setItem(STORED, to);
}

/** Take over the stored or the browser's language. */
export function startLanguage(): void {
  setLanguage(preferred(localStorage.getItem(STORED), navigator.languages), false);
}

/** Return a text, its `{names}` replaced by values. */
export function t(key: Key, values: Readonly<Record<string, string | number>> = {}): string {
  return fill(texts[current][key], values);
}

/** Return the text of a key that is made of data, such as a reason's identifier; null where there is none. */
export function maybe(key: string): string | null {
  return key in texts[current] ? texts[current][key as Key] : null;
}

export function fill(text: string, values: Readonly<Record<string, string | number>>): string {
  return text.replace(/\{(\w+)\}/g, (whole, name: string) => (name in values ? String(values[name]) : whole));
}
