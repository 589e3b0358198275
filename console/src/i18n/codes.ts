// What programs tell by an identifier, in the user's language. Their own sentences are English, and have figures: they are
// kept in English, and wherever there is no identifier.
import type { Problem } from "../api/client";
import { REASONS } from "../reasons";
import { language } from "./i18n";
import { PT_CODES } from "./pt-codes";

/** Return what an identifier means; the sentence that came with it where it has no text in the language. */
export function said(code: string | null | undefined, sentence: string): string {
  if (language() === "en" || !code) return sentence;
  return PT_CODES[code] ?? REASONS[code]?.pt ?? sentence;
}

/** Return several sentences as one; if one of them has no text in the language, all as they came. */
export function saidAll(codes: readonly string[], sentences: string): string {
  const texts = codes.map((code) => said(code, ""));
  return texts.length === 0 || texts.includes("") ? sentences : texts.join("; ");
}

/** Return why an area has its state; `by` is the node or source that decided. */
export const saidCause = (code: string, by: string | null, sentence: string): string => {
  const text = said(code, "");
  return text === "" ? sentence : by === null ? text : `${by}: ${text}`;
};

/** Return a problem's sentence. The refusal of a robot or of the planner says more than that it was refused. */
export function saidProblem({ code, detail, extra }: Problem): string {
  const refusal = typeof extra.refusal === "string" ? extra.refusal : "";
  const causes = Array.isArray(extra.causes) ? extra.causes.filter((each): each is string => typeof each === "string") : [];
  const text = said(refusal || code, detail);
  const because = text === detail ? "" : saidAll(causes, "");
  return because === "" ? text : `${text.replace(/\.$/, "")}: ${because}`;
}
