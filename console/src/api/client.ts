// Requests to the services' REST; an error is the problem document that the service sent (RFC 9457).

/** A refusal or failure: `code` identifies it, `detail` is the service's sentence, `extra` the rest of the document. */
export class Problem extends Error {
  constructor(
    readonly status: number,
    readonly code: string,
    readonly detail: string,
    readonly extra: Readonly<Record<string, unknown>> = {},
  ) {
    super(detail);
  }
}

export interface Answer<T> {
  readonly value: T;
  readonly etag: string | null;
}

export interface Options {
  readonly body?: unknown;
  readonly headers?: Readonly<Record<string, string>>;
  /** How long to wait, in ms. */
  readonly timeout?: number;
}

type Method = "GET" | "PUT" | "POST" | "PATCH" | "DELETE";

/** Send a request; throws a `Problem`, with the code `unreachable` if nobody answers. */
export async function request<T>(method: Method, path: string, options: Options = {}): Promise<Answer<T>> {
  const headers: Record<string, string> = { Accept: "application/json", ...options.headers };
  const init: RequestInit = { method, headers, credentials: "same-origin", cache: "no-store" };
  if (options.body !== undefined) {
    headers["Content-Type"] = "application/json";
    init.body = JSON.stringify(options.body);
  }
  init.signal = AbortSignal.timeout(options.timeout ?? 15_000);
  let response: Response;
  try {
    response = await fetch(`api/v1/${path}`, init);
  } catch {
    throw new Problem(0, "unreachable", "");
  }
  const text = await response.text();
  if (!response.ok) throw problemOf(response.status, text);
  return { value: (text === "" ? undefined : JSON.parse(text)) as T, etag: response.headers.get("ETag") };
}

/** Read a problem document; whatever else an error carries (a proxy's page) gives the status alone. */
export function problemOf(status: number, text: string): Problem {
  try {
    const found: unknown = JSON.parse(text);
    if (typeof found === "object" && found !== null) {
      const { type, title, detail, ...extra } = found as Record<string, unknown>;
      const code = typeof type === "string" ? type.replace(/^urn:fognav:/, "") : "";
      const sentence = typeof detail === "string" ? detail : typeof title === "string" ? title : "";
      return new Problem(status, code, sentence, extra);
    }
  } catch {
    // Not JSON: the status is all that is known.
  }
  return new Problem(status, "", `HTTP ${status}`);
}

export const robotPath = (robot: string, rest: string): string => `robots/${encodeURIComponent(robot)}/${rest}`;
