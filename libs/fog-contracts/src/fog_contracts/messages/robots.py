"""Missions, paths and refusals of the planner; state, observations and commands of a robot (zenoh, msgpack)."""

from enum import StrEnum
from typing import Annotated, Final, Literal, Self

from msgspec import Meta
from msgspec.structs import replace

from fog_contracts.messages.basics import (
    SENTENCE_MAX,
    AngularSpeed,
    Boot,
    Code,
    Codes,
    Count,
    Described,
    Epochs,
    Finite,
    Id,
    Message,
    Metres,
    PointXY,
    Pose,
    Radians,
    Reason,
    Seconds,
    Sent,
    Sentence,
    Speed,
    Stamp,
    Trace,
)
from fog_contracts.messages.fleet import OutOfService
from fog_contracts.messages.lifts import Berth, HandOver
from fog_contracts.messages.maps import Cause

PLAN_CODES = {
    0: "OK",
    203: "START_OUTSIDE_MAP",
    204: "GOAL_OUTSIDE_MAP",
    205: "START_OCCUPIED",
    206: "GOAL_OCCUPIED",
    207: "TIMEOUT",
    208: "NO_VALID_PATH",
}
"""Nav2's error codes of `ComputePathToPose`, with their names."""

PlanCode = Literal[0, 203, 204, 205, 206, 207, 208]
Points = Annotated[list[PointXY], Meta(max_length=100_000)]


class PlanRefusal(Described):
    """Why there is no path, closer than Nav2's code."""

    NO_MAP = "no_map", "the planner has no map yet"
    TOO_MANY_QUERIES = "too_many_queries", "the planner is busy"
    SEARCH_TOO_LONG = "search_too_long", "no path was found within the cells that a search may expand"
    START_OFF_MAP = "start_off_map", "the robot is off the map"
    START_CLOSED = "start_closed", "the robot is in a closed place"
    START_OBSTRUCTED = "start_obstructed", "the robot is on a wall, an obstacle or unknown space"
    GOAL_OFF_MAP = "goal_off_map", "the goal is off the map"
    GOAL_IN_WALL = "goal_in_wall", "the goal is in a wall"
    GOAL_UNKNOWN = "goal_unknown", "the goal is in unknown space"
    GOAL_NEAR_WALL = "goal_near_wall", "the goal is too near a wall for the robot"
    GOAL_CLOSED = "goal_closed", "the goal is in a closed place: `causes`, once they are known"
    GOAL_OBSTRUCTED = "goal_obstructed", "the goal is on or beside an obstacle that a robot sees"
    CUT_OFF = "cut_off", "every path is blocked; by what is not known yet"
    CUT_BY_WALLS = "cut_by_walls", "walls or unknown space lie between"
    CUT_BY_OBSTACLES = "cut_by_obstacles", "obstacles that robots see block every path"
    CUT_BY_PLACES = "cut_by_places", "areas or zones block every path: `causes`"


class Refusal(Message, frozen=True, kw_only=True):
    """Why there is no path: Nav2's code, a sentence, what blocks the path, and the nearest reachable point.

    `kind` identifies it closer than the code does (`PlanRefusal`); empty from an older planner.
    """

    code: PlanCode
    reason: Sentence
    kind: Code = ""
    causes: list[Cause] = []
    nearest: PointXY | None = None

    @property
    def name(self) -> str:
        """Nav2's name of the code."""
        return PLAN_CODES[self.code]


class PlanRequest(Message, frozen=True, kw_only=True):
    """Request for a path between two poses, without side effects."""

    start: Pose
    goal: Pose


class PlanReply(Message, frozen=True, kw_only=True):
    """A path (points at least 5 cm apart, frame `map`) with its length in metres, or the refusal.

    `retry_after`: the planner was too busy to look for a path; ask again after so many seconds.
    """

    points: Points = []
    length: Annotated[float, Meta(ge=0.0, le=1e6, extra={"unit": "m"})] = 0.0
    cost: Annotated[float, Meta(ge=0.0, le=1e12)] = 0.0
    map_epoch: Count = 0
    map_seq: Count = 0
    refusal: Refusal | None = None
    retry_after: Annotated[float, Meta(ge=0.0, le=3600.0, extra={"unit": "s"})] | None = None


