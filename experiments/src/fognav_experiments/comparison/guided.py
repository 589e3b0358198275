"""A drive of a real robot, evaluated by what the robot itself reports, with barriers that a person places. Pure."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from fog_contracts.messages import Pose, SimTruth
from fognav_experiments.comparison.driven import facts
from fognav_experiments.comparison.measured import MeasuredDrive
from fognav_sim.drive.drive import Drive, DriveOutcome
from fognav_sim.drive.hazard import HazardRequest, HazardSchedule

if TYPE_CHECKING:
    from fog_contracts.messages import ProfileName, RobotPath, RobotPose, RobotState
    from fognav_experiments.comparison.draws import RouteDraw
    from fognav_sim.drive.hazard import PlannedHazard, SiteWithMap

COUNTED_M: Final = 0.1
"""Displacement from which on a robot has moved: its estimated pose wavers while it stands."""
START_M: Final = 0.5
"""How far from a route's start a robot may stand when it begins."""
START_RAD: Final = math.radians(20.0)
"""How far its heading may be from the route's."""


def start_of(site: SiteWithMap, drawn: RouteDraw) -> Pose:
    """Return the pose at which a drawn route begins."""
    place = site.site.places[drawn.route.start]
    return Pose(x=place.x, y=place.y, theta=drawn.theta if place.theta is None else place.theta)


def stands_at(pose: RobotPose | None, start: Pose) -> bool:
    """Whether a robot knows its place, and is near enough to the start, in its heading too."""
    if pose is None or not pose.localized:
        return False
    turned = abs(math.remainder(pose.theta - start.theta, math.tau))
    return math.hypot(pose.x - start.x, pose.y - start.y) <= START_M and turned <= START_RAD


def where_to_place(planned: PlannedHazard) -> str:
    """Return in words which barrier a person is to place, and where."""
    corners = ", ".join(f"({x:.1f}, {y:.1f})" for x, y in planned.barrier.polygon)
    label = f" ({planned.area.label})" if planned.area.label else ""
    return f"area {planned.area.id}{label}: a barrier at least {planned.barrier.height:g} m high, corners at {corners}"


class GuidedDrive:
    """One drive of a drawn route, from the moment when the robot is given its goal: feed it what the robot publishes.

    Distance and areas are those of the robot's own poses; what it touched only a person can tell.
    """

    def __init__(
        self,
        site: SiteWithMap,
        drawn: RouteDraw,
        setup: ProfileName,
        *,
        goal_id: str,
        pose: RobotPose,
        now: float,
    ) -> None:
        """Begin at `now` (s) at this pose; raises `BarrierError` for an area that no barrier closes."""
        self._drawn, self._setup = drawn, setup
        self._counted = pose
        self._distance_m = 0.0
        goal = site.site.places[drawn.route.goal]
        self._drive = Drive(
            goal=(goal.x, goal.y),
            goal_id=goal_id,
            areas=site.site.areas,
            truth=self._truth(pose),
            now=now,
            hazard=HazardSchedule.of(site, drawn.seed, HazardRequest(area=drawn.area, trigger_m=drawn.trigger_m)),
        )

    def on_pose(self, pose: RobotPose) -> None:
        """Evaluate the robot's pose; one that it is not sure of tells nothing."""
        if not pose.localized:
            return
        moved = math.hypot(pose.x - self._counted.x, pose.y - self._counted.y)
        if moved >= COUNTED_M:
            self._counted, self._distance_m = pose, self._distance_m + moved
        self._drive.on_truth(self._truth(pose))

    def on_state(self, state: RobotState, now: float) -> None:
        """Evaluate the robot's state."""
        self._drive.on_state(state, now)

    def on_path(self, path: RobotPath, now: float) -> None:
        """Evaluate a path or refusal of the planner."""
        self._drive.on_path(path, now)

    def barrier_due(self) -> PlannedHazard | None:
        """Return what a person is to place now, or None."""
        return self._drive.hazard_due()

    def on_barrier_placed(self, planned: PlannedHazard) -> None:
        """Record that a person says that the barrier stands; said again, it changes nothing."""
        if self._drive.blocked_at_m is None:
            self._drive.on_barrier_placed(planned)

    def outcome(self, now: float) -> DriveOutcome | None:
        """Return how the drive ended, or None while it continues."""
        return self._drive.outcome(now)

    def record(self, outcome: DriveOutcome, *, touched: bool, load: float, version: str, commit: str) -> MeasuredDrive:
        """Return the record of the drive that ended so; `touched`: whether a person saw the robot touch something."""
        ended = DriveOutcome("contact", "a person saw the robot touch something") if touched else outcome
        summary = self._drive.summary(ended)
        placed = self._drive.blocked_at_m
        return MeasuredDrive(
            **facts(MeasuredDrive, self._drawn, self._setup, summary),
            kind="hardware",
            barrier_at_m=None if placed is None else round(placed, 2),
            load=load,
            version=version,
            commit=commit,
        )

    def _truth(self, pose: RobotPose) -> SimTruth:
        """Return the robot's own pose in the form that drives are evaluated by; nobody measures its clearance."""
        return SimTruth(
            robot="robot", x=pose.x, y=pose.y, theta=pose.theta, left=pose.v, right=pose.v, distance=self._distance_m,
            clearance=math.inf, min_clearance=math.inf, contacts=0,
        )  # fmt: skip
