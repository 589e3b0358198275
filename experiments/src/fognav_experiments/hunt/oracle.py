"""What must hold of any drive, checked against the ground truth and what was published. Pure.

It knows messages and the simulator's truth, and nothing of how Fognav works: its limits are those that the documents
promise, each with a margin for what a message says late. All rules stand in one file, longer than others, since they
judge by the same few facts.

Lengths in m, speeds in m/s, times in s of one clock; frame `map`, unless it says `true`.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import msgspec

from fog_contracts import channels as ch
from fog_contracts.costs import LETHAL
from fog_contracts.geometry import contains_point, distance_to_polygon, distance_to_segment
from fog_contracts.messages import PolygonShape, RobotPose, RobotState

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from fog_contracts.geometry import Point
    from fog_contracts.handlers import Handler, Ids, Moment, Publication
    from fog_contracts.messages import (
        AreaHazard,
        AreaState,
        HazardArea,
        MapDelta,
        MapHeartbeat,
        Mode,
        RobotPath,
        SimTruth,
        Zone,
        ZoneSet,
    )

Rule = Literal[
    "contact", "blocked", "speed", "stop", "pose", "version", "write", "hazard", "cleared", "barrier", "late"
]
Source = Literal["fog", "map-service", "aggregator", "planner", "agent", "lidar", "new turns", "base", "floor"]
"""What may be lost: all messages to the robot, a process of the fog, its own agent (which may hang), its lidar, or new
turns of it, what its base sends, the floor before its front wheel."""
_MAP: Final[frozenset[Source]] = frozenset({"fog", "map-service"})
"""Without one of these a robot does not learn what changes on the map."""

_STANDING: Final = 0.02
"""A robot whose wheels are slower than this stands."""
_MODE_SPEED: Final[dict[Mode, float]] = {
    "INIT": 0.0,
    "NORMAL": 0.30,
    "DEGRADED": 0.15,
    "HOLD": 0.0,
    "PROTECTIVE_STOP": 0.0,
    "FAULT": 0.0,
    "EGRESS": 0.10,  # it moves only as an operator has just told it to
    "TELEOP": 0.15,
    "DOCK": 0.30,
}
_UNKNOWN_SPEED: Final = 0.15
_SPEED_MARGIN: Final = 0.02
_RAMP_S: Final = 0.8
"""0.5 s of a ramp, and what states and truth, ten times a second, come late."""
_REACTION_S: Final = 1.0
"""From the announcement of what is blocked to a robot that knows: a map's version, a path."""
_STOP_S: Final[dict[Source, float]] = {
    "fog": 4.0, "map-service": 4.0, "agent": 0.4, "lidar": 0.6, "new turns": 1.4, "base": 0.6, "floor": 0.4,
}  # fmt: skip
"""Wheels are zero so long after a source is lost: 3.5, 0.3 and 0.5 s by the documents, three turns and a ramp, 0.3 s
for
the base, a frame for the floor, and what the truth comes late."""
_BUMPED_S: Final = 0.4
"""And so long after the bumper touched something."""
_SEEN_M: Final = 0.25
"""What is lower no lidar sees: only the bumper finds it."""
_TOUCHED_M: Final = 0.05
"""What is so near to its rim a robot may have touched since the last truth, at 0.3 m/s."""
_HAZARDS: Final[frozenset[Source]] = frozenset({"map-service", "aggregator"})
"""Without one of these no hazard is announced."""
_SLOW_S: Final = 2.0
"""So long after an acknowledged write or a lost fog a robot that does not know better is slow."""
_WRITTEN_S: Final = 2.5
"""A robot's state, once a second, names a version that holds an acknowledged write so long after it."""
_HAZARD_S: Final = 2.0
"""From an obstacle before an honest node to the announced hazard: five readings of at most 0.3 s, and 0.35 s."""
_LATE_S: Final = 30.0
"""A robot that loses nothing takes nothing for late that is not, for longer: whatever its clock or the fog's does."""
_SETTLED_S: Final = 5.0
_POSE_SIGMAS: Final = 4.0
_POSE_S: Final = 1.5
"""A claim is broken if it is for so long: a robot that was pushed needs a scan or two to know."""
_LOST_M: Final = 1.5
_LOST_S: Final = 0.5
_TRUTHS: Final = 100