class RobotGoal(Message, frozen=True, kw_only=True):
    """The mission of a robot; `pose` is null when it has none (cancelled or reached).

    `any_heading`: the robot may arrive with any heading, that of `pose` does not count. `out_of_service`: why it gets
    no mission; then `pose` is null, and `goal_id` empty if it never had one. `idle`: it goes where it stays without a
    mission, and is taken from there for any other.
    """

    goal_id: Annotated[str, Meta(max_length=64)]
    pose: Pose | None
    any_heading: bool = False
    idle: bool = False
    place: Id | None = None
    out_of_service: OutOfService | None = None
    stamp: Stamp = 0.0
    planner_epoch: Count = 0


class RobotRelease(Message, frozen=True, kw_only=True, omit_defaults=True):
    """How much of a path the robot may drive (m), twice a second: the path is still good on this version of the map.

    It keeps the path of this plan alive, and no other: a robot that does not have it hears nothing from its planner.
    `waits_for`: the robot that it lets pass, or whose place it waits for; left out when there is none.
    """

    plan_id: Count
    planner_epoch: Count
    released_length: Annotated[float, Meta(ge=0.0, le=1e6, extra={"unit": "m"})]
    map_epoch: Count
    map_seq: Count
    sent: Sent | None = None
    waits_for: Id | None = None


class BlockedWay(Message, frozen=True, kw_only=True):
    """Something closes a robot's way, and there is another: what was chosen, and what both cost.

    `standing_s`: for how long the oldest of the `causes` has been there. `expected_s`: the expected delay of a robot
    that waits for them to end, for `limit_s` at most, and then goes round; `detour_s`: that of going round at once.
    """

    choice: Literal["wait", "detour"]
    causes: list[Cause]
    standing_s: Annotated[float, Meta(ge=0.0, le=1e9, extra={"unit": "s"})]
    expected_s: Annotated[float, Meta(ge=0.0, le=1e9, extra={"unit": "s"})]
    detour_s: Annotated[float, Meta(ge=0.0, le=1e9, extra={"unit": "s"})]
    limit_s: Annotated[float, Meta(ge=0.0, le=1e9, extra={"unit": "s"})] | None = None
    reason: Sentence = ""


class RobotPath(Message, frozen=True, kw_only=True):
    """The path to the goal, or why there is none; published once per plan, and again until the robot names its plan.

    To a robot whose `profile` lets it plan for itself it is not repeated. `points` are the corners, joined by straight
    lines (`fog_contracts.geometry.sampled` puts points between them). The robot may drive the first `released_length`
    metres without hearing from the planner again; `RobotRelease` extends that while all is well. `blocked_way`: why the
    path leads round something, or ends before it; it is not released to its end then.
    """

    plan_id: Count
    planner_epoch: Count
    goal_id: Annotated[str, Meta(max_length=64)]
    points: Points
    map_epoch: Count
    map_seq: Count
    released_length: Annotated[float, Meta(ge=0.0, le=1e6, extra={"unit": "m"})]
    goal_theta: Radians | None = None
    refusal: Refusal | None = None
    blocked_way: BlockedWay | None = None
    waits_for: Id | None = None
    traces: list[Trace] = []
    stamp: Stamp = 0.0
    sent: Sent | None = None

    def after(self, release: RobotRelease) -> "RobotPath":
        """Return the path with a release of its plan; that of another plan changes nothing."""
        if (release.planner_epoch, release.plan_id) != (self.planner_epoch, self.plan_id):
            return self
        return replace(
            self,
            released_length=release.released_length,
            map_epoch=release.map_epoch,
            map_seq=release.map_seq,
            waits_for=release.waits_for,
        )


class RobotPose(Message, frozen=True, kw_only=True):
    """A robot's estimated pose and twist; `covariance` is row-major 3 x 3 over (x, y, theta).

    `clock` is the agent's own monotonic clock, which tells how late a pose is; 0: it does not say.
    """

    x: Metres
    y: Metres
    theta: Radians
    covariance: Annotated[list[Finite], Meta(min_length=9, max_length=9)]
    v: Speed
    w: AngularSpeed
    radius: Annotated[float, Meta(gt=0.0, le=2.0, extra={"unit": "m"})]
    height: Annotated[float, Meta(gt=0.0, le=3.0, extra={"unit": "m"})]
    stamp: Stamp
    localized: bool = True
    clock: Seconds = 0.0


