"""One drive with its hazard: what places the barrier, ends the drive, evaluates and summarizes it. Pure.

The demonstration and lockstep runs hand it the same messages, so the same facts end both in the same way. It is judged
by the ground truth of the simulator, not by the estimates of the robot.
"""

import contextlib
import itertools
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

import msgspec

from fog_contracts.geometry import Point, contains_point, distance_to_polygon
from fog_contracts.messages import RobotPath, RobotState, SimTruth
from fog_contracts.site import AreaSite
from fognav_sim.barrier import BarrierError
from fognav_sim.drive.hazard import HazardSchedule, PlannedHazard, remaining

OutcomeKind = Literal["reached", "refused", "contact", "timeout", "stopped"]

GOAL_TOLERANCE_M: Final = 0.30
"""How far from the goal the robot may really be: its own tolerance (0.10 m) plus its localization error."""
FALSE_ARRIVAL_S: Final = 3.0
"""How long a robot that reports its arrival, but is elsewhere, may correct its position before the drive ends."""
REFUSAL_GRACE_S: Final = 20.0
"""How long a refusal must last to end the drive: the hazard behind it may clear, or an operator lead the robot out."""

_SLOWEST_M_S: Final = 0.08
"""Mean speed, stops included, below which a drive times out."""
_DETOUR: Final = 3.0
"""How many times the Manhattan distance to the goal a drive around a hazard may be."""
_TIMEOUT_BASE_S: Final = 180.0


def drive_timeout_s(start: Point, goal: Point) -> float:
    """Return how long (s) a drive between two points (m) may take."""
    return _TIMEOUT_BASE_S + _DETOUR * (abs(start[0] - goal[0]) + abs(start[1] - goal[1])) / _SLOWEST_M_S


@dataclass(frozen=True)
class DriveOutcome:
    """How the drive ended, with the reason in words."""

    kind: OutcomeKind
    reason: str


@dataclass(kw_only=True)
class DriveEvaluation:
    """Follows a drive to `goal` (m) that starts at `started_at`; all times are in seconds of the clock."""

    goal: Point
    goal_id: str
    areas: Sequence[AreaSite]
    started_at: float
    timeout_s: float
    blocked: AreaSite | None = None
    entered_blocked: bool = False
    blocked_clearance_m: float = math.inf
    min_clearance_m: float = math.inf
    route_areas: list[str] = field(default_factory=list)
    plans: int = 0
    modes: Counter[str] = field(default_factory=Counter)
    """How often the robot entered each of its modes."""
    stops: list[str] = field(default_factory=list)
    """Each PROTECTIVE_STOP and FAULT of the robot, with its reasons."""
    followed: set[tuple[int | None, int]] = field(default_factory=set)
    """The paths to its goal that the robot followed: epoch and id of each plan."""
    _mode: str = ""
    _truth: SimTruth | None = None
    _start_distance_m: float | None = None
    _initial_contacts: int | None = None
    _arrival_claimed_at: float | None = None
    _refused_at: float | None = None
    _refusal: str = ""
    _known_plans: set[tuple[int, int]] = field(default_factory=set)

    @property
    def distance_m(self) -> float:
        """True distance driven since the start."""
        if self._truth is None or self._start_distance_m is None:
            return 0.0
        return self._truth.distance - self._start_distance_m

    def block(self, area: AreaSite) -> None:
        """Mark an area as blocked: from now on the robot must not enter it."""
        self.blocked = area

    def on_truth(self, truth: SimTruth) -> None:
        """Evaluate the simulator's ground truth."""
        if self._start_distance_m is None:
            self._start_distance_m, self._initial_contacts = truth.distance, truth.contacts
        self._truth = truth
        self.min_clearance_m = min(self.min_clearance_m, truth.clearance)
        for area in self.areas:
            last = self.route_areas[-1] if self.route_areas else None
            if area.id != last and contains_point(area.polygon, truth.x, truth.y):
                self.route_areas.append(area.id)
        if self.blocked is not None:
            distance = distance_to_polygon(self.blocked.polygon, truth.x, truth.y)
            self.blocked_clearance_m = min(self.blocked_clearance_m, distance)
            self.entered_blocked = self.entered_blocked or distance == 0.0

    def on_state(self, state: RobotState, now: float) -> None:
        """Evaluate the robot's reported state."""
        if state.mode != self._mode:
            self._mode = state.mode
            self.modes[state.mode] += 1
            if state.mode in {"PROTECTIVE_STOP", "FAULT"}:
                self.stops.append(f"{state.mode}: {'; '.join(state.reasons) or 'no reason given'}")
        if state.mode == "EGRESS" and self._refused_at is not None:
            self._refused_at = now
        if state.plan_id is not None and state.goal_id == self.goal_id:
            self.followed.add((state.planner_epoch, state.plan_id))
        if state.goal_reached and state.goal_id in {self.goal_id, None}:
            self._arrival_claimed_at = now if self._arrival_claimed_at is None else self._arrival_claimed_at
        elif state.goal_id == self.goal_id:
            # The planner ends the goal as soon as it is reached: a later state without a goal takes nothing back.
            self._arrival_claimed_at = None

    def on_path(self, path: RobotPath, now: float) -> None:
        """Evaluate a path or refusal from the planner."""
        if path.goal_id != self.goal_id:
            return
        if path.refusal is None:
            self._refused_at = None
            self._known_plans.add((path.planner_epoch, path.plan_id))
            self.plans = len(self._known_plans)
        elif self._refused_at is None:
            self._refused_at = now
            self._refusal = f"{path.refusal.name}: {path.refusal.reason}"

    def outcome(self, now: float) -> DriveOutcome | None:
        """Return how the drive ended, or None while it continues."""
        truth = self._truth
        if truth is not None and truth.contacts > (self._initial_contacts or 0):
            return DriveOutcome("contact", f"the robot made contact with an obstacle at ({truth.x:.2f}, {truth.y:.2f})")
        if truth is not None and self._arrival_claimed_at is not None:
            distance = math.hypot(truth.x - self.goal[0], truth.y - self.goal[1])
            if distance <= GOAL_TOLERANCE_M:
                return DriveOutcome("reached", f"the robot stands {distance:.2f} m from its goal, without contact")
            if now - self._arrival_claimed_at > FALSE_ARRIVAL_S:
                return DriveOutcome(
                    "stopped", f"the robot reports that it has arrived, but it is {distance:.2f} m from its goal"
                )
        if self._refused_at is not None and now - self._refused_at > REFUSAL_GRACE_S:
            return DriveOutcome("refused", self._refusal)
        if now - self.started_at > self.timeout_s:
            return DriveOutcome("timeout", f"the goal was not reached within {self.timeout_s:.0f} s")
        return None


