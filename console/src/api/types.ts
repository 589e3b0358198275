// The messages of REST and of the stream of events, by the names that the services' OpenAPI document gives them.
import type { components } from "./schema";

type Schemas = components["schemas"];

/** What is sent: only what has no default must be given. */
type Sent<T, Needed extends keyof T = never> = Pick<T, Needed> & Partial<T>;

export type Alert = Schemas["Alert"];
export type AppliedChange = Schemas["AppliedChange"];
export type AreaBody = Sent<Schemas["AreaBody"]>;
export type AreaState = "blocked" | "clear" | "unknown";
export type AuditEntry = Schemas["AuditEntry"];
export type BlockedWay = Schemas["BlockedWay"];
export type CommandBody = Sent<Schemas["CommandBody"], "kind">;
export type CommandOutcome = Schemas["CommandOutcome"];
export type DryRunBody = Omit<Sent<Schemas["DryRunBody"]>, "zones"> & { readonly zones?: readonly ZoneBody[] };
export type DryRunOutcome = Schemas["DryRunOutcome"];
export type FloorEntry = Schemas["FloorEntry"];
export type FloorStop = Schemas["FloorStop"];
export type FloorView = Schemas["FloorView"];
export type GoalBody = Sent<Schemas["GoalBody"]>;
export type GoalView = Schemas["GoalView"];
export type MapGeometry = Schemas["MapGeometry"];
export type MapInfo = Schemas["MapInfo"];
export type MapPreview = Schemas["MapPreview"];
export type MapState = Schemas["MapState"];
export type OpenVisit = Schemas["OpenVisit"];
export type OutOfService = Schemas["OutOfService"];
export type OverrideBody = Schemas["OverrideBody"];
export type PeriodView = Schemas["PeriodView"];
export type Place = Schemas["PlaceView"];
export type PlanReply = Schemas["PlanReply"];
export type PlanView = Schemas["PlanView"];
export type Pose = Schemas["Pose"];
export type PublicPlace = Schemas["PublicPlace"];
export type RobotPose = Schemas["RobotPose"];
export type RobotState = Schemas["RobotState"];
export type ScheduleBody = Omit<Sent<Schemas["ScheduleBody"], "robot" | "weekly">, "mission"> & {
  readonly mission: Omit<Sent<Schemas["MissionBody"]>, "stops"> & { readonly stops: readonly StopBody[] };
};
export type ScheduledMission = Schemas["ScheduleView"];
export type ServiceBody = Sent<Schemas["ServiceBody"], "reason">;
export type SetView = Schemas["SetView"];
export type Shape = Schemas["Zone"]["shape"];
export type StopBody = Sent<Schemas["StopBody"]>;
export type TimelineEntry = Schemas["TimelineEntry"];
export type Visit = Schemas["VisitView"];
export type VisitBody = Schemas["VisitBody"];
export type Vitals = Schemas["VitalsView"];
export type Zone = Schemas["Zone"];
export type ZoneSourceView = Schemas["ZoneSourceView"];
export type ZoneBody = Sent<Schemas["ZoneBody"], "kind" | "shape">;

/** A point of the floor in metres: x to the right, y up. */
export type Point = readonly [number, number];

export type Role = "viewer" | "operator" | "admin" | "guest";

/** Who is logged in. */
export interface Session {
  readonly name: string;
  readonly role: Role;
}

/** A sensor node's or source's health; with a place on the floor if the site says where it hangs. */
export type NodeValue = Schemas["NodeView"] & {
  /** When it was heard last (s since the epoch, the server's clock); null: never. */
  readonly heard: number | null;
  readonly x?: number;
  readonly y?: number;
  readonly theta?: number;
  readonly sonars?: readonly { readonly angle: number; readonly range_limit: number }[];
};

/** What the map shows of an area. Confirmed: of its latest state, which the hazard-aggregator stands by. */
export interface ShownArea {
  readonly state: AreaState;
  readonly penalty: number;
  readonly confirmed: boolean;
}

/** An area; `on_map` is null while the map-service is silent, and an older server does not tell it. */
export type AreaView = Schemas["AreaView"] & { readonly on_map?: ShownArea | null };

export interface PathValue {
  readonly points: readonly Point[];
  readonly released_length: number;
  readonly plan_id: number;
}

/** A robot's view of what its lidar sees and the map does not contain. */
export interface ObstaclesValue {
  readonly points: readonly Point[];
  readonly stamp: number;
}

/** The last turn of a robot's lidar: points of the floor (m). */
export interface ScanValue {
  readonly points: readonly Point[];
}

/** What the stream has under an id, by the event's name. */
export interface Values {
  zone: Zone & { readonly active: boolean };
  area: AreaView;
  node: NodeValue;
  alert: Alert;
  place: Place;
  robot: Omit<Schemas["RobotView"], "pose">;
  pose: RobotPose;
  path: PathValue;
  obstacles: ObstaclesValue;
  scan: ScanValue;
  vitals: Vitals;
}

export type Kind = keyof Values;

/** A window of the costmap: `row` counts from the map's lower edge, `png` is grey in base64, its first row the top. */
export interface Tile {
  readonly epoch: number;
  readonly seq: number;
  readonly column: number;
  readonly row: number;
  readonly width: number;
  readonly height: number;
  readonly png: string;
}

export interface Hello {
  readonly run: string;
  readonly fresh: boolean;
  readonly site: string;
}
