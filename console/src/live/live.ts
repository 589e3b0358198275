// The state of everything as the stream of events tells it, and who wants to know when it changes.
import type { AuditEntry, Hello, Kind, MapInfo, Tile, Values } from "../api/types";
import { type Connection, Stream, type StreamEvent } from "./stream";

/** What one can listen to: a kind of entry, or one of those that have no id. */
export type Topic = Kind | "map" | "costmap" | "record" | "connection" | "time" | "ready";

const KINDS: readonly Kind[] = [
  "zone", "area", "node", "alert", "place", "robot", "pose", "path", "obstacles", "scan", "vitals",
];
const RECORDS_MAX = 500;

/** Data older than this (ms) is shown as old. */
export const OLD_MS = 2_000;

/** What robots say; of `robot` the planner says a part. */
const SAID_BY_ROBOT: ReadonlySet<Kind> = new Set(["pose", "obstacles", "scan", "vitals"]);

/** Modes in which a robot moves that is not enabled. */
const MANEUVERS: ReadonlySet<string> = new Set(["EGRESS", "DOCK", "TELEOP"]);

type Entries = { readonly [K in Kind]: Map<string, Values[K]> };

const makeEntries = (): Entries => ({
  zone: new Map(), area: new Map(), node: new Map(), alert: new Map(), place: new Map(),
  robot: new Map(), pose: new Map(), path: new Map(), obstacles: new Map(), scan: new Map(), vitals: new Map(),
});

export class Live {
  readonly of: Entries = makeEntries();
  readonly tiles = new Map<string, Tile>();
  map: MapInfo | null = null;
  site = "";
  /** Newest first. */
  records: AuditEntry[] = [];
  connection: Connection = "connecting";
  /** The state of the time of connecting is complete. */
  ready = false;
  /** The server's time (s since the epoch). */
  serverTime = 0;
  private heardAt: number;
  /** When each robot last said something itself: the planner goes on about one that is off. */
  private readonly signs = new Map<string, number>();
  /** What comes is news; before, it is what was said while nobody listened. */
  private hasCaughtUp = false;
  private readonly listeners = new Map<Topic, Set<(key: string) => void>>();
  private readonly stream: Stream;

  constructor(
    address: string,
    private readonly now: () => number = () => performance.now(),
  ) {
    this.heardAt = now();
    this.stream = new Stream(address, {
      onEvent: (event) => this.take(event),
      onConnection: (connection) => {
        this.connection = connection;
        this.tell("connection", connection);
      },
    });
  }

  start(): void {
    this.stream.start();
  }

  close(): void {
    this.stream.close();
  }

  /** Ask for the scans of a robot, or for none. */
  watchScan(robot: string | null): void {
    this.of.scan.clear();
    this.stream.ask(robot === null ? "" : `?scan=${encodeURIComponent(robot)}`);
    this.tell("scan", "");
  }

  /** Call `listener` with the key of whatever changes in a topic; returns how to stop that. */
  on(topics: readonly Topic[], listener: (key: string) => void): () => void {
    for (const topic of topics) {
      const known = this.listeners.get(topic) ?? new Set();
      this.listeners.set(topic, known.add(listener));
    }
    return () => {
      for (const topic of topics) this.listeners.get(topic)?.delete(listener);
    };
  }

  /** Whether nothing was heard from the console's server for too long: then nothing that is shown is known to hold. */
  get old(): boolean {
    return this.silence > OLD_MS;
  }

  /** How long ago (ms) the console's server was heard last. */
  get silence(): number {
    return this.now() - this.heardAt;
  }

  /** How long ago (ms) a robot was heard; Infinity: not since this page listens. */
  robotAge(id: string): number {
    return this.now() - (this.signs.get(id) ?? -Infinity);
  }

  /** Whether what is known of a robot is too old to be shown as present. */
  oldRobot(id: string): boolean {
    return this.old || this.robotAge(id) > OLD_MS;
  }

  /** Whether a robot is known to be stopped: it was heard just now, is not enabled, and makes no maneuver. */
  isStopped(id: string): boolean {
    const state = this.of.robot.get(id)?.state;
    return state?.enabled === false && !MANEUVERS.has(state.mode) && !this.oldRobot(id);
  }

  /** Apply one event of the stream. */
  take({ event, data }: StreamEvent): void {
    const value: unknown = JSON.parse(data);
    this.heardAt = this.now();
    if (isKind(event)) {
      this.takeEntry(event, value as { id: string; value: never });
      return;
    }
    switch (event) {
      case "hello":
        this.hello(value as Hello);
        break;
      case "ready":
        this.ready = this.hasCaughtUp = true;
        this.tell("ready", "");
        break;
      case "time":
        this.serverTime = (value as { stamp: number }).stamp;
        this.tell("time", "");
        break;
      case "map":
        this.map = value as MapInfo;
        this.tell("map", "");
        break;
      case "costmap": {
        const tile = value as Tile;
        const key = `${tile.column} ${tile.row}`;
        this.tiles.set(key, tile);
        this.tell("costmap", key);
        break;
      }
      case "record":
        this.records = [value as AuditEntry, ...this.records].slice(0, RECORDS_MAX);
        this.tell("record", "");
        break;
      default: // of a newer server
    }
  }

  private takeEntry<K extends Kind>(kind: K, entry: { id: string; value: Values[K] | null }): void {
    if (this.hasCaughtUp && this.isSign(kind, entry)) this.signs.set(entry.id, this.now());
    if (entry.value === null) this.of[kind].delete(entry.id);
    else this.of[kind].set(entry.id, entry.value);
    this.tell(kind, entry.id);
  }

  /** Whether an entry tells that its robot lives: what it said, or a state of it that is another one than before. */
  private isSign(kind: Kind, { id, value }: { readonly id: string; readonly value: unknown }): boolean {
    if (kind !== "robot") return value !== null && SAID_BY_ROBOT.has(kind);
    const state = (value as Values["robot"] | null)?.state;
    return !!state && JSON.stringify(state) !== JSON.stringify(this.of.robot.get(id)?.state);
  }

  private hello(hello: Hello): void {
    this.site = hello.site;
    this.hasCaughtUp = false;
    if (!hello.fresh) return;
    this.ready = false;
    this.tiles.clear();
    this.records = [];
    for (const kind of KINDS) {
      this.of[kind].clear();
      this.tell(kind, "");
    }
    this.tell("costmap", "");
  }

  private tell(topic: Topic, key: string): void {
    for (const listener of this.listeners.get(topic) ?? []) listener(key);
  }
}

function isKind(event: string): event is Kind {
  return (KINDS as readonly string[]).includes(event);
}
