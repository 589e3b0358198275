"""Gathers the inputs of the safety gate, with the ages of base and lidar, and keeps its state and its last outputs."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np
from msgspec.structs import replace

from robot_agent.hardware import ASLEEP
from robot_agent.safety.conditions import SafetyInputs
from robot_agent.safety.gate import SafetyState, step

if TYPE_CHECKING:
    from fog_contracts.messages import Reason
    from robot_agent.agent.mission import Mission
    from robot_agent.agent.navigation import Navigation
    from robot_agent.config import SafetyConfig
    from robot_agent.guardian.link import BaseFeedback
    from robot_agent.hardware import LaserScan
    from robot_agent.localization.localizer import Localizer
    from robot_agent.safety.conditions import Request
    from robot_agent.safety.gate import SafetyOutputs

_NEVER: Final = -math.inf


class BaseSource:
    """The newest feedback and its age (s, monotonic)."""

    def __init__(self, travel_wrap_m: float) -> None:
        """Take how far (m) a wheel rolls, by the agent's settings, until its counter begins again."""
        self._travel_wrap_m = travel_wrap_m
        self.feedback: BaseFeedback | None = None
        self.lost: str | None = None
        """Why the link to the guardian is broken; None while it is connected."""
        self._feedback_at = _NEVER
        self._docked_at: float | None = None

    def on_feedback(self, feedback: BaseFeedback, now: float) -> None:
        """Store feedback that arrived at `now`."""
        self.feedback, self._feedback_at, self.lost = feedback, now, None
        if not feedback.status.docked:
            self._docked_at = None
        elif self._docked_at is None:
            self._docked_at = now

    def on_lost(self, reason: str) -> None:
        """Record that the link broke."""
        self.lost = reason

    @property
    def ready(self) -> bool:
        """Whether the guardian does not keep the base at rest."""
        return self.feedback is not None and self.feedback.stopped is None

    @property
    def asleep(self) -> bool:
        """Whether the base sleeps: it does not notice if it is pushed."""
        return self.feedback is not None and self.feedback.stopped == ASLEEP

    @property
    def wheels_differ(self) -> bool:
        """Whether the guardian reads the counters by other wheels than the agent: one of them has older settings."""
        wrap = None if self.feedback is None else self.feedback.travel_wrap_m
        return wrap is not None and wrap != self._travel_wrap_m

    def age(self, now: float) -> float:
        """Return the age (s) of the feedback; infinite without any."""
        return now - self._feedback_at

    def docked_for(self, now: float) -> float | None:
        """Return for how long (s) the robot has been on its dock; None off it."""
        return None if self._docked_at is None else now - self._docked_at


class LidarSource:
    """When (s, monotonic) the last samples and the last whole scan arrived."""

    def __init__(self, returns_least: float) -> None:
        """Count scans as empty with a smaller share of returns than this."""
        self.identical_scans = 1
        """1, and 1 more for each scan in a row that equals an earlier one: a working lidar never repeats a scan."""
        self.empty_scans = 0
        """How many scans in a row have hardly a return."""
        self._returns_least = returns_least
        self._samples_at = _NEVER
        self._scan_at = _NEVER

    def on_samples(self, now: float) -> None:
        """Record that samples arrived."""
        self._samples_at = now

    def on_scan(self, scan: LaserScan, now: float) -> None:
        """Record that a whole scan arrived."""
        self._scan_at = self._samples_at = now
        self.identical_scans = scan.repeats
        ranges = scan.unmasked().ranges_m
        empty = np.isfinite(ranges).sum() < self._returns_least * len(ranges)
        self.empty_scans = self.empty_scans + 1 if empty else 0

    def samples_age(self, now: float) -> float:
        """Return the time (s) since samples last arrived."""
        return now - self._samples_at

    def scan_age(self, now: float) -> float:
        """Return the time (s) since a whole scan last arrived."""
        return now - self._scan_at


class ManeuverInputs(NamedTuple):
    """How the maneuver goes, and why the base must not seek its dock.

    remaining: m to its end, rad of a turn. problem: what keeps the robot from it. blind_behind: why it would not drive
    back. hand_over: why nobody drives it by hand any more.
    """

    remaining: float = math.inf
    problem: str | None = None
    dock_problem: Reason | None = None
    blind_behind: Reason | None = None
    hand_over: str | None = None


class SafetySupervisor:
    """The safety gate with its state."""

    def __init__(self, config: SafetyConfig) -> None:
        self._config = config
        self.state = SafetyState()
        self.outputs = step(self.state, SafetyInputs(), 0.0, config)[1]
        self._ran_at = math.inf
        self._late_at, self._late_by = -math.inf, 0.0

    def evaluate(self, inputs: SafetyInputs, now: float, request: Request | None = None) -> SafetyOutputs:
        """Step the gate at `now` (s, monotonic): steadily, and with each operator's request."""
        self.pass_over(now)
        inputs = replace(inputs, request=request, late_age=now - self._late_at, late_by=self._late_by)
        self.state, self.outputs = step(self.state, inputs, now, self._config)
        return self.outputs

    def pass_over(self, now: float) -> None:
        """Record that the agent runs at `now`, with a step of the gate or without one: steadily, if it is on time."""
        pause = now - self._ran_at
        self._ran_at = now
        if pause > self._config.late:
            self._late_at, self._late_by = now, pause


def safety_inputs(  # noqa: PLR0913  # the gate weighs every source of the agent
    base: BaseSource,
    lidar: LidarSource,
    navigation: Navigation,
    localizer: Localizer,
    mission: Mission,
    *,
    path_problem: Reason | None,
    inside_blocked: str | None,
    inside_watched: bool,
    blocked_ahead: str | None,
    near_blocked: str | None,
    maneuver: ManeuverInputs,
    caution: Reason | None,
    resting: str | None,
    now: float,
) -> SafetyInputs:
    """Gather age, value and fault of every source at `now` (s, monotonic)."""
    feedback, follower = base.feedback, mission.follower
    return SafetyInputs(
        map_loaded=navigation.version is not None,
        map_age=navigation.age(now),
        map_gap=navigation.gap(now),
        localization=localizer.status,
        localization_detail=localizer.detail,
        lidar_age=lidar.samples_age(now),
        scan_age=lidar.scan_age(now),
        identical_scans=lidar.identical_scans,
        empty_scans=lidar.empty_scans,
        base_age=base.age(now),
        guardian_lost=base.lost,
        base_fault=feedback.fault if feedback else None,
        base_fault_passing=feedback is not None and feedback.passing,
        base_stopped=feedback.stopped if feedback else None,
        wheels_differ=base.wheels_differ,
        bumped=feedback is not None and feedback.bumped,
        docked_for=base.docked_for(now),
        bumper=feedback is not None and feedback.status.bumper,
        cliff=feedback is not None and feedback.status.cliff,
        wheel_drop=feedback is not None and feedback.status.wheel_drop,
        mission=mission.active,
        plan_age=mission.planner_age(now),
        released_remaining=follower.released_remaining if follower else 0.0,
        path_problem=path_problem,
        inside_blocked=inside_blocked,
        inside_watched=inside_watched,
        blocked_ahead=blocked_ahead,
        near_blocked=near_blocked,
        position_sigma=localizer.uncertainty.along,
        maneuver_remaining=maneuver.remaining,
        maneuver_problem=maneuver.problem,
        dock_problem=maneuver.dock_problem,
        blind_behind=maneuver.blind_behind,
        hand_over=maneuver.hand_over,
        caution=caution,
        resting=resting,
    )
