"""A whole system on a generated floor, for measurements of the robot: its three processes are the real ones.

Fog, router and simulator run beside them as processes of their own; base and lidar are emulators on ptys.
"""

from __future__ import annotations

import asyncio
import time
from itertools import cycle
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final

from fog_contracts import channels as ch
from fog_contracts.messages import RobotPose, RobotState
from fog_runtime.clock import SystemClock
from fog_runtime.configuration.maps import save_map
from fog_runtime.robot_commands import RobotCommands
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fog_supervisor import net
from fognav.programs import AGENT, PLANNER, ROBOT, WATCHDOG
from fognav.stack import Stack, StackConfig
from fognav.stack_doors import Doors
from fognav_experiments.bench.office import corridor_rows, make_office
from fognav_experiments.bench.running import RunningSystem, first_child
from fognav_sim.drive.operator import OperatorPolicy
from fognav_sim.planner_client import put_goal

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from fog_contracts.grid import StaticMap
    from fog_supervisor.supervisor import Event

NAME: Final = "r1"
FLOOR_M: Final = (100.0, 57.0)
"""2000 x 1140 cells of 5 cm."""
GUARDIAN: Final = "robot-guardian"
_PLACES: Final = ("far", "near")
_SITE: Final = "bench"
_WAIT_S: Final = 90.0
_POLL_S: Final = 0.01
_OPERATOR_S: Final = 0.5
_DRIVING_M_S: Final = 0.2


def write_site(folder: Path, floor: StaticMap) -> Path:
    """Write a site with a robot in the south-west of an office, and a place in its north-east; return its folder."""
    right = floor.geometry.bounds[2]
    far, near = _PLACES
    rows = corridor_rows(floor.geometry.bounds[3])
    save_map(folder / "map", floor)
    (folder / "site.toml").write_text(
        f'id = "{_SITE}"\nname = "Benchmark floor"\nmap = "map.yaml"\n'
        f"[places.{far}]\nx = {right - 4.0:.1f}\ny = {rows[-1]:.1f}\n"
        f"[places.{near}]\nx = 4.0\ny = {rows[0]:.1f}\n"
        f'[[robots]]\nid = "{NAME}"\nstart = {{ x = 4.0, y = {rows[0]:.1f}, theta = 0.0 }}\nradius = 0.17\n',
        "utf-8",
    )
    return folder


class RobotSystem(RunningSystem):
    """The running system, with an operator who keeps the robot enabled."""

    def __init__(self, on_start: Callable[[int], object], settings: Mapping[str, str] | None = None) -> None:
        """`on_start` is called with the id of each process of the robot that is started, but not with its children.

        `settings`: further FOGNAV_* variables of all processes, named without the prefix.
        """
        super().__init__()
        self._on_start = on_start
        self._settings = settings
        self._started_at: dict[str, float] = {}
        self._clock = SystemClock()
        self._policy = OperatorPolicy(self._clock.now())
        self.state: RobotState | None = None
        self.speed = 0.0
        """The robot's speed (m/s) by its own last pose."""
        self._goals = cycle(_PLACES)

    async def _start(self) -> None:
        contexts = self._contexts
        folder = Path(contexts.enter_context(TemporaryDirectory(prefix="fognav-bench-")))
        site = await asyncio.to_thread(write_site, folder, make_office(*FLOOR_M))
        doors = Doors(site=_SITE, robots=(NAME,))
        config = StackConfig(site_dir=site, robot=NAME, extra=self._settings, doors=doors)
        self.stack = await contexts.enter_async_context(Stack(config, self._on_event))
        await self.stack.start()
        edge = await contexts.enter_async_context(
            ZenohEdge.open(
                connect=[self.stack.zenoh_endpoint],
                clock=self._clock,
                role="console",
                id="bench",
                site=_SITE,
                credentials=self.stack.doors.credentials("console"),
            )
        )
        self._commands = RobotCommands(edge, operator="bench", key=self.stack.operator_key)
        edge.subscribe(ch.ROBOT_STATE, RobotState, self._on_state, robot=NAME)
        edge.subscribe(ch.ROBOT_POSE, RobotPose, self._on_pose, robot=NAME)
        tasks = await contexts.enter_async_context(asyncio.TaskGroup())
        operator = tasks.create_task(self._operate())
        contexts.callback(operator.cancel)

    def _on_event(self, event: Event) -> None:
        if event.kind == "started" and event.program in ROBOT:
            self._started_at[event.program] = event.time_s
            pid = self.stack.supervisor.pid(event.program)
            if pid is not None:
                self._on_start(pid)

    def _on_state(self, _ids: dict[str, str], state: RobotState) -> None:
        self.state = state
        self._policy.on_state(state, self._clock.now())

    def _on_pose(self, _ids: dict[str, str], pose: RobotPose) -> None:
        self.speed = abs(pose.v)

    async def _operate(self) -> None:
        while True:
            command, state = self._policy.command_due(self._clock.now()), self.state
            if command is not None and state is not None:
                await self._commands.send(command, NAME, state)
            await asyncio.sleep(_OPERATOR_S)

    def pids(self) -> dict[str, int]:
        """Return the ids of the robot's processes, the guardian among them."""
        pids = {name: pid for name, pid in self.stack.pids().items() if name in ROBOT}
        guardian = first_child(pids[WATCHDOG])
        if guardian is not None:
            pids[GUARDIAN] = guardian
        return pids

    async def restart_agent(self) -> float:
        """Restart the agent; return how long (s) it took from its start until it was ready."""
        await self.stack.supervisor.stop(AGENT)
        self.state = None
        self.stack.supervisor.start(AGENT)
        deadline = time.monotonic() + _WAIT_S
        while (problem := await net.readiness(self.stack.port_file(AGENT))) is not None:
            if time.monotonic() > deadline:
                raise TimeoutError(f"the agent was not ready within {_WAIT_S:.0f} s: {problem}")
            await asyncio.sleep(_POLL_S)
        return time.monotonic() - self._started_at[AGENT]

    async def wait_enabled(self) -> None:
        """Wait until the robot is enabled and in NORMAL mode."""
        await self._until(lambda: self.state is not None and self.state.mode == "NORMAL", "the robot is in NORMAL mode")

    async def start_drive(self) -> None:
        """Send the robot to the other end of the floor, some two minutes away or more, and wait until it drives."""
        await self._send_goal()
        await self._until(lambda: self.speed > _DRIVING_M_S, "the robot drives")

    async def _send_goal(self) -> None:
        place = next(self._goals)
        port = self.stack.port(PLANNER)
        answer = await asyncio.to_thread(put_goal, f"http://{net.LOOPBACK}:{port}", NAME, place, self.stack.token)
        if answer.status >= 300:
            raise RuntimeError(f"the planner refused the goal: HTTP {answer.status}, {answer.reason}")

    async def _until(self, condition: Callable[[], bool], expected: str) -> None:
        deadline = time.monotonic() + _WAIT_S
        while not condition():
            if time.monotonic() > deadline:
                state = self.state
                situation = "no state received" if state is None else f"{state.mode}: {'; '.join(state.reasons)}"
                raise TimeoutError(f"not within {_WAIT_S:.0f} s: {expected}; {situation}")
            await asyncio.sleep(_POLL_S)
