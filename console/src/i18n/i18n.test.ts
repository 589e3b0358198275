import { expect, test } from "vitest";
import { REASONS } from "../reasons";
import { fill, preferred, texts } from "./i18n";

const names = (text: string): string[] => [...text.matchAll(/\{(\w+)\}/g)].map((found) => found[1] ?? "").sort();

test("every text exists in every language, with the same values in it", () => {
  for (const [key, english] of Object.entries(texts.en)) {
    const portuguese = texts.pt[key as keyof typeof texts.en];
    expect(portuguese, key).not.toBe("");
    expect(names(portuguese), key).toEqual(names(english));
  }
});

test("a remedy of a reason exists in both languages or in none", () => {
  for (const [code, { pt, remedy, remedyPt }] of Object.entries(REASONS)) {
    expect(pt, code).not.toBe("");
    expect(remedy === "", code).toBe(remedyPt === "");
  }
});

test("the language is the chosen one, else the first of the browser's that exists", () => {
  expect(preferred("pt", ["en"])).toBe("pt");
  expect(preferred(null, ["fr-FR", "pt-BR", "en"])).toBe("pt");
  expect(preferred("xx", ["de"])).toBe("en");
});

test("a value that is missing stays visible as its name", () => {
  expect(fill("{robot} stops", {})).toBe("{robot} stops");
});
