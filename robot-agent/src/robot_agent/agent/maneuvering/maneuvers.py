"""The robot's maneuvers: what the safety gate must know of the one that runs, and the command that drives it. Pure."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Final

import msgspec

from robot_agent.agent.maneuvering.docking import Docking
from robot_agent.agent.maneuvering.egress import Egress
from robot_agent.agent.maneuvering.straight_back import StraightBack
from robot_agent.agent.safety_supervisor import ManeuverInputs
from robot_agent.safety.gate import MANEUVERS

if TYPE_CHECKING:
    from fog_contracts.replica import Replica
    from robot_agent.agent.motion_guard import MotionGuard
    from robot_agent.agent.path.path_driving import PathDriving
    from robot_agent.config import AgentConfig
    from robot_agent.guardian.link import BaseFeedback, WheelCommand
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


class Maneuvers:
    """The maneuvers of one robot, of which at most one runs. `now` is s of the robot's monotonic clock."""

    def __init__(self, config: AgentConfig, localizer: Localizer, guard: MotionGuard) -> None:
        self._localizer = localizer
        self._guard = guard
        self._drive = config.drive_train
        self.egress = Egress(config)
        self.docking = Docking(config, localizer)
        self._undock = StraightBack(UNDOCK_M, config.safety.speed_egress)
        self._back_off = StraightBack(BACK_OFF_M, config.safety.speed_back_off)
        self._kind: ManeuverKind | None = None

    def on_request(self, request: Request, state: SafetyState) -> None:
        """Prepare for an operator's request."""
        if request == "egress" and state.maneuver is None:
            self.egress.begin()
        if request in {"disable", "reset", "egress", "undock"}:
            self.docking.give_up()

    def may_seek_dock(
        self, state: SafetyState, feedback: BaseFeedback | None, driving: PathDriving, now: float
    ) -> bool:
        """Return whether the robot has come to the front of its dock; a low battery may send it there."""
        if feedback is not None:
            self.docking.order_if_low(feedback.status, state, driving.mission, now)
        return self.docking.is_due(state, driving.mission, now, at_rest=driving.wheels.at_rest)

    def inputs(self, state: SafetyState, replica: Replica, trusted: Pose2 | None, now: float) -> ManeuverInputs:
        """Return how the maneuver goes; `trusted`: the robot's pose if that is good enough."""
        kind = None if state.maneuver is None else state.maneuver.kind
        odom = self._localizer.odom_at(now)
        if kind != self._kind:
            self._kind = kind
            for straight in (self._undock, self._back_off):
                straight.begin(odom)
        if kind == "undock":
            return ManeuverInputs(self._undock.remaining(odom), self._guard.reason)
        if kind == "back_off":
            return ManeuverInputs(self._back_off.remaining(odom), self._guard.reason)
        if kind == "dock" or self.docking.ordered:
            return ManeuverInputs(dock_problem=self._dock_problem(replica, now, running=kind == "dock"))
        if kind != "egress":
            return ManeuverInputs()  # what is left of an earlier way out must not end a maneuver that begins now
        self.egress.advance(trusted, now)
        return ManeuverInputs(self.egress.remaining, self.egress.problem(self._guard.reason))

    def command(
        self, state: SafetyState, safety: SafetyOutputs, driving: PathDriving, now: float
    ) -> WheelCommand | None:
        """Return the command of the maneuver that runs; None when none does."""
        if state.maneuver is None or safety.mode not in MANEUVERS:
            return None
        command = partial(driving.command_directly, safety=safety, guard=self._guard.limit, now=now)
        match state.maneuver.kind:
            case "egress":
                return command(self.egress.wheels(self._localizer.pose(now)))
            case "dock":
                return msgspec.structs.replace(command((0.0, 0.0)), maneuver="seek_dock")
            case "undock":
                return msgspec.structs.replace(command(self._undock.wheels), maneuver="leave_dock")
            case "back_off":
                return msgspec.structs.replace(command(self._back_off.wheels), maneuver="back_off")

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