Mode = Literal["INIT", "NORMAL", "DEGRADED", "HOLD", "PROTECTIVE_STOP", "FAULT", "EGRESS", "DOCK", "TELEOP"]


class LoopHealth(Message, frozen=True, kw_only=True):
    """How well the agent's loops keep their periods (seconds) since its start.

    `late_stops`: protective stops that a delay of its computer explains; they do not count towards a fault.
    """

    control_p99_s: Finite = 0.0
    stream_p99_s: Finite = 0.0
    late: Count = 0
    late_stops: Count = 0


Charging = Literal["no", "reconditioning", "bulk", "trickle", "waiting", "fault"]
"""What a charger does; `waiting`: it is connected and gives no current."""


class Power(Message, frozen=True, kw_only=True):
    """A robot's battery and charger as its base measures them; None for what it does not measure.

    `current_a` is positive into the battery.
    """

    voltage_v: Annotated[Finite, Meta(extra={"unit": "V"})] | None = None
    current_a: Annotated[Finite, Meta(extra={"unit": "A"})] | None = None
    charge_ah: Annotated[Finite, Meta(extra={"unit": "Ah"})] | None = None
    capacity_ah: Annotated[Finite, Meta(extra={"unit": "Ah"})] | None = None
    temperature_c: Annotated[Finite, Meta(extra={"unit": "°C"})] | None = None
    charging: Charging | None = None


Strength = Annotated[int, Meta(ge=0, le=4095)]

ProfileName = Literal["default", "full", "fog"]
"""How a robot navigates: on its own; on its own with the fog's hazards; or by the fog's map and paths."""


class ReasonCode(StrEnum):
    """What is the matter with a robot, for logs, metrics, tests and programs; the sentence beside it is for people."""

    # base and guardian
    BASE_FAULT = "base_fault"
    BUMPER = "bumper"
    CLIFF = "cliff"
    WHEEL_DROP = "wheel_drop"
    GUARDIAN_LOST = "guardian_lost"
    GUARDIAN_SILENT = "guardian_silent"
    WHEELS_HELD = "wheels_held"
    WHEELS_DIFFER = "wheels_differ"
    ON_DOCK = "on_dock"
    BATTERY_LOW = "battery_low"
    CHARGER_FAULT = "charger_fault"
    # lidar
    LIDAR_SILENT = "lidar_silent"
    SCAN_MISSING = "scan_missing"
    LIDAR_REPEATS = "lidar_repeats"
    LIDAR_EMPTY = "lidar_empty"
    AT_REST = "at_rest"
    LIDAR_BLIND = "lidar_blind"
    OBSTACLE_NEAR = "obstacle_near"
    # pose
    POSE_UNKNOWN = "pose_unknown"
    POSE_LOST = "pose_lost"
    POSE_UNCERTAIN = "pose_uncertain"
    POSITION_WIDE = "position_wide"
    MAY_BE_BLOCKED = "may_be_blocked"
    IN_BLOCKED = "in_blocked"
    MARKER_MISPLACED = "marker_misplaced"
    # map
    MAP_MISSING = "map_missing"
    MAP_LATE = "map_late"
    MAP_OLD = "map_old"
    MAP_GAP = "map_gap"
    HAZARDS_OLD = "hazards_old"
    AREA_UNKNOWN = "area_unknown"
    # plan and path
    PLANNER_LATE = "planner_late"
    PLANNER_LOST = "planner_lost"
    PLAN_AWAITED = "plan_awaited"
    PATH_AWAITED = "path_awaited"
    PATH_OF_OTHER_MAP = "path_of_other_map"
    PATH_NEWER_THAN_MAP = "path_newer_than_map"
    PATH_REFUSED = "path_refused"
    PATH_TOO_LONG = "path_too_long"
    PATH_LEFT = "path_left"
    PATH_BLOCKED = "path_blocked"
    NO_PROGRESS = "no_progress"
    NO_ROOM = "no_room"
    # the gate's own
    JUST_STARTED = "just_started"
    NOT_ENABLED = "not_enabled"
    RECOVERING = "recovering"
    HELD_TOO_LONG = "held_too_long"
    STOPS_REPEATED = "stops_repeated"
    MANEUVER = "maneuver"
    MANEUVER_ENDED = "maneuver_ended"
    DOCKING = "docking"
    DOCKING_GIVEN_UP = "docking_given_up"


