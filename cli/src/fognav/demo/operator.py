"""The operator of a demonstration: monitors and enables the robot, sends its goal, changes the simulated world."""

import asyncio
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

from fog_contracts import channels as ch
from fog_contracts.codec import ContractError
from fog_contracts.commands import STOPS
from fog_contracts.messages import (
    CommandKind,
    CommandReply,
    HazardArea,
    Pose,
    RobotGoal,
    RobotObstacles,
    RobotPath,
    RobotPose,
    RobotRelease,
    RobotState,
    SimCommand,
    SimTruth,
)
from fog_runtime.clock import Clock
from fog_runtime.robot_commands import RobotCommands
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fog_supervisor import net
from fog_supervisor.net import put_goal
from fognav.demo.scene import Scene
from fognav.programs import PLANNER
from fognav.stack import Stack
from fognav_sim.drive.hazard import path_length
from fognav_sim.drive.operator import OperatorPolicy

if TYPE_CHECKING:
    from fognav_sim.drive.drive import Drive

_SIMULATOR_TIMEOUT_S: Final = 2.0
_POLICY_PERIOD_S: Final = 1.0


class Operator:
    """Updates the scene from the channels, and sends commands. Everything runs on the event loop's thread."""

    def __init__(self, edge: ZenohEdge, stack: Stack, scene: Scene, clock: Clock) -> None:
        self._edge = edge
        self._stack = stack
        self._scene = scene
        self._clock = clock
        self._robot = scene.robot
        self._commands = RobotCommands(edge, operator="demo", key=stack.operator_key)
        self.drive: Drive | None = None
        self.enabling_paused = False
        """While this is true, the robot is not enabled."""
        self._policy = OperatorPolicy(clock.now())
        self._mode = ""
        self._told_reasons: set[str] = set()
        """Reasons of the mode in the log of events, without their numbers."""
        self._reported_areas: set[str] = set()
        self._unconfirmed = False
        self._last_refusal: tuple[str, ...] = ()
        self._enabled_once = False
        self._is_stopped = False
        """Whether somebody else has disabled the robot: who does that enables it again."""
        robot = {"robot": self._robot}
        edge.subscribe(ch.ROBOT_POSE, RobotPose, self._on_pose, **robot)
        edge.subscribe(ch.ROBOT_STATE, RobotState, self._on_state, **robot)
        edge.subscribe(ch.ROBOT_PATH, RobotPath, self._on_path, **robot)
        edge.subscribe(ch.ROBOT_RELEASE, RobotRelease, self._on_release, **robot)
        edge.subscribe(ch.ROBOT_GOAL, RobotGoal, self._on_goal, **robot)
        edge.subscribe(ch.ROBOT_OBSTACLES, RobotObstacles, self._on_obstacles, **robot)
        edge.subscribe(ch.SIM_TRUTH, SimTruth, self._on_truth, **robot)
        edge.subscribe(ch.HAZARD, HazardArea, self._on_hazard)

    # --- monitoring -------------------------------------------------------------------------------------------------

    def _on_pose(self, _ids: Mapping[str, str], pose: RobotPose) -> None:
        self._scene.pose = pose

    def _on_goal(self, _ids: Mapping[str, str], goal: RobotGoal) -> None:
        self._scene.goal = goal

    def _on_obstacles(self, _ids: Mapping[str, str], obstacles: RobotObstacles) -> None:
        self._scene.obstacles = obstacles

    def _on_truth(self, _ids: Mapping[str, str], truth: SimTruth) -> None:
        self._scene.on_truth(truth)
        if self.drive is not None:
            self.drive.on_truth(truth)

    def _on_state(self, _ids: Mapping[str, str], state: RobotState) -> None:
        now = self._clock.now()
        over = self._told_reasons.difference(state.codes)
        # A reset is carried out a moment after the mode is INIT: then what it has ended is no reason any more.
        if state.mode != self._mode or (state.mode == "INIT" and over):
            first = not self._mode
            self._scene.log_event(_describe_mode(state, first=first))
            self._mode = state.mode
            self._told_reasons = set() if first else set(state.codes[:2])
        self._policy.on_state(state, now)
        before = self._scene.state
        if state.enabled or state.mode != "INIT" or (before is not None and before.boot != state.boot):
            self._is_stopped = False
        elif before is not None and before.enabled and before.mode not in ("INIT", "FAULT"):
            self._is_stopped = True
            self._scene.log_event("operator: somebody has stopped the robot, who will enable it again")
        self._scene.state = state
        self._scene.traces.update(state.traces)
        if self.drive is not None:
            self.drive.on_state(state, now)

    def _on_path(self, _ids: Mapping[str, str], path: RobotPath) -> None:
        known = self._scene.path
        if known is None or (known.planner_epoch, known.plan_id) != (path.planner_epoch, path.plan_id):
            self._scene.log_event(_describe_path(path))
        self._scene.path = path
        self._scene.traces.update(path.traces)
        if self.drive is not None:
            self.drive.on_path(path, self._clock.now())

    def _on_release(self, _ids: Mapping[str, str], release: RobotRelease) -> None:
        if self._scene.path is not None:
            self._scene.path = self._scene.path.after(release)

    def _on_hazard(self, ids: Mapping[str, str], hazard: HazardArea) -> None:
        area, state = ids["area"], hazard.hazard.state
        known = self._scene.hazards.get(area)
        if known is None or known.hazard.state != state:
            # Every area starts as unknown and then becomes clear: that is no news.
            if area in self._reported_areas or state == "blocked":
                self._scene.log_event(f"area {area}: {state} ({hazard.hazard.cause})")
            if state != "unknown":
                self._reported_areas.add(area)
        self._scene.hazards[area] = hazard
        unconfirmed = any(not known.confirmed for known in self._scene.hazards.values())
        if unconfirmed != self._unconfirmed and area in self._reported_areas:
            self._unconfirmed = unconfirmed
            self._scene.log_event(
                "the aggregator does not confirm all areas"
                if unconfirmed
                else "the aggregator confirms all areas again"
            )
        if hazard.hazard.trace is not None:
            self._scene.traces.update([hazard.hazard.trace])

    @property
    def ready_s(self) -> float:
        """For how long (s of the clock) the robot has been ready and waiting only to be enabled."""
        return self._policy.ready_s(self._clock.now())

    # --- commands ---------------------------------------------------------------------------------------------------

    async def command(self, kind: CommandKind, pose: Pose | None = None) -> CommandReply | None:
        """Send the robot a command (`initial_pose` with a pose); None if it did not reply or is not known yet."""
        state = self._scene.state
        if state is None and kind not in STOPS:
            return None
        try:
            return await self._commands.send(kind, self._robot, state, pose)
        except ContractError as error:
            self._log_invalid_reply(error)
            return None

    async def simulate(self, command: SimCommand) -> CommandReply | None:
        """Change the simulated world; return None if the simulator did not reply."""
        try:
            return await self._edge.query(
                ch.SIM_COMMAND, command, CommandReply, _SIMULATOR_TIMEOUT_S, robot=self._robot
            )
        except ContractError as error:
            self._log_invalid_reply(error)
            return None

    def _log_invalid_reply(self, error: ContractError) -> None:
        self._scene.log_event(f"invalid reply on {error.channel}: {error.reason}")

    async def put_goal(self, place: str) -> net.Response:
        """Give the robot its goal by the planner's REST API; raises `OSError` if the planner can't be reached."""
        port = self._stack.port(PLANNER)
        if port is None:
            raise ConnectionError("the planner has not published its port yet")
        url = f"http://{net.LOOPBACK}:{port}"
        return await asyncio.to_thread(put_goal, url, self._robot, place, self._stack.token)

    async def keep_enabled(self) -> None:
        """Send the commands that the operator's policy decides on (enable, reset), until cancelled."""
        while True:
            kind = self._due()
            if kind is not None:
                await self._send(kind)
            await asyncio.sleep(self._clock.real(_POLICY_PERIOD_S))

    def _due(self) -> CommandKind | None:
        # After the drive the robot is left to whoever uses the demo: nobody undoes their commands.
        drive_over = self._scene.outcome is not None
        if self.enabling_paused or self._is_stopped or drive_over:
            return None
        return self._policy.command_due(self._clock.now())

    async def _send(self, kind: CommandKind) -> None:
        reply = await self.command(kind)
        if reply is None:
            self._log_refusal((kind,), f"{kind}: no reply from the robot")
        elif reply.accepted:
            self._last_refusal = ()
            again = " again" if kind == "enable" and self._enabled_once else ""
            self._enabled_once = self._enabled_once or kind == "enable"
            self._scene.log_event(f"operator: {kind}{again}")
        else:
            why = (kind, reply.code, *reply.causes)
            self._log_refusal(why, f"{kind}: refused by the robot, {reply.reason}")

    def _log_refusal(self, why: tuple[str, ...], text: str) -> None:
        """Tell why a command was not carried out, once as long as its identifiers stay the same."""
        if why != self._last_refusal:
            self._last_refusal = why
            self._scene.log_event(f"operator: {text}")


def _describe_mode(state: RobotState, *, first: bool) -> str:
    if first and state.mode == "INIT":
        return "robot: INIT (just started: it localizes, then waits to be enabled)"
    reasons = f" ({'; '.join(state.reasons[:2])})" if state.reasons else ""
    return f"robot: {state.mode}{reasons}"


def _describe_path(path: RobotPath) -> str:
    if path.refusal is not None:
        return f"planner: no path, {path.refusal.name}: {path.refusal.reason}"
    return f"planner: plan {path.plan_id}, {path_length(path.points):.1f} m"
