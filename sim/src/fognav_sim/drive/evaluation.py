"""Evaluates a drive by the simulator's ground truth, not by the robot's estimates. Pure."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

from fog_contracts.geometry import Point, contains_point, distance_to_polygon
from fog_contracts.messages import RobotPath, RobotState, SimTruth
from fog_contracts.site import AreaSite

OutcomeKind = Literal["reached", "refused", "contact", "timeout", "stopped"]

GOAL_TOLERANCE_M: Final = 0.30
"""How far from the goal the robot may really be: its own tolerance (0.10 m) plus its localization error."""
FALSE_ARRIVAL_S: Final = 3.0
"""How long a robot that reports its arrival, but is elsewhere, may correct its position before the drive ends."""
REFUSAL_GRACE_S: Final = 20.0
"""How long a refusal must last to end the drive: the hazard behind it may clear."""

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