class RefusalCode(Described):
    """Why a robot refuses a command; where a condition refuses it by itself, its `ReasonCode` says so."""

    # the command itself
    OTHER_ROBOT = "other_robot", "the command is for another robot"
    NOT_SIGNED = "not_signed", "the signature is not the site's operators'"
    OTHER_RUN = "other_run", "it was issued to the agent before its restart"
    FROM_FUTURE = "from_future", "it was issued in the future of the robot's clock"
    TOO_OLD = "too_old", "it is older than 5 s"
    REPEATED = "repeated", "it was carried out before"
    # enable and reset
    CAUSE_REMAINS = "cause_remains", "conditions that stopped the robot still hold: `causes`"
    FAULT_LATCHED = "fault_latched", "a fault must be reset first: `causes`"
    NO_FAULT = "no_fault", "there is no fault to reset"
    MANEUVER_RUNS = "maneuver_runs", "a maneuver must end first"
    # maneuvers
    MUST_NOT_MOVE = "must_not_move", "conditions keep the robot from moving: `causes`"
    NOT_BLOCKED_IN = "not_blocked_in", "the robot is in no blocked area or zone"
    NOT_BUMPED = "not_bumped", "the robot has bumped into nothing"
    NOT_ON_DOCK = "not_on_dock", "the robot is not on its dock"
    POSE_KNOWN = "pose_known", "the robot knows where it is"
    BLOCKED_AHEAD = "blocked_ahead", "a blocked area or zone is on the way"
    NO_DOCK = "no_dock", "the site or the base has no dock for it"
    DOCK_NOT_KNOWN = "dock_not_known", "the robot does not know where its dock is"
    DOCK_FAR = "dock_far", "the robot is not in front of its dock"
    DOCK_BARRED = "dock_barred", "something is between the robot and its dock"
    # goal, pose and profile
    NO_GOAL = "no_goal", "there is no goal to cancel"
    DRIVING = "driving", "the robot must stand for that"
    HAND_TAKEN = "hand_taken", "somebody else drives the robot by hand"
    NOT_BY_HAND = "not_by_hand", "it does not drive by hand: take it over first"
    POSE_MISSING = "pose_missing", "the command carries no pose"
    POSE_OFF_MAP = "pose_off_map", "the pose is off the map"
    POSE_IN_WALL = "pose_in_wall", "the pose is in a wall"
    NO_PROFILE = "no_profile", "the robot has no such profile"
    # hand-over to another floor
    ONE_FLOOR = "one_floor", "the robot knows this floor only"
    NO_FLOOR = "no_floor", "the robot does not know the other floor"
    OTHER_BERTH = "other_berth", "the hand-over does not begin where the robot's own record says that it is"


class RobotState(Message, frozen=True, kw_only=True):
    """A robot's mode with its reasons, the map version and plan that it follows, and the epochs that it received.

    `boot` is the id of this run of its agent, `clock` the agent's own monotonic clock: a command names both.
    `proximity` has the strength of each of the base's light sensors, from the left to the right; empty without any.
    `metrics` is the address (host:port) at which Prometheus reaches the robot's metrics; empty if it can't.
    `docked`: it stands on its dock. `wants_dock`: it asks the planner for the goal in front of its dock.
    `places`: where on the map it may be, most likely first, while its scans do not decide; empty otherwise.
    `codes` identifies each of the `reasons`, in their order (`ReasonCode`); a newer robot may have others.
    `berth`: which floor it is on by its own record, None for one that knows no other; `floors`: all that it knows;
    `carries_missions`: it takes a mission along to them (`HandOver.mission`).
    `awaits_operator`: it does not drive before an operator enables or resets it. `base_fault` identifies the fault that
    the guardian has latched: a base may have its own.
    """

    mode: Mode
    reasons: list[Sentence]
    enabled: bool
    battery: Annotated[float, Meta(ge=0.0, le=1.0)] | None
    goal_id: Annotated[str, Meta(max_length=64)] | None
    map_epoch: Count
    map_seq: Count
    plan_id: Count | None
    planner_epoch: Count | None = None
    goal_reached: bool = False
    goal_distance: Annotated[Finite, Meta(extra={"unit": "m"})] | None = None
    loop: LoopHealth = LoopHealth()
    traces: list[Trace] = []
    stamp: Stamp = 0.0
    epochs: Epochs = {}
    boot: Boot = ""
    clock: Seconds = 0.0
    power: Power | None = None
    proximity: Annotated[list[Strength], Meta(max_length=16)] = []
    profile: ProfileName = "fog"
    metrics: Annotated[str, Meta(max_length=128)] = ""
    docked: bool = False
    wants_dock: bool = False
    places: Annotated[list[Pose], Meta(max_length=8)] = []
    codes: Codes = []
    awaits_operator: bool = False
    base_fault: Code = ""
    berth: Berth | None = None
    floors: Annotated[list[Id], Meta(max_length=200)] = []
    carries_missions: bool = False


