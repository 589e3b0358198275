"""A robot's states, and its stop, straight over the zenoh router of a running system."""

import asyncio
import getpass
from collections import deque
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager
from typing import Final

from fog_contracts import channels as ch
from fog_contracts.codec import ContractError
from fog_contracts.messages import CommandKind, RobotPath, RobotPose, RobotState
from fog_runtime.clock import SystemClock
from fog_runtime.robot_commands import REPLY_TIMEOUT_S, RobotCommands
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fognav.operate.fog import Fog, router
from fognav.operate.outcome import Outcome
from fognav.output import FailedError

STATE_TIMEOUT_S: Final = 3.0
"""Real seconds to wait for a robot's state, which comes once a second of its clock, and on change; at a simulated speed
below 1 as much longer."""
_PATHS: Final = 64


class Robot:
    """A robot of a running system: its latest state, pose and paths, and what stops it."""

    def __init__(self, edge: ZenohEdge, fog: Fog, robot: str, clock: SystemClock) -> None:
        self._edge = edge
        self._fog = fog
        self.clock = clock
        self.id = robot
        self._paths: deque[RobotPath] = deque(maxlen=_PATHS)
        self.state: RobotState | None = None
        self.pose: RobotPose | None = None
        self._changed = asyncio.Event()
        edge.subscribe(ch.ROBOT_STATE, RobotState, self._on_state, robot=robot)
        edge.subscribe(ch.ROBOT_POSE, RobotPose, self._on_pose, robot=robot)
        edge.subscribe(ch.ROBOT_PATH, RobotPath, self._on_path, robot=robot)

    def _on_state(self, _ids: Mapping[str, str], state: RobotState) -> None:
        self.state = state
        self._changed.set()

    def _on_pose(self, _ids: Mapping[str, str], pose: RobotPose) -> None:
        self.pose = pose

    def _on_path(self, _ids: Mapping[str, str], path: RobotPath) -> None:
        self._paths.append(path)

    def take_paths(self) -> list[RobotPath]:
        """Return the paths and refusals that the planner published since the last call, as far as they were kept."""
        taken = list(self._paths)
        self._paths.clear()
        return taken

    async def next_state(self) -> RobotState | None:
        """Return the next state that the robot publishes, or None when none comes in time."""
        self._changed.clear()
        try:
            async with asyncio.timeout(STATE_TIMEOUT_S / min(1.0, self.clock.speed)):
                await self._changed.wait()
        except TimeoutError:
            return None
        return self.state

    async def stop(self, kind: CommandKind = "disable", *, on_reply: Callable[[], None] | None = None) -> Outcome:
        """Send one of the commands that stop a robot, and need no signature.

        `on_reply` is called when the robot has replied, before its mode is waited for.
        Raises `FailedError` when the robot does not answer.
        """
        commands = RobotCommands(self._edge, operator=getpass.getuser(), key=None)
        try:
            # The timeout is in the clock's seconds, of which more pass in a fast simulation.
            timeout_s = REPLY_TIMEOUT_S * max(1.0, self.clock.speed)
            reply = await commands.send(kind, self.id, None, timeout_s=timeout_s)
        except ContractError as error:
            raise FailedError(f"robot {self.id} gave an invalid reply: {error}. Check that versions match") from error
        if reply is None:
            raise FailedError(
                f"robot {self.id} did not answer within {REPLY_TIMEOUT_S:.0f} s. Check its id, that its agent runs, "
                f"and that it is connected to {router(self._fog)}"
            )
        if on_reply is not None:
            on_reply()
        after = await self.next_state()
        return Outcome(
            accepted=reply.accepted,
            reason=reply.reason,
            mode=after.mode if after is not None else None,
            code=reply.code,
            causes=reply.causes,
        )


@asynccontextmanager
async def connect(fog: Fog, robot: str) -> AsyncIterator[Robot]:
    """Connect to a robot; raises `FailedError` when the router can't be reached."""
    clock = SystemClock(fog.system.speed)
    async with ZenohEdge.open(
        connect=[router(fog)], clock=clock, role="console", id=robot, site=fog.site, credentials=fog.credentials
    ) as edge:
        if not edge.connected:
            raise FailedError(f"the zenoh router {router(fog)} can't be reached: check that it runs (fognav status)")
        yield Robot(edge, fog, robot, clock)
