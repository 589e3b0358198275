"""What a person at the console would do: watch, enable, send, and (for the simulation) put a barrier in the way."""

import asyncio
import http.client
import re
import secrets
from collections.abc import Mapping
from typing import TYPE_CHECKING, Final

from fog_contracts import channels as ch
from fog_contracts.codec import ContractError
from fog_contracts.commands import sign
from fog_contracts.messages import (
    CommandKind,
    CommandReply,
    HazardArea,
    Message,
    Pose,
    RobotCommand,
    RobotGoal,
    RobotObstacles,
    RobotPath,
    RobotPose,
    RobotState,
    SimCommand,
    SimTruth,
)
from fog_runtime.clock import Clock
from fog_runtime.zenoh_edge import ZenohEdge
from fog_supervisor import net
from fognav.demo.scene import Scene
from fognav.stack import PLANNER, Stack
from fognav_sim.drive.hazard import path_length
from fognav_sim.drive.operator import OperatorPolicy

if TYPE_CHECKING:
    from fognav_sim.drive.evaluation import DriveEvaluation

_ASK_TIMEOUT_S: Final = 2.0
_ENABLE_EVERY_S: Final = 1.0


class Operator:
    """Feeds the scene from the channels, and acts. Everything runs on the loop's thread."""

    def __init__(self, edge: ZenohEdge, stack: Stack, scene: Scene, clock: Clock) -> None:
        self._edge = edge
        self._stack = stack
        self._scene = scene
        self._clock = clock
        self._robot = scene.robot
        self.evaluation: DriveEvaluation | None = None
        self.held_back = False
        """While this is so, nobody wants the robot to drive yet: it is not enabled."""
        self._policy = OperatorPolicy(clock.now())
        self._mode = ""
        self._spoke_of: set[str] = set()
        self._last_refusal = ""
        self._enabled_once = False
        robot = {"robot": self._robot}
        edge.subscribe(ch.ROBOT_POSE, RobotPose, self._on_pose, **robot)
        edge.subscribe(ch.ROBOT_STATE, RobotState, self._on_state, **robot)
        edge.subscribe(ch.ROBOT_PATH, RobotPath, self._on_path, **robot)
        edge.subscribe(ch.ROBOT_GOAL, RobotGoal, self._on_goal, **robot)
        edge.subscribe(ch.ROBOT_OBSTACLES, RobotObstacles, self._on_obstacles, **robot)
        edge.subscribe(ch.SIM_TRUTH, SimTruth, self._on_truth, **robot)
        edge.subscribe(ch.HAZARD, HazardArea, self._on_hazard)

    # --- watching ---------------------------------------------------------------------------------------------------

    def _on_pose(self, _ids: Mapping[str, str], pose: RobotPose) -> None:
        self._scene.pose = pose

    def _on_goal(self, _ids: Mapping[str, str], goal: RobotGoal) -> None:
        self._scene.goal = goal

    def _on_obstacles(self, _ids: Mapping[str, str], obstacles: RobotObstacles) -> None:
        self._scene.obstacles = obstacles

    def _on_truth(self, _ids: Mapping[str, str], truth: SimTruth) -> None:
        self._scene.take_truth(truth)
        if self.evaluation is not None:
            self.evaluation.on_truth(truth)

    def _on_state(self, _ids: Mapping[str, str], state: RobotState) -> None:
        now = self._clock.now()
        if state.mode != self._mode:
            self._scene.say(_mode_news(state, first=not self._mode))
            self._mode = state.mode
        self._policy.on_state(state, now)
        self._scene.state = state
        self._scene.traces.update(state.traces)
        if self.evaluation is not None:
            self.evaluation.on_state(state, now)

    def _on_path(self, _ids: Mapping[str, str], path: RobotPath) -> None:
        known = self._scene.path
        if known is None or (known.planner_epoch, known.plan_id) != (path.planner_epoch, path.plan_id):
            self._scene.say(_path_news(path))
        self._scene.path = path
        self._scene.traces.update(path.traces)
        if self.evaluation is not None:
            self.evaluation.on_path(path, self._clock.now())

    def _on_hazard(self, ids: Mapping[str, str], hazard: HazardArea) -> None:
        area, state = ids["area"], hazard.hazard.state
        known = self._scene.hazards.get(area)
        if known is None or known.hazard.state != state:
            # That nothing was heard of an area yet, and then that it is clear, is how every area begins.
            if area in self._spoke_of or state == "blocked":
                self._scene.say(f"area {area}: {state} ({hazard.hazard.cause})")
            if state != "unknown":
                self._spoke_of.add(area)
            self._scene.hazards[area] = hazard
        if hazard.hazard.trace is not None:
            self._scene.traces.update([hazard.hazard.trace])

    @property
    def ready_s(self) -> float:
        """For how long (s of the clock) the robot has lacked nothing but an operator who enables it."""
        return self._policy.ready_s(self._clock.now())

    # --- acting -----------------------------------------------------------------------------------------------------

    async def command(self, kind: CommandKind, pose: Pose | None = None) -> CommandReply | None:
        """Send the robot a signed command (`initial_pose` with a pose); None when it did not answer."""
        unsigned = RobotCommand(
            kind=kind,
            pose=pose,
            robot=self._robot,
            operator="demo",
            nonce=secrets.token_hex(16),
            issued_at=self._clock.stamp(),
        )
        signed = sign(unsigned, self._stack.operator_key)
        return await self._ask(ch.ROBOT_COMMAND, signed)

    async def simulate(self, command: SimCommand) -> CommandReply | None:
        """Change the simulated world; None when the simulator did not answer."""
        return await self._ask(ch.SIM_COMMAND, command)

    async def _ask(self, channel: ch.Channel, request: Message) -> CommandReply | None:
        try:
            return await self._edge.query(channel, request, CommandReply, _ASK_TIMEOUT_S, robot=self._robot)
        except ContractError as error:
            self._scene.say(f"an answer on {channel.name} can't be used: {error.reason}")
            return None

    async def put_goal(self, place: str) -> net.Response:
        """Give the robot its goal over the planner's REST interface; raises `OSError` when the planner is away."""
        port = self._stack.port(PLANNER)
        if port is None:
            raise ConnectionError("the planner has not said where it listens")
        try:
            return await asyncio.to_thread(
                net.request,
                "PUT",
                port,
                f"/api/v1/robots/{self._robot}/goal",
                body={"place": place},
                token=self._stack.token,
            )
        except http.client.HTTPException as error:
            raise ConnectionError(f"the planner broke off: {error!r}") from error

    async def keep_enabled(self) -> None:
        """Enable the robot whenever it asks for it, after a look at why it stands; runs until cancelled."""
        while True:
            kind = self._due()
            if kind is not None:
                await self._act(kind)
            await asyncio.sleep(self._clock.real(_ENABLE_EVERY_S))

    def _due(self) -> CommandKind | None:
        drive_over = self.evaluation is None and self._scene.outcome is not None
        return None if self.held_back or drive_over else self._policy.command_due(self._clock.now())

    async def _act(self, kind: CommandKind) -> None:
        reply = await self.command(kind)
        if reply is None:
            self._refused(f"{kind}: the robot did not answer")
        elif reply.accepted:
            self._last_refusal = ""
            again = " again" if kind == "enable" and self._enabled_once else ""
            self._enabled_once = self._enabled_once or kind == "enable"
            self._scene.say(f"operator: {kind}{again}")
        else:
            self._refused(f"{kind}: the robot refuses, {reply.reason}")

    def _refused(self, text: str) -> None:
        # Seconds in a reason run on: only other words are news.
        words = re.sub(r"\d+(\.\d+)?", "#", text)
        if words != self._last_refusal:
            self._last_refusal = words
            self._scene.say(f"operator: {text}")


def _mode_news(state: RobotState, *, first: bool) -> str:
    if first and state.mode == "INIT":
        return "robot: INIT, it has just started, looks for where it is, and stands until somebody enables it"
    why = f" ({'; '.join(state.reasons[:2])})" if state.reasons else ""
    return f"robot: {state.mode}{why}"


def _path_news(path: RobotPath) -> str:
    if path.refusal is not None:
        return f"planner: no way, {path.refusal.name}: {path.refusal.reason}"
    return f"planner: plan {path.plan_id}, {path_length(path.points):.1f} m"
