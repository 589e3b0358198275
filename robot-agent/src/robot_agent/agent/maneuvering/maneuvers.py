"""The robot's maneuvers: what the safety gate must know of the one that runs, and the command that drives it. Pure."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

import msgspec

from robot_agent.agent.maneuvering.docking import Docking
from robot_agent.agent.maneuvering.egress import Egress
from robot_agent.agent.maneuvering.straight import Straight
from robot_agent.agent.maneuvering.turning import Turning
from robot_agent.agent.safety_supervisor import ManeuverInputs
from robot_agent.safety.gate import MANEUVERS

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fog_contracts.replica import Replica
    from robot_agent.agent.motion_guard import MotionGuard
    from robot_agent.agent.path.path_driving import PathDriving
    from robot_agent.config import AgentConfig
    from robot_agent.guardian.link import BaseFeedback, WheelCommand
    from robot_agent.guardian.link import Maneuver as BaseManeuver
    from robot_agent.localization.localizer import Localizer
    from robot_agent.localization.pose import Pose2
    from robot_agent.safety.conditions import Request
    from robot_agent.safety.gate import SafetyOutputs, SafetyState
    from robot_agent.safety.maneuver_rules import ManeuverKind
    from robot_agent.safety.stop_field import Wheels

UNDOCK_M: Final = 0.3
"""Off the dock the robot has room to turn."""
BACK_OFF_M: Final = 0.09
"""The guardian allows a centimetre more, and the wheels need some of it to come to rest."""
ADVANCE_M: Final = 0.4
"""Enough for two scans that tell places apart which look alike."""

_BY_GUARDIAN: Final[Mapping[ManeuverKind, BaseManeuver]] = {
    "dock": "seek_dock",
    "undock": "leave_dock",
    "back_off": "back_off",
}
"""Maneuvers for which the guardian has rules of its own, by their name there."""


class Maneuvers:
    """The maneuvers of one robot, of which at most one runs. `now` is s of the robot's monotonic clock."""

    def __init__(self, config: AgentConfig, localizer: Localizer, guard: MotionGuard) -> None:
        self._localizer = localizer
        self._guard = guard
        self._drive = config.drive_train
        self.egress = Egress(config)
        self.docking = Docking(config, localizer)
        self._turning = Turning(config.drive_train.axle_m, config.motion.limits.w_max)
        self._straight: dict[ManeuverKind, Straight] = {
            "undock": Straight(-UNDOCK_M, config.safety.speed_egress),
            "back_off": Straight(-BACK_OFF_M, config.safety.speed_back_off),
            "advance": Straight(ADVANCE_M, config.safety.speed_egress),
        }
        self._kind: ManeuverKind | None = None

    def on_request(self, request: Request, state: SafetyState) -> None:
        """Prepare for an operator's request."""
        if request == "egress" and state.maneuver is None:
            self.egress.begin()
        if request in {"disable", "reset", "egress", "undock", "turn", "advance"}:
            self.docking.give_up()

    def may_seek_dock(
        self, state: SafetyState, feedback: BaseFeedback | None, driving: PathDriving, now: float
    ) -> bool:
        """Return whether the robot has come to the front of its dock; a low battery may send it there."""
        if feedback is not None:
            self.docking.order_if_low(feedback.status, state, driving.mission, now)
        return self.docking.is_due(state, driving.mission, now, at_rest=driving.wheels.at_rest)

    def inputs(
        self, state: SafetyState, replica: Replica, trusted: Pose2 | None, now: float, request: Request | None = None
    ) -> ManeuverInputs:
        """Return how the maneuver goes; `trusted`: the robot's pose if that is good enough.

        request: of a maneuver that shall begin.
        """
        kind = None if state.maneuver is None else state.maneuver.kind
        # Just after a stop the twist still is that of the drive, and a pose that is extrapolated by it up to 2 cm too
        # far ahead: a way back from there would be too short by that. So maneuvers begin at a measured pose.
        odom, measured = self._localizer.odom_at(now), self._localizer.latest_odom()
        if kind != self._kind:
            self._kind = kind
            self._turning.begin(measured)
            for straight in self._straight.values():
                straight.begin(measured)
        match request:
            case "undock" | "back_off" if kind is None:
                return ManeuverInputs(blind_behind=self._guard.blindness(self._straight[request].wheels))
        if kind in self._straight:
            self._straight[kind].advance(measured)
            return ManeuverInputs(self._straight[kind].remaining(odom), self._guard.reason)
        if kind == "turn":
            self._turning.advance(odom)
            return ManeuverInputs(self._turning.remaining(odom), self._guard.reason)
        if kind == "dock" or self.docking.ordered:
            return ManeuverInputs(dock_problem=self._dock_problem(replica, now, running=kind == "dock"))
        if kind != "egress":
            return ManeuverInputs()  # what is left of an earlier way out must not end a maneuver that begins now
        self.egress.advance(trusted, now)
        return ManeuverInputs(self.egress.remaining, self.egress.problem(self._guard.reason))

    def way_ahead(self, request: Request | None, inputs: ManeuverInputs) -> float:
        """Return how far (m) an advance that runs, or is requested now, drives straight ahead; 0 without one."""
        if self._kind == "advance":
            return max(0.0, min(ADVANCE_M, inputs.remaining))
        return ADVANCE_M if request == "advance" else 0.0

    def command(
        self, state: SafetyState, safety: SafetyOutputs, driving: PathDriving, now: float
    ) -> WheelCommand | None:
        """Return the command of the maneuver that runs; None when none does."""
        if state.maneuver is None or safety.mode not in MANEUVERS:
            return None
        kind = state.maneuver.kind
        wheels = self._wheels(kind, now)
        command = driving.command_directly(wheels, safety=safety, guard=self._guard.limit, now=now)
        return msgspec.structs.replace(command, maneuver=_BY_GUARDIAN.get(kind))

    def _wheels(self, kind: ManeuverKind, now: float) -> Wheels:
        match kind:
            case "egress":
                return self.egress.wheels(self._localizer.pose(now))
            case "dock":
                return 0.0, 0.0
            case "turn":
                return self._turning.wheels(self._localizer.odom_at(now))
            case _:
                return self._straight[kind].wheels

    def _dock_problem(self, replica: Replica, now: float, *, running: bool) -> str | None:
        problem = self.docking.problem(replica, now, running=running)
        pose = self._localizer.pose(now)
        if problem is not None or not running or pose is None:
            return problem
        return self._guard.hazard(self._measured_wheels(), partial(self.docking.without_dock, pose=pose), now)

    def _measured_wheels(self) -> Wheels:
        """Return the speeds (m/s) at which the base turns its wheels by itself."""
        v, w = self._localizer.twist()
        half = 0.5 * self._drive.axle_m * w
        return v - half, v + half
