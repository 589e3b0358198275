"""How a drive went, by the truth of the simulated world and not by what the robot believes. Pure."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

from fog_contracts.geometry import Point, contains_point, distance_to_polygon
from fog_contracts.messages import RobotPath, RobotState, SimTruth
from fog_contracts.site import AreaSite

OutcomeKind = Literal["reached", "refused", "contact", "timeout", "stopped"]

TOLERANCE_M: Final = 0.30
"""How far from the goal the robot may really be: its own tolerance (0.10 m) plus what it may err about its place."""
CLAIM_S: Final = 3.0
"""How long a robot that says it has arrived, but has not, may go on correcting itself."""
REFUSAL_S: Final = 20.0
"""How long a refusal stands before it is the end: a hazard may pass."""


@dataclass(frozen=True)
class DriveOutcome:
    """How the drive ended, and why in words."""

    kind: OutcomeKind
    reason: str


@dataclass(kw_only=True)
class DriveEvaluation:
    """Follows a drive to `goal` (m); `now` is in seconds of the clock, and the drive begins at `begun`."""

    goal: Point
    goal_id: str
    areas: Sequence[AreaSite]
    begun: float
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
    """Each PROTECTIVE_STOP and FAULT that it entered, with its reasons."""
    _mode: str = ""
    _truth: SimTruth | None = None
    _begun_at_m: float | None = None
    _contacts_before: int | None = None
    _claimed_at: float | None = None
    _refused_at: float | None = None
    _refusal: str = ""
    _known_plans: set[tuple[int, int]] = field(default_factory=set)

    @property
    def distance_m(self) -> float:
        """Distance really driven since the drive began."""
        if self._truth is None or self._begun_at_m is None:
            return 0.0
        return self._truth.distance - self._begun_at_m

    def block(self, area: AreaSite) -> None:
        """From now on the robot must not enter this area."""
        self.blocked = area

    def on_truth(self, truth: SimTruth) -> None:
        """Take the simulator's ground truth."""
        if self._begun_at_m is None:
            self._begun_at_m, self._contacts_before = truth.distance, truth.contacts
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
        """Take what the robot says of itself."""
        if state.mode != self._mode:
            self._mode = state.mode
            self.modes[state.mode] += 1
            if state.mode in {"PROTECTIVE_STOP", "FAULT"}:
                self.stops.append(f"{state.mode}: {'; '.join(state.reasons) or 'no reason given'}")
        if state.goal_reached and state.goal_id in {self.goal_id, None}:
            self._claimed_at = now if self._claimed_at is None else self._claimed_at
        else:
            self._claimed_at = None

    def on_path(self, path: RobotPath, now: float) -> None:
        """Take what the planner sends."""
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
        """Return how the drive ended, or None while it goes on."""
        truth = self._truth
        if truth is not None and truth.contacts > (self._contacts_before or 0):
            return DriveOutcome("contact", f"the robot touched something at ({truth.x:.2f}, {truth.y:.2f})")
        if truth is not None and self._claimed_at is not None:
            off = math.hypot(truth.x - self.goal[0], truth.y - self.goal[1])
            if off <= TOLERANCE_M:
                return DriveOutcome("reached", f"the robot stands {off:.2f} m from its goal")
            if now - self._claimed_at > CLAIM_S:
                return DriveOutcome(
                    "stopped", f"the robot says that it has arrived, but it is {off:.2f} m from its goal"
                )
        if self._refused_at is not None and now - self._refused_at > REFUSAL_S:
            return DriveOutcome("refused", self._refusal)
        if now - self.begun > self.timeout_s:
            return DriveOutcome("timeout", f"the goal was not reached within {self.timeout_s:.0f} s")
        return None

    def success(self, kind: OutcomeKind) -> bool:
        """Whether all that was asked for came true: arrived, nothing touched, the blocked area avoided."""
        return kind == "reached" and not self.entered_blocked