class Violation(msgspec.Struct, frozen=True, kw_only=True):
    """A rule that was broken: when (s), where the robot truly was (x, y), and by which values."""

    rule: Rule
    at_s: float
    x: float
    y: float
    values: str


@dataclass(frozen=True, kw_only=True)
class World:
    """What the oracle must know of a world.

    `to_map`: where a true pose is on the robot's map, which may be warped. `tolerance_m`: by how much a border on the
    map may be off, its cells included. `pose_floor_m`: deviation that no map of this kind lets a robot know. `gain`:
    speed of the base for a command, highest of its wheels. `late_s`: how long a message may take on its way.
    `ahead_s`: by how much a robot's wall clock is ahead. `wrong_s`: how long wheels may do what nobody commanded: a
    Roomba can't tell a command with a wrong bit, and follows it until the next one.
    """

    radius: float
    to_map: Callable[[float, float, float], tuple[float, float, float]] = lambda x, y, theta: (x, y, theta)
    tolerance_m: float = 0.15
    pose_floor_m: float = 0.10
    gain: float = 1.0
    late_s: float = 0.0
    ahead_s: Callable[[], float] = lambda: 0.0
    wrong_s: float = 0.0


class Figures(msgspec.Struct, kw_only=True):
    """What a drive's truth and claims sum up to; errors of the pose only while the robot moves."""

    driven_m: float = 0.0
    moving_s: float = 0.0
    worst_error_m: float = 0.0
    poses: int = 0
    squared_error: float = 0.0
    within_two_sigma: int = 0
    min_clearance_m: float = 2.0
    degraded_s: float = 0.0

    def rounded(self) -> Figures:
        """Return them as they are recorded."""
        return Figures(**{name: round(value, 3) for name, value in msgspec.structs.asdict(self).items()})


class _Known(NamedTuple):
    """What is blocked or limited, and since when it is known."""

    distance: Callable[[float, float], float]
    """Of a point (m) from it, negative inside."""
    since: float
    label: str
    limit: float = 0.0