_PROGRESS_M: Final = 1.0
"""How much farther along its path than it has driven the robot may be found: it cuts corners."""


class DriveSummary(msgspec.Struct, frozen=True, kw_only=True):
    """How a drive went according to the ground truth; lengths in m, times in s of the clock.

    `time_s` is None for a drive that was broken off. `area` is the area that was or would have become blocked,
    `area_entered` and `area_clearance_m` concern the robot's centre from then on. `route_areas` lists the areas that
    the robot crossed, in order; `plans` counts the planner's plans, `paths` the paths that the robot followed, and
    `modes` how often it entered each of its modes; `stops` are its protective stops and faults.
    """

    outcome: OutcomeKind
    reason: str
    success: bool = False
    distance_m: float = 0.0
    time_s: float | None = None
    min_clearance_m: float | None = None
    area: str | None = None
    area_entered: bool = False
    area_clearance_m: float | None = None
    route_areas: list[str] = []
    plans: int = 0
    paths: int = 0
    modes: dict[str, int] = {}
    stops: list[str] = []


class Drive:
    """A drive to a goal, from the moment when the goal was given: feed it the messages of the robot's channels."""

    def __init__(
        self,
        *,
        goal: Point,
        goal_id: str,
        areas: Sequence[AreaSite],
        truth: SimTruth,
        now: float,
        hazard: HazardSchedule | None,
    ) -> None:
        """Begin at `now` (s) where the ground truth has the robot; without `hazard` nothing blocks its path."""
        self.evaluation = DriveEvaluation(
            goal=goal,
            goal_id=goal_id,
            areas=areas,
            started_at=now,
            timeout_s=drive_timeout_s((truth.x, truth.y), goal),
        )
        self.hazard = hazard
        self.blocked_at_m: float | None = None
        """Distance (m) driven when the barrier was placed; None before."""
        self.ended_at: float | None = None
        """Time (s) at which the drive had its outcome; None before."""
        self.barrier_was_ahead = False
        """Whether the robot's path led into the hazard's area when the barrier was placed."""
        self._truth = truth
        self._path: Sequence[Point] = ()
        self._along_m = 0.0
        """How far along its path the robot is."""
        self._path_is_new = False
        self.evaluation.on_truth(truth)

    @property
    def hazard_met(self) -> bool:
        """Whether the barrier was placed, and ahead of the robot on its path, if this drive is to have one.

        An area that was asked for may lie anywhere.
        """
        return self.hazard is None or (self.blocked_at_m is not None and self.barrier_was_ahead)

    def on_truth(self, truth: SimTruth) -> None:
        """Evaluate the simulator's ground truth."""
        reach = abs(truth.distance - self._truth.distance) + _PROGRESS_M
        self._truth = truth
        if self.hazard is not None and self.blocked_at_m is None and self._path:
            self._along_m = _nearest(self._path, (truth.x, truth.y), self._along_m, self._along_m + reach)
        self.evaluation.on_truth(truth)

    def on_state(self, state: RobotState, now: float) -> None:
        """Evaluate the robot's reported state."""
        self.evaluation.on_state(state, now)

    def on_path(self, path: RobotPath, now: float) -> None:
        """Evaluate a path or refusal from the planner."""
        if path.goal_id == self.evaluation.goal_id and path.points != self._path:
            self._path, self._along_m, self._path_is_new = path.points, 0.0, True
        self.evaluation.on_path(path, now)

    def hazard_due(self) -> PlannedHazard | None:
        """Return the hazard whose barrier is to be placed now, or None; raises `BarrierError` if no area qualifies."""
        if self.hazard is None or self.blocked_at_m is not None or not self._path:
            return None
        left = remaining(self._path, self._along_m)
        if self._path_is_new and self.hazard.planned is not None:
            with contextlib.suppress(BarrierError):  # raised by `due` if it is still so when the barrier is due
                self.hazard.draw(left, self.evaluation.distance_m)
        self._path_is_new = False
        return self.hazard.due(left, self.evaluation.distance_m, (self._truth.x, self._truth.y))

    def on_barrier_placed(self, hazard: PlannedHazard) -> None:
        """Record that the barrier stands: from now on the robot must not enter the hazard's area."""
        self.blocked_at_m = self.evaluation.distance_m
        left = remaining(self._path, self._along_m)
        self.barrier_was_ahead = self.hazard is not None and self.hazard.is_ahead(hazard, left)
        self.evaluation.block(hazard.area)

    def outcome(self, now: float) -> DriveOutcome | None:
        """Return how the drive ended, or None while it continues."""
        outcome = self.evaluation.outcome(now)
        if outcome is not None and self.ended_at is None:
            self.ended_at = now
        return outcome

    def success(self, kind: OutcomeKind) -> bool:
        """Whether the drive succeeded: goal reached without contact, hazard met, blocked area avoided."""
        return kind == "reached" and self.hazard_met and not self.evaluation.entered_blocked

    def summary(self, outcome: DriveOutcome) -> DriveSummary:
        """Summarize the drive that ended with this outcome."""
        evaluation, planned = self.evaluation, self.hazard.planned if self.hazard is not None else None
        return DriveSummary(
            outcome=outcome.kind,
            reason=outcome.reason,
            success=self.success(outcome.kind),
            distance_m=round(evaluation.distance_m, 2),
            time_s=round(self.ended_at - evaluation.started_at, 2) if self.ended_at is not None else None,
            min_clearance_m=_finite(evaluation.min_clearance_m),
            area=planned.area.id if planned is not None else None,
            area_entered=evaluation.entered_blocked,
            area_clearance_m=_finite(evaluation.blocked_clearance_m),
            route_areas=list(evaluation.route_areas),
            plans=evaluation.plans,
            paths=len(evaluation.followed),
            modes=dict(evaluation.modes),
            stops=list(evaluation.stops),
        )


def _nearest(path: Sequence[Point], at: Point, since_m: float, until_m: float) -> float:
    """Return the distance (m) along a polyline of its point nearest to `at`, from `since_m` to `until_m` along it."""
    best_m, least, along = since_m, math.inf, 0.0
    for (x0, y0), (x1, y1) in itertools.pairwise(path):
        length = math.hypot(x1 - x0, y1 - y0)
        if length > 0.0 and along + length >= since_m:
            t = ((at[0] - x0) * (x1 - x0) + (at[1] - y0) * (y1 - y0)) / length
            t = min(max(t, since_m - along, 0.0), until_m - along, length)
            away = math.hypot(x0 + t / length * (x1 - x0) - at[0], y0 + t / length * (y1 - y0) - at[1])
            if away < least:
                best_m, least = along + t, away
        along += length
        if along >= until_m:
            break
    return best_m


def _finite(value: float) -> float | None:
    return round(value, 3) if math.isfinite(value) else None
