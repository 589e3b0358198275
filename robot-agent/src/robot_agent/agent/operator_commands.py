"""Operators' commands: each is executed once if it is signed, fresh and possible in the robot's state, else refused."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, Protocol

from fog_contracts.commands import PROFILE_OF, CommandGate
from fog_contracts.costs import LETHAL
from fog_contracts.messages import CommandReply, Reason, ReasonCode, RefusalCode

if TYPE_CHECKING:
    from collections.abc import Mapping

    from fog_contracts.handlers import Moment
    from fog_contracts.messages import HandOver, Pose, ProfileName, RobotCommand
    from fog_contracts.replica import Replica
    from robot_agent.config import AgentConfig
    from robot_agent.safety.conditions import Request
    from robot_agent.safety.gate import SafetyOutputs

_ACCEPTED: Final[Mapping[Request, str]] = {
    "reset": "the fault is reset; enable the robot to let it drive",
    "egress": "the robot leaves the blocked area slowly; watch it",
    "undock": "the robot leaves its dock, straight back; watch it",
    "turn": "the robot turns in place to find out where it is; watch it",
    "advance": "the robot drives 0.4 m ahead to find out where it is; watch it: without a pose it heeds no zone",
    "back_off": "the robot backs off by at most 10 cm; then reset its fault",
}


class CommandTarget(Protocol):
    """The actions that an operator may request from a robot."""

    def request(self, request: Request, now: float) -> SafetyOutputs:
        """Pass a request to the safety gate; the outputs carry its refusal."""

    def order_dock(self, now: float) -> Reason | None:
        """Let the robot go to its dock; return why it does not, None if it does."""

    def cancel_goal(self) -> str | None:
        """Cancel the goal, and the way into the dock; return what was cancelled, None if nothing was."""

    def set_initial_pose(self, pose: Pose | None) -> Reason | None:
        """Start localization at a pose in `map`; return why the pose is refused, None when it is accepted."""

    def hand_over(self, given: HandOver | None) -> Reason | None:
        """Leave this floor for another one; return why not, None when it is done, or was."""

    def switch_profile(self, name: ProfileName) -> Reason | None:
        """Navigate by another profile; return why not, None when it is done."""


class OperatorCommands:
    """Checks commands and executes them on one robot."""

    def __init__(self, config: AgentConfig, robot_actions: CommandTarget) -> None:
        self._gate = CommandGate(config.robot, config.operator_key, config.boot)
        self._robot = robot_actions

    def answer(self, command: RobotCommand, at: Moment) -> CommandReply:  # noqa: PLR0911  # one answer per kind
        """Execute a command, or refuse it with a reason."""
        refusal = self._gate.refusal(command, at.now)
        if refusal is not None:
            return CommandReply.refused(refusal)
        match command.kind:
            case "enable" | "disable" | "reset" | "egress" | "undock" | "back_off" | "turn" | "advance":
                return self._request(command.kind, at.now)
            case "dock":
                return self._send_to_dock(at.now)
            case "cancel":
                return self._cancel()
            case "initial_pose":
                return self._start_localization(command.pose)
            case "hand_over":
                return self._hand_over(command.given)
            case "profile_default" | "profile_full" | "profile_fog":
                return self._switch(PROFILE_OF[command.kind])

    def _cancel(self) -> CommandReply:
        cancelled = self._robot.cancel_goal()
        if cancelled is None:
            return CommandReply.refused(Reason(RefusalCode.NO_GOAL, "there is no goal to cancel"))
        return CommandReply(accepted=True, reason=f"{cancelled} is cancelled on the robot")

    def _send_to_dock(self, now: float) -> CommandReply:
        refusal = self._robot.order_dock(now)
        if refusal is not None:
            return CommandReply.refused(refusal)
        return CommandReply(accepted=True, reason="the robot goes to its dock; watch it while it drives into it")

    def _start_localization(self, pose: Pose | None) -> CommandReply:
        refusal = self._robot.set_initial_pose(pose)
        if refusal is not None:
            return CommandReply.refused(refusal)
        return CommandReply(accepted=True, reason="accepted; the next lidar scans verify it")

    def _hand_over(self, given: HandOver | None) -> CommandReply:
        refusal = self._robot.hand_over(given)
        if refusal is not None or given is None:
            return CommandReply.refused(refusal or Reason(RefusalCode.NO_FLOOR, "the command names no floor"))
        return CommandReply(accepted=True, reason=f"the robot leaves this floor, and joins {given.floor}")

    def _switch(self, profile: ProfileName) -> CommandReply:
        refusal = self._robot.switch_profile(profile)
        if refusal is not None:
            return CommandReply.refused(refusal)
        return CommandReply(accepted=True, reason=f"the robot navigates by the profile {profile} from now on")

    def _request(self, request: Request, now: float) -> CommandReply:
        outputs = self._robot.request(request, now)
        if outputs.refusal is not None:
            return CommandReply.refused(outputs.refusal)
        return CommandReply(accepted=True, reason=_ACCEPTED.get(request, f"{request}d; the mode is {outputs.mode}"))


def initial_pose_refusal(pose: Pose | None, replica: Replica, *, at_rest: bool) -> Reason | None:
    """Return why an operator's initial pose is impossible; None when it is possible."""
    geometry = replica.geometry
    if pose is None:
        return Reason(RefusalCode.POSE_MISSING, "the command carries no pose: give x, y and theta")
    if geometry is None:
        return Reason(ReasonCode.MAP_MISSING, "the robot has no map yet: wait until it has loaded one")
    if not at_rest:
        return Reason(RefusalCode.DRIVING, "the robot is driving: disable it first")
    column, row = geometry.cell(pose.x, pose.y)
    if not geometry.contains_cell(column, row):
        return Reason(RefusalCode.POSE_OFF_MAP, f"({pose.x:.2f}, {pose.y:.2f}) is off the map")
    if replica.static[row, column] == LETHAL:
        return Reason(RefusalCode.POSE_IN_WALL, f"({pose.x:.2f}, {pose.y:.2f}) is in a wall of the map")
    return None
