// Server-sent events by `fetch`: unlike `EventSource`, it says when the login has ended, and keeps the last id across
// connections that were refused.

export interface StreamEvent {
  readonly event: string;
  readonly data: string;
  readonly id: string | null;
}

/** Splits a stream's text into events (WHATWG HTML, 9.2.6); pieces may end anywhere. */
export class EventParser {
  private rest = "";
  private event = "";
  private data: string[] = [];
  private id: string | null = null;

  /** Take a piece of the stream; return the events that it completes. */
  push(piece: string): StreamEvent[] {
    const found: StreamEvent[] = [];
    const text = this.rest + piece;
    const lines = text.includes("\r") ? text.split(/\r\n|\n|\r(?!$)/) : text.split("\n");
    this.rest = lines.pop() ?? "";
    for (const line of lines) {
      if (line === "") {
        if (this.data.length > 0) found.push({ event: this.event || "message", data: this.data.join("\n"), id: this.id });
        this.event = "";
        this.data = [];
        this.id = null;
        continue;
      }
      const colon = line.indexOf(":");
      if (colon === 0) continue;
      const field = colon < 0 ? line : line.slice(0, colon);
      const value = colon < 0 ? "" : line.slice(colon + 1).replace(/^ /, "");
      if (field === "event") this.event = value;
      else if (field === "data") this.data.push(value);
      else if (field === "id") this.id = value;
    }
    return found;
  }
}

/** `waiting`: as many windows of this browser read events as may. */
export type Connection = "connecting" | "waiting" | "open" | "lost" | "refused";

export interface StreamHandlers {
  readonly onEvent: (event: StreamEvent) => void;
  /** `refused`: the login has ended, and only a new one helps. */
  readonly onConnection: (connection: Connection) => void;
}

const FIRST_WAIT_MS = 500;
const LONGEST_WAIT_MS = 5_000;
/** Each second there is an event `time`: after so long without any, the connection is dead, whatever TCP says. */
const SILENCE_MS = 6_000;

/** A browser has six connections to a host, in all its windows: so many read events, which leaves one to a stop. */
const READERS = 5;
const LOOK_MS = 1_000;

/** Return what ends the right to be one of these, or null if there is none. A browser that can't count lets all. */
async function oneOfReaders(): Promise<(() => void) | null> {
  const [page] = performance.getEntriesByType("navigation") as PerformanceNavigationTiming[];
  if (!("locks" in navigator) || !page?.nextHopProtocol.startsWith("http/1")) return () => {}; // HTTP/2 needs one connection
  for (let number = 0; number < READERS; number++) {
    const free = await new Promise<(() => void) | null>((resolve) => {
      const until = (lock: Lock | null): Promise<void> => new Promise((end) => (lock ? resolve(end) : (resolve(null), end())));
      navigator.locks.request(`fognav-events-${number}`, { ifAvailable: true }, until).catch(() => resolve(null));
    });
    if (free) return free;
  }
  return null;
}

/** Return how long to wait before the next try (ms): doubled each time, and spread, so that not all come at once. */
export function waitBefore(attempt: number, random: number): number {
  return Math.min(LONGEST_WAIT_MS, FIRST_WAIT_MS * 2 ** attempt) * (0.5 + random / 2);
}

/** Reads the stream until it is closed, and connects again, from the last id, whenever it ends. */
export class Stream {
  private lastId: string | null = null;
  private closed = false;
  private attempt = 0;
  private reading: AbortController | null = null;
  private wake: (() => void) | null = null;
  private free: (() => void) | null = null;
  private query = "";

  constructor(
    private readonly address: string,
    private readonly handlers: StreamHandlers,
  ) {}

  start(): void {
    document.addEventListener("visibilitychange", this.looked);
    void this.run();
  }

  /** Hidden windows leave their connection to those where somebody may stop. */
  private readonly looked = (): void => {
    this.attempt = 0;
    if (document.hidden) this.reading?.abort();
    this.wake?.();
  };

  /** Ask for other events, such as the scan of a robot: connects anew from the last id. */
  ask(query: string): void {
    if (query === this.query) return;
    this.query = query;
    this.attempt = 0;
    this.reading?.abort();
    this.wake?.();
  }

  close(): void {
    this.closed = true;
    document.removeEventListener("visibilitychange", this.looked);
    this.reading?.abort();
    this.leave();
    this.wake?.();
  }

  private leave(): void {
    this.free?.();
    this.free = null;
  }

  private async run(): Promise<void> {
    while (!this.closed) {
      const query = this.query;
      if (document.hidden) {
        this.handlers.onConnection("connecting");
        this.leave();
        await new Promise<void>((resolve) => (this.wake = resolve));
        continue;
      }
      if (!this.free) {
        this.free = await oneOfReaders();
        if (!this.free) {
          this.handlers.onConnection("waiting");
          await this.pause(LOOK_MS);
        }
        continue;
      }
      this.handlers.onConnection("connecting");
      if (!(await this.readOnce())) {
        this.close();
        this.handlers.onConnection("refused");
        return;
      }
      if (this.closed) return;
      if (query !== this.query || document.hidden) continue;
      this.handlers.onConnection("lost");
      await this.pause(waitBefore(this.attempt++, Math.random()));
    }
    this.leave();
  }

  private pause(ms: number): Promise<void> {
    return new Promise((resolve) => {
      const timer = setTimeout(resolve, ms);
      this.wake = () => {
        clearTimeout(timer);
        resolve();
      };
    });
  }

  /** Read one connection to its end; false if it was refused for want of a login. */
  private async readOnce(): Promise<boolean> {
    const reading = new AbortController();
    this.reading = reading;
    let silence = setTimeout(() => reading.abort(), SILENCE_MS);
    try {
      const headers: Record<string, string> = { Accept: "text/event-stream" };
      if (this.lastId !== null) headers["Last-Event-ID"] = this.lastId;
      const response = await fetch(this.address + this.query, {
        headers,
        signal: reading.signal,
        cache: "no-store",
        credentials: "same-origin",
      });
      if (response.status === 401 || response.status === 403) return false;
      if (!response.ok || response.body === null) return true;
      const reader = response.body.getReader();
      const decoder = new TextDecoder();
      const parser = new EventParser();
      this.handlers.onConnection("open");
      for (;;) {
        const { value, done } = await reader.read();
        if (done) return true;
        clearTimeout(silence);
        silence = setTimeout(() => reading.abort(), SILENCE_MS);
        this.attempt = 0;
        for (const event of parser.push(decoder.decode(value, { stream: true }))) {
          this.handlers.onEvent(event);
          // An event without an id (`time`) leaves the last one as it is.
          if (event.id !== null) this.lastId = event.id;
        }
      }
    } catch {
      return true; // broken, or silent for too long: the caller connects again
    } finally {
      clearTimeout(silence);
    }
  }
}