VIEW_SECTORS: Final = 180
"""Sectors of a robot's view, each 2 degrees wide, counted counter-clockwise from the map's x axis."""

REACH_UNIT_M: Final = 0.05
"""Unit of a view's ranges, which end at 255 of them: 12.75 m."""


class View(Message, frozen=True, kw_only=True):
    """What a robot's lidar sees from (x, y) (m, frame `map`).

    `reach` has a byte for each sector: the nearest range in units of 5 cm, rounded down, 0 without any echo. Up to that
    range the floor is free at the lidar's height; a sector without an echo carries no information.
    """

    x: Metres
    y: Metres
    reach: Annotated[bytes, Meta(min_length=180, max_length=180)]


class RobotObstacles(Message, frozen=True, kw_only=True):
    """Points (m, frame `map`) that a robot's lidar sees and the map does not contain.

    They hold until a robot's view shows that they are gone, and at most for `ttl` seconds after they were last seen.
    """

    points: Annotated[list[PointXY], Meta(max_length=2_000)]
    stamp: Stamp
    ttl: Annotated[float, Meta(gt=0.0, le=600.0, extra={"unit": "s"})]
    view: View | None = None


CommandKind = Literal[
    "enable",
    "disable",
    "cancel",
    "egress",
    "dock",
    "undock",
    "back_off",
    "turn",
    "advance",
    "reset",
    "initial_pose",
    "hand_over",
    "profile_default",
    "profile_full",
    "profile_fog",
]


class RobotCommand(Message, frozen=True, kw_only=True):
    """An operator's command: single-use (`nonce`), valid 5 s from `issued_at`, signed (`fog_contracts.commands`).

    `boot` and `issued_at` are `boot` and `clock` of the robot's latest state: the command's age is measured by the
    robot's clock alone, and another run of the agent refuses it. What stops the robot (`disable`,
    `cancel`) is carried out unsigned, too, and whatever the other fields say. `pose` belongs to `initial_pose`,
    `given` to `hand_over`.
    """

    kind: CommandKind
    robot: Id
    operator: Annotated[str, Meta(min_length=1, max_length=100)]
    nonce: Annotated[str, Meta(min_length=16, max_length=64)]
    issued_at: Seconds = 0.0
    boot: Boot = ""
    pose: Pose | None = None
    given: HandOver | None = None
    signature: Annotated[bytes, Meta(max_length=64)] = b""


class CommandReply(Message, frozen=True, kw_only=True):
    """Whether the command was accepted, and if not, why.

    `code` identifies the refusal (`RefusalCode` or `ReasonCode`), `causes` the conditions behind it (`ReasonCode`); a
    newer robot may have others, an older one sends none.
    """

    accepted: bool
    reason: Sentence
    code: Code = ""
    causes: Codes = []

    @classmethod
    def refused(cls, why: Reason) -> Self:
        """Return a refusal, its sentence cut to the message's limit."""
        return cls(accepted=False, reason=why[:SENTENCE_MAX], code=why.code, causes=list(why.causes))


class EgressRequest(Message, frozen=True, kw_only=True):
    """Request of a robot inside a blocked area for a path that leaves it."""

    robot: Id
    pose: Pose
