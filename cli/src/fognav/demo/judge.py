"""Did it go well? Judged by the truth of the simulated world, not by what the robot believes. Pure."""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

import msgspec

from fog_contracts.geometry import Point, contains_point, distance_to_polygon
from fog_contracts.messages import RobotPath, RobotState, SimTruth, Trace
from fog_contracts.site import AreaSite

Outcome = Literal["reached", "refused", "contact", "timeout", "stopped"]

TOLERANCE_M: Final = 0.30
"""How far from the goal the robot may really be: its own tolerance (0.10 m) plus what it may err about its place."""
CLAIM_S: Final = 3.0
"""How long a robot that says it has arrived, but has not, may go on correcting itself."""
REFUSAL_S: Final = 20.0
"""How long a refusal stands before it is the end: a hazard may pass."""
STAGES: Final = (
    ("debounce", "first_reading", "confirmed"),
    ("costmap", "confirmed", "costmap_published"),
    ("plan", "costmap_published", "plan_published"),
    ("deliver", "plan_published", "path_received"),
    ("command", "path_received", "first_command"),
)
"""Stage, and the stamps of a trace between which it lies."""


@dataclass(frozen=True)
class Verdict:
    """How the run ended, and why in words."""

    outcome: Outcome
    reason: str


class Traces:
    """Collects what messages tell of each hazard's way through the stages."""

    def __init__(self) -> None:
        self._known: dict[tuple[str, int, int], Trace] = {}

    def take(self, traces: Sequence[Trace]) -> None:
        """Merge traces: a stage that was reached once stays reached."""
        for trace in traces:
            key = (trace.area, trace.epoch, trace.seq)
            known = self._known.get(key)
            if known is None:
                self._known[key] = trace
                continue
            stamps = {
                name: getattr(known, name) or getattr(trace, name)
                for name in trace.__struct_fields__
                if name not in {"area", "epoch", "seq"}
            }
            self._known[key] = msgspec.structs.replace(known, **stamps)

    def of(self, area: str, since: float) -> Trace | None:
        """Return the first trace of an area whose first reading is not older than `since` (stamp)."""
        found = [t for t in self._known.values() if t.area == area and t.first_reading >= since]
        return min(found, key=lambda t: t.first_reading, default=None)

    def latest(self) -> Trace | None:
        """Return the trace with the youngest first reading."""
        return max(self._known.values(), key=lambda t: t.first_reading, default=None)


def stages_ms(trace: Trace | None) -> dict[str, float]:
    """Milliseconds that each stage took, as far as the trace got."""
    if trace is None:
        return {}
    found = {}
    for stage, begin, end in STAGES:
        begun, ended = getattr(trace, begin), getattr(trace, end)
        if begun and ended:
            found[stage] = round((ended - begun) * 1000, 1)
    return found


def hazard_to_path_ms(trace: Trace | None) -> float | None:
    """Milliseconds from the first reading that saw the danger to the robot's new path."""
    if trace is None or not trace.first_reading or not trace.path_received:
        return None
    return round((trace.path_received - trace.first_reading) * 1000, 1)


@dataclass(kw_only=True)
class Judge:
    """Watches a drive to `goal` (m); `now` is in seconds of the clock, and the drive begins at `begun`."""

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
    paths: int = 0
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
    _plans: set[tuple[int, int]] = field(default_factory=set)

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
        """Take what is really so."""
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
            self._plans.add((path.planner_epoch, path.plan_id))
            self.paths = len(self._plans)
        elif self._refused_at is None:
            self._refused_at = now
            self._refusal = f"{path.refusal.name}: {path.refusal.reason}"

    def verdict(self, now: float) -> Verdict | None:
        """Return how the run ended, or None while it goes on."""
        truth = self._truth
        if truth is not None and truth.contacts > (self._contacts_before or 0):
            return Verdict("contact", f"the robot touched something at ({truth.x:.2f}, {truth.y:.2f})")
        if truth is not None and self._claimed_at is not None:
            off = math.hypot(truth.x - self.goal[0], truth.y - self.goal[1])
            if off <= TOLERANCE_M:
                return Verdict("reached", f"the robot stands {off:.2f} m from its goal")
            if now - self._claimed_at > CLAIM_S:
                return Verdict("stopped", f"the robot says that it has arrived, but it is {off:.2f} m from its goal")
        if self._refused_at is not None and now - self._refused_at > REFUSAL_S:
            return Verdict("refused", self._refusal)
        if now - self.begun > self.timeout_s:
            return Verdict("timeout", f"the goal was not reached within {self.timeout_s:.0f} s")
        return None

    def success(self, outcome: Outcome) -> bool:
        """Whether all that was asked for came true: arrived, nothing touched, the danger avoided."""
        return outcome == "reached" and not self.entered_blocked