class Oracle:
    """Watches one robot; `violations` grows with each rule that it sees broken, once as long as that lasts."""

    def __init__(self, world: World, stamp_zero: float) -> None:
        """`stamp_zero`: what the wall clock shows when the drive's clock shows 0."""
        self.violations: list[Violation] = []
        self.figures = Figures()
        self._world = world
        self._stamp_zero = stamp_zero
        self._now = 0.0
        self._truths: list[tuple[float, float, float, float]] = []
        self._truth: SimTruth | None = None
        self._speed = 0.0
        self._contacts = 0
        self._bumped = math.inf
        self._broken: dict[tuple[str, str], float] = {}
        self._mode: Mode = "INIT"
        self._allowed_until: list[tuple[float, float]] = []
        self._old_map = False
        self._version = (0, 0)
        self._poses: list[tuple[float, RobotPose]] = []
        self._areas: dict[str, tuple[AreaState, _Known]] = {}
        self._impassable: dict[str, _Known] = {}
        """Areas that are blocked, or unknown and as costly: nobody has seen them free since."""
        self._zones: dict[str, _Known] = {}
        self._limits: dict[str, _Known] = {}
        self._lost: dict[Source, float] = {}
        self._restored: dict[Source, float] = {}
        self._path: list[Point] = []
        self._newest: dict[str, tuple[int, ...]] = {}
        self._writes: dict[tuple[str, int], float] = {}
        self._written: dict[tuple[str, int], tuple[tuple[int, int], float]] = {}
        self._obstacles: dict[str, float] = {}

    def handlers(self) -> dict[ch.Channel, Handler]:
        """Return what to subscribe to: the channels of the fog, and the ground truth."""
        return {
            ch.SIM_TRUTH: self._on_truth,
            ch.HAZARD: self._on_hazard,
            ch.ZONES: self._on_zones,
            ch.MAP_HEARTBEAT: self._on_heartbeat,
            ch.MAP_DELTA: self._on_delta,
            ch.AREA_HAZARD: self._on_area_hazard,
            ch.ROBOT_PATH: self._on_path,
        }

    # --- what the world does -----------------------------------------------------------------------------------------

    def on_lost(self, source: Source, now: float) -> None:
        """Note that from now on the robot does not get this."""
        self._lost.setdefault(source, now)

    def on_restored(self, source: Source, now: float) -> None:
        """Note that the robot gets this again."""
        if self._lost.pop(source, None) is not None:
            self._restored[source] = now

    def on_fallen(self, now: float) -> None:
        """Note that its middle is over a hole, which it was told to back off from at most."""
        self._now = now
        if not self._is_told:
            self._report("contact", f"fell into a hole at {self._speed:.2f} m/s in {self._mode}")

    def on_acknowledged(self, zone: Zone, now: float) -> None:
        """Note that an operator's zone was acknowledged."""
        self._writes[zone.id, zone.version] = now

    def on_obstacle(self, area: str, now: float) -> None:
        """Note that something stands before the honest nodes of an area, across their cones."""
        self._obstacles[area] = now

    def on_obstacle_gone(self, area: str) -> None:
        """Note that it is gone, or that its nodes are not honest any more."""
        self._obstacles.pop(area, None)

    def on_barrier(self, polygon: Sequence[Point], now: float) -> None:
        """Note that a demonstration closes an area, which its robot was to drive through."""
        x, y = self._place
        legs = list(itertools.pairwise(self._path))
        nearest = min(range(len(legs)), key=lambda leg: distance_to_segment(*legs[leg], x, y), default=0)
        left = [(x, y), *self._path[nearest + 1 :]]
        ahead = min((distance_to_polygon(polygon, *point) for point in _along(left)), default=math.inf)
        if ahead > 0.0:
            self._now = now
            self._report("barrier", f"the area was closed, and what is left of the path passes it at {ahead:.1f} m")

    # --- what the robot publishes ------------------------------------------------------------------------------------

    def on_robot(self, publications: Sequence[Publication], now: float) -> None:
        """Hear what the robot sends, whether it arrives or not."""
        for publication in publications:
            if isinstance(publication.message, RobotState):
                self._on_state(publication.message, now)
            elif isinstance(publication.message, RobotPose):
                self._poses.append((now, publication.message))

    def _on_state(self, state: RobotState, now: float) -> None:
        if state.mode != self._mode:
            # Until the ramp is over, the faster of both modes counts.
            self._allowed_until.append((now + _RAMP_S, _MODE_SPEED[self._mode]))
            self._mode = state.mode
        self._old_map = not {"map_late", "map_old"}.isdisjoint(state.codes)
        self._version = (state.map_epoch, state.map_seq)

    # --- what the fog publishes --------------------------------------------------------------------------------------

    def _on_hazard(self, ids: Ids, message: HazardArea, at: Moment) -> tuple[()]:
        area, hazard, polygon = ids["area"], message.hazard, message.polygon
        before = self._areas.get(area)
        known = _Known(_to(polygon), at.now, f"area {area}", _UNKNOWN_SPEED)
        if before is None or before[0] != hazard.state or hazard.state == "clear":
            self._areas[area] = (hazard.state, known)
        if hazard.penalty < LETHAL:
            self._impassable.pop(area, None)
        else:
            self._impassable.setdefault(area, known)
        standing = self._obstacles.get(area)
        late = standing is not None and at.now > max(standing, self._back(_HAZARDS)) + _HAZARD_S + self._world.late_s
        if late and hazard.state == "clear" and message.confirmed:
            self._report("cleared", f"area {area} is clear, and an obstacle stands there since {standing:.1f} s")
        return ()

    def _on_zones(self, ids: Ids, message: ZoneSet, at: Moment) -> tuple[()]:
        del ids
        self._grows("zones", (message.epoch, message.seq))
        blocked, limits = {}, {}
        for zone in message.zones:
            if (zone.id, zone.version) in self._writes:
                asked = self._writes.pop((zone.id, zone.version))
                self._written[zone.id, zone.version] = (message.epoch, message.seq), asked
            if zone.id not in message.active or not isinstance(zone.shape, PolygonShape):
                continue
            points, before = zone.shape.points, {**self._zones, **self._limits}.get(zone.id)
            since = before.since if before is not None else at.now
            known = _Known(_to(points), since, f"zone {zone.id}", zone.speed or 0.0)
            if zone.kind == "BLOCKED":
                blocked[zone.id] = known
            elif zone.kind == "SPEED_LIMIT":
                limits[zone.id] = known
        self._zones, self._limits = blocked, limits
        return ()

    def _on_heartbeat(self, ids: Ids, message: MapHeartbeat, at: Moment) -> tuple[()]:
        del ids, at
        self._grows("map heartbeat", (message.epoch, message.seq))
        return ()

    def _on_delta(self, ids: Ids, message: MapDelta, at: Moment) -> tuple[()]:
        del ids, at
        self._grows("map delta", (message.epoch, message.seq, message.part))
        return ()

    def _on_area_hazard(self, ids: Ids, message: AreaHazard, at: Moment) -> tuple[()]:
        del at
        self._grows(f"hazard of {ids['area']}", (message.epoch, message.seq))
        return ()

    def _on_path(self, ids: Ids, message: RobotPath, at: Moment) -> tuple[()]:
        del at
        if message.refusal is None:
            self._path = list(message.points)
        self._grows(f"path of {ids['robot']}", (message.planner_epoch, message.plan_id))
        return ()

    def _grows(self, what: str, version: tuple[int, ...]) -> None:
        newest = self._newest.get(what, version)
        if version < newest:
            self._report("version", f"{what} went back from {newest} to {version}")
        self._newest[what] = max(version, newest)

    # --- the truth ---------------------------------------------------------------------------------------------------

    def _on_truth(self, ids: Ids, truth: SimTruth, at: Moment) -> tuple[()]:
        del ids
        elapsed = at.now - self._now if self._truth is not None else 0.0
        if self._truth is not None:
            self.figures.driven_m += truth.distance - self._truth.distance
        self._now, self._truth = at.now, truth
        self._truths = [*self._truths[-_TRUTHS:], (at.now, *self._world.to_map(truth.x, truth.y, truth.theta))]
        self._speed = abs(truth.left + truth.right) / 2
        self._check_contact(truth)
        self._check_speed()
        self._check_blocked()
        self._check_stop()
        self._check_late()
        self._check_writes()
        self._check_hazards()
        self._check_poses()
        if self._moves:
            self.figures.moving_s += elapsed
            self.figures.degraded_s += elapsed if self._mode == "DEGRADED" else 0.0
            self.figures.min_clearance_m = min(self.figures.min_clearance_m, truth.clearance)
        return ()

    @property
    def _moves(self) -> bool:
        return self._fastest_wheel > _STANDING

    @property
    def _fastest_wheel(self) -> float:
        truth = self._truth
        return 0.0 if truth is None else max(abs(truth.left), abs(truth.right))

    @property
    def _place(self) -> Point:
        """Where the robot truly is, on its map."""
        return self._truths[-1][1:3]

    def _check_contact(self, truth: SimTruth) -> None:
        if truth.contacts > self._contacts:
            self._contacts, self._bumped = truth.contacts, self._now
            reach = self._world.radius + _TOUCHED_M
            met = [o for o in truth.obstacles if distance_to_polygon(o.polygon, truth.x, truth.y) < reach]
            if any(o.height < _SEEN_M for o in met):
                return
            what = ", ".join(o.id for o in met) or "a wall"
            self._report("contact", f"drove into {what} at {self._speed:.2f} m/s in {self._mode}")

    def _check_speed(self) -> None:
        self._allowed_until = [(until, speed) for until, speed in self._allowed_until if until > self._now]
        limit, why = max([_MODE_SPEED[self._mode], *(speed for _, speed in self._allowed_until)]), f"in {self._mode}"
        x, y = self._place
        if self._knows:
            unknown = [known for state, known in self._areas.values() if state == "unknown"]
            for known in [*unknown, *self._limits.values()]:
                deep = known.distance(x, y) < -self._world.tolerance_m - 2.0 * self._world.pose_floor_m
                if deep and self._now - known.since > self._reaction_s and known.limit < limit:
                    limit, why = known.limit, f"in {known.label}"
        if self._mode == "EGRESS":
            limit = max(limit, _MODE_SPEED["EGRESS"])
        allowed = limit * self._world.gain + _SPEED_MARGIN
        # A robot that must stand does not turn on the spot either.
        speed = self._speed if limit else self._fastest_wheel
        values = f"{speed:.2f} m/s {why}, not {limit:.2f}"
        self._lasts("speed", why, speed > allowed, values, 0.25 + self._world.wrong_s)

    @property
    def _reaction_s(self) -> float:
        return _REACTION_S + _RAMP_S + 2.0 * self._world.late_s

    @property
    def _knows(self) -> bool:
        """Whether the robot hears the fog, and has for as long as it takes to know its map."""
        if _MAP & self._lost.keys():
            return False
        return self._now - self._back(_MAP) > self._reaction_s + _REACTION_S

    def _back(self, words: frozenset[Source]) -> float:
        """Return when the last of these was there again; it may have been lost all the time, too."""
        return max(self._now if source in self._lost else self._restored.get(source, -math.inf) for source in words)

    def _check_blocked(self) -> None:
        x, y = self._place
        for known in [*self._impassable.values(), *self._zones.values()]:
            depth = self._world.radius - known.distance(x, y)
            knows = self._knows and self._now - known.since > self._reaction_s
            moves = self._speed > _STANDING and self._mode != "EGRESS"
            wrong = knows and moves and depth > self._world.tolerance_m
            self._lasts(
                "blocked", known.label, wrong, f"drives in {known.label} at {self._speed:.2f} m/s in {self._mode}, "
                f"known since {known.since:.1f} s", 0.35,
            )  # fmt: skip

    def _check_stop(self) -> None:
        for source, limit in _STOP_S.items():
            seconds = self._now - self._lost.get(source, self._now)
            late = seconds > limit + (self._world.late_s if source == "fog" else 0.0)
            # An operator who tells it to turn, to drive out or to back off needs no map, and the floor behind it only.
            told = self._is_told and (source == "floor" or source in _MAP)
            moves = self._moves and not told
            values = f"wheels turn {seconds:.1f} s after it lost the {source}"
            self._lasts("stop", source, late and moves, values, self._world.wrong_s)
        seconds = self._now - self._bumped
        if not self._moves or self._is_told:
            self._bumped = math.inf
        elif seconds > _BUMPED_S:
            self._report("stop", f"wheels turn {seconds:.1f} s after the bumper touched something")
            self._bumped = math.inf

    @property
    def _is_told(self) -> bool:
        """Whether it moves as an operator has just told it to, at most."""
        return self._mode == "EGRESS" and self._speed <= _MODE_SPEED["EGRESS"] * self._world.gain + _SPEED_MARGIN

    def _check_late(self) -> None:
        settled = not self._lost and self._now - max(self._restored.values(), default=-math.inf) > _SETTLED_S
        late = settled and self._old_map and self._world.late_s == 0.0
        self._lasts(
            "late", "map", late, f"its map is old for {_LATE_S:.0f} s, in {self._mode}, and nothing is lost", _LATE_S
        )

    def _check_writes(self) -> None:
        fast = (
            self._speed > _UNKNOWN_SPEED * self._world.gain + _SPEED_MARGIN and self._now - self._back(_MAP) > _SLOW_S
        )
        for (zone, version), asked in list(self._writes.items()):
            late = fast and self._now - asked > _WRITTEN_S + self._world.late_s
            values = f"{self._speed:.2f} m/s, zone {zone} was published in no version for {self._now - asked:.1f} s"
            self._lasts("write", f"{zone} {version}", late, values, self._world.wrong_s)
        for key, (needed, asked) in list(self._written.items()):
            if self._version >= needed:
                del self._written[key]
            late = key in self._written and fast and self._now - asked > _WRITTEN_S + _SLOW_S + 2.0 * self._world.late_s
            values = f"{self._speed:.2f} m/s on map {self._version}, zone {key[0]} of {asked:.1f} s is in {needed}"
            self._lasts("write", f"{key[0]} {key[1]}", late, values, self._world.wrong_s)

    def _check_hazards(self) -> None:
        for area, since in self._obstacles.items():
            state = self._areas[area][0] if area in self._areas else "unknown"
            known = max(since, self._back(_HAZARDS))
            late = state != "blocked" and self._now - known > _HAZARD_S + self._world.late_s
            values = f"area {area} is {state} {self._now - since:.1f} s after an obstacle came"
            self._lasts("hazard", area, late, values, 0.0)

    def _check_poses(self) -> None:
        waiting = []
        for published_at, pose in self._poses:
            at = pose.stamp - self._stamp_zero - self._world.ahead_s()
            if at > self._now:
                if published_at > self._now - 1.0:
                    waiting.append((published_at, pose))
                continue
            if (true := self._true_at(at)) is not None:
                self._check_pose(pose, true)
        self._poses = waiting

    def _true_at(self, at: float) -> tuple[float, float] | None:
        """Return where the robot was on its map, between two truths."""
        for (t0, x0, y0, *_), (t1, x1, y1, *_) in zip(self._truths[-2::-1], self._truths[:0:-1], strict=False):
            if t0 <= at <= t1:
                share = (at - t0) / max(t1 - t0, 1e-9)
                return x0 + share * (x1 - x0), y0 + share * (y1 - y0)
        return None

    def _check_pose(self, pose: RobotPose, true: tuple[float, float]) -> None:
        ex, ey = pose.x - true[0], pose.y - true[1]
        error, floor = math.hypot(ex, ey), self._world.pose_floor_m**2
        a, b, d = pose.covariance[0], pose.covariance[1], pose.covariance[4]
        sigmas = _mahalanobis(ex, ey, a + floor, b, d + floor)
        moves = pose.localized and self._moves
        if moves:
            figures = self.figures
            figures.poses += 1
            figures.squared_error += error * error
            figures.worst_error_m = max(figures.worst_error_m, error)
            figures.within_two_sigma += _mahalanobis(ex, ey, a + floor / 25, b, d + floor / 25) < 2.0
        claimed = math.sqrt(max(a, d))
        values = f"{error:.2f} m wrong ({ex:.2f}, {ey:.2f}), claimed {claimed:.2f} m, in {self._mode}"
        self._lasts("pose", "claim", moves and sigmas > _POSE_SIGMAS, values, _POSE_S)
        self._lasts("pose", "lost", moves and error > _LOST_M, values, _LOST_S)

    # --- reports -----------------------------------------------------------------------------------------------------

    def _lasts(self, rule: Rule, subject: str, wrong: bool, values: str, seconds: float) -> None:  # noqa: FBT001  # what, whether, for how long
        """Report what is wrong for longer than `seconds`, once."""
        key = (rule, subject)
        if not wrong:
            self._broken.pop(key, None)
            return
        since = self._broken.setdefault(key, self._now)
        if self._now - since >= seconds and since != math.inf:
            self._report(rule, values)
            self._broken[key] = math.inf

    def _report(self, rule: Rule, values: str) -> None:
        x, y = (self._truth.x, self._truth.y) if self._truth is not None else (0.0, 0.0)
        self.violations.append(
            Violation(rule=rule, at_s=round(self._now, 2), x=round(x, 2), y=round(y, 2), values=values)
        )


def _to(points: Sequence[Point]) -> Callable[[float, float], float]:
    """Return the distance (m) of a point from a polygon, negative inside."""
    sides = list(zip(points, [*points[1:], points[0]], strict=True))

    def distance(x: float, y: float) -> float:
        nearest = min(distance_to_segment(a, b, x, y) for a, b in sides)
        return -nearest if contains_point(points, x, y) else nearest

    return distance


def _mahalanobis(ex: float, ey: float, a: float, b: float, d: float) -> float:
    """Return how many deviations (ex, ey) is, by the covariance ((a, b), (b, d))."""
    determinant = max(a * d - b * b, 1e-12)
    return math.sqrt(max(0.0, (d * ex * ex - 2.0 * b * ex * ey + a * ey * ey) / determinant))


def _along(line: Sequence[Point]) -> list[Point]:
    """Return points every few centimetres along a polyline."""
    points: list[Point] = []
    for (x0, y0), (x1, y1) in itertools.pairwise(line):
        count = math.ceil(math.hypot(x1 - x0, y1 - y0) / 0.05)
        points += [(x0 + (x1 - x0) * k / count, y0 + (y1 - y0) * k / count) for k in range(count)]
    return points
