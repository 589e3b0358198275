"""One robot for measurements: real watchdog, guardian and agent, emulated devices, and a fog that is played by hand.

The fog is map-service, planner and operator as one robot sees them, over a real zenoh router. Each of its parts can
fall silent, lose a message or change the map at a known moment.
"""

from __future__ import annotations

import asyncio
import os
import random
import secrets
import signal
import sys
from contextlib import suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts import channels as ch
from fog_contracts.costs import LETHAL, ROBOT_RADIUS, Inflation
from fog_contracts.grid import Window
from fog_contracts.messages import Pose, RobotGoal, RobotPath, RobotPose, RobotRelease, RobotState
from fog_contracts.replica import MasterMap
from fog_contracts.site import RobotSite
from fog_kernels.inflation import inflate, inflation_table
from fog_runtime.clock import SystemClock
from fog_runtime.robot_commands import RobotCommands
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fog_supervisor import net
from fog_supervisor.servers import router_program
from fog_supervisor.supervisor import Program, Supervisor
from fognav_experiments.bench.common import RunningSystem, corridor_rows, first_child, make_office
from fognav_experiments.bench.reactions.body import BASE, LIDAR, Body
from fognav_experiments.bench.reactions.hand import SPEED_M_S, Hand
from robot_agent.agent.local_link import socket_beside

if TYPE_CHECKING:
    from collections.abc import Callable

    from fog_contracts.grid import StaticMap
    from fog_contracts.messages import MapSnapshot

ROUTER: Final = "zenoh-router"
WATCHDOG: Final = "watchdog"
AGENT: Final = "agent"
GUARDIAN: Final = "guardian"
_FLOOR_M: Final = (70.0, 18.0)
_START_X_M: Final = 6.0
_READY_S: Final = 90.0
_HAND_READY_S: Final = 20.0
_FAST_M_S: Final = 0.28
_HAND_M_S: Final = SPEED_M_S - 0.01
_STEADY_S: Final = 0.4
_STRAIGHT_M_S: Final = 0.03


class Rig(RunningSystem):
    """The running robot. `folder` gets its files and logs."""

    def __init__(self, seed: int) -> None:
        super().__init__()
        self._rng = random.Random(seed)  # noqa: S311  # when a fault comes, not a secret
        self._seed = seed
        self._clock = SystemClock()
        self._signalled: list[int] = []
        self.hand: Hand | None = None
        """Who drives it by hand."""

    async def _start(self) -> None:
        contexts = self._contexts
        folder = Path(contexts.enter_context(TemporaryDirectory(prefix="fognav-")))
        floor = await asyncio.to_thread(make_office, *_FLOOR_M)
        y = float(corridor_rows(_FLOOR_M[1])[0])
        robot = RobotSite(id=ROBOT, start=Pose(x=_START_X_M, y=y, theta=0.0), radius=ROBOT_RADIUS)
        self.body = contexts.enter_context(Body(folder, floor, robot, self._seed))
        key = secrets.token_bytes(32)
        site = folder / "site"
        site.mkdir()
        start = f"{{ x = {_START_X_M}, y = {y}, theta = 0.0 }}"
        entry = f'[[robots]]\nid = "{ROBOT}"\nstart = {start}\nradius = {ROBOT_RADIUS}\n'
        (site / "site.toml").write_text(f'id = "{SITE}"\n{entry}', "utf-8")
        (folder / "operator.key").write_text(key.hex() + "\n", "utf-8")
        self._supervisor = await contexts.enter_async_context(Supervisor(lambda _event: None))
        endpoint = self._add_programs(folder, site)
        await self._start_program(ROUTER)
        edge = await contexts.enter_async_context(
            ZenohEdge.open(connect=[endpoint], clock=self._clock, role="console", id="bench", site=SITE)
        )
        self.fog = Fog(edge, self._clock, floor, (_START_X_M - 2.0, _FLOOR_M[0] - 4.0), y, key)
        tasks = await contexts.enter_async_context(asyncio.TaskGroup())
        running = tasks.create_task(self.fog.run())
        contexts.callback(running.cancel)
        await self._start_program(WATCHDOG)
        await self._start_program(AGENT)
        contexts.push_async_callback(self.let_go)

    def _add_programs(self, folder: Path, site: Path) -> str:
        port = net.free_port()
        router = router_program(port)
        ready = partial(net.server_problem, router.port, router.probe, router.reply)
        self._supervisor.add(Program(name=ROUTER, arguments=router.command, log=folder / "router.log", ready=ready))
        socket = folder / "guardian.sock"
        self._tools = socket_beside(socket)
        settings = {
            "BASE": BASE, "BASE_PORT": self.body.base_link, "LIDAR": LIDAR, "LIDAR_PORT": self.body.lidar_link,
            "GUARDIAN_SOCKET": socket, "ROBOT": ROBOT, "SITE_DIR": site, "DATA_DIR": folder / "data",
            "OPERATOR_KEY_FILE": folder / "operator.key", "ZENOH_CONNECT": router.url, "SEED": self._seed,
        }  # fmt: skip
        inherited = {name: value for name, value in os.environ.items() if not name.startswith("FOGNAV_")}
        environment = inherited | {f"FOGNAV_{name}": str(value) for name, value in settings.items()}
        for name, module in ((WATCHDOG, "robot_agent.guardian.watchdog"), (AGENT, "robot_agent")):
            arguments = (sys.executable, "-m", module)
            log = folder / f"{name}.log"
            self._supervisor.add(Program(name=name, arguments=arguments, log=log, environment=environment, rank=1))
        return router.url

    async def _start_program(self, name: str) -> None:
        self._supervisor.start(name)
        await self._supervisor.wait_ready([name], _READY_S)

    # --- processes ---

    def pid(self, name: str) -> int:
        """Return the id of a running process; raises `ProcessLookupError` if it does not run."""
        program = WATCHDOG if name == GUARDIAN else name
        pid = self._supervisor.pid(program)
        if pid is not None and name == GUARDIAN:
            pid = first_child(pid)
        if pid is None:
            raise ProcessLookupError(f"{name} does not run")
        return pid

    def signal(self, names: tuple[str, ...], number: signal.Signals) -> None:
        """Send a signal to processes, in one go; `revive` undoes it."""
        pids = [self.pid(name) for name in names]
        for pid in pids:
            os.kill(pid, number)
        self._signalled = pids

    async def revive(self) -> None:
        """Let stopped processes go on, and start ended ones without the delay that is for programs that fail."""
        for pid in self._signalled:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGCONT)
        self._signalled = []
        for name in (WATCHDOG, AGENT):
            if self._supervisor.pid(name) is None:
                await self._supervisor.restart(name)

    # --- driving ---

    async def wait_driving(self) -> None:
        """Wait until the robot drives straight on at full speed, and then for a random moment of its cycles."""
        await self.fog.until(lambda: self.fog.pose is not None, _READY_S, "the robot knows its pose")
        self.fog.send_on()
        await self._steady("NORMAL", _FAST_M_S, _READY_S)

    async def wait_driving_by_hand(self, *, page: bool) -> None:
        """Drive it by hand, by a page or a terminal, until it drives straight on; the operator of its fog waits."""
        await self.fog.until(lambda: self.fog.pose is not None, _READY_S, "the robot knows its pose")
        self.fog.operator_silent = True
        self.hand = Hand(self._tools)
        await (self.hand.hold_page() if page else self.hand.hold_key())
        await self._steady("TELEOP", _HAND_M_S, _HAND_READY_S)

    async def let_go(self) -> None:
        """End driving by hand, if somebody does."""
        if self.hand is not None:
            await self.hand.end()
            self.hand, self.fog.operator_silent = None, False

    async def _steady(self, mode: str, fast: float, timeout_s: float) -> None:
        """Wait until it drives straight on in a mode, faster than this (m/s); raises `TimeoutError`."""
        steady_since: float | None = None
        deadline = self._clock.now() + timeout_s
        while steady_since is None or self._clock.now() - steady_since < _STEADY_S:
            left, right = self.body.wheels
            driving = min(left, right) > fast and abs(left - right) < _STRAIGHT_M_S
            state = self.fog.state
            driving = driving and state is not None and state.mode == mode
            steady_since = (steady_since or self._clock.now()) if driving else None
            if self._clock.now() > deadline:
                await self.fog.until(lambda: False, 0.0, "the robot drives straight on")
            await asyncio.sleep(0.01)
        await asyncio.sleep(self._rng.uniform(0.0, 0.2))

    async def disable(self) -> None:
        """Disable the robot, which also clears its count of protective stops; the operator enables it again."""
        await self.fog.stop_unsigned()


SITE: Final = "bench"
ROBOT: Final = "r1"
_PERIOD_S: Final = 0.1
_RELEASE_CYCLES: Final = 5
_OPERATOR_CYCLES: Final = 3
_MAP_EPOCH: Final = 7
_PLANNER_EPOCH: Final = 3
_TURN_BEFORE_M: Final = 8.0
"""A robot this near to the corridor's end is sent back."""
_ZONE_M: Final = 1.0


class Fog:
    """Map-service, planner and operator of one robot in a corridor along x."""

    def __init__(
        self, edge: ZenohEdge, clock: SystemClock, floor: StaticMap, ends: tuple[float, float], y: float, key: bytes
    ) -> None:
        """Serve a robot that drives to and fro between the `ends` (x, m) of a corridor at `y` (m)."""
        self._edge, self._clock = edge, clock
        self._ends, self._y = ends, y
        cost = inflate(floor.cells.copy(), inflation_table(floor.geometry.resolution, Inflation(cost_scaling=6.0)))
        self._map = MasterMap(SITE, floor.geometry, floor.cells, cost, epoch=_MAP_EPOCH)
        self._commands = RobotCommands(edge, operator="bench", key=key)
        self.state: RobotState | None = None
        self.pose: RobotPose | None = None
        self.map_silent = self.planner_silent = self.operator_silent = False
        self.seq_ahead = 0
        """How many versions ahead of the map each plan claims to be."""
        self._serves_snapshots = asyncio.Event()
        self._serves_snapshots.set()
        self._plan = 0
        self._points: list[tuple[float, float]] = []
        self._zone: Window | None = None
        edge.subscribe(ch.ROBOT_STATE, RobotState, self._on_state, robot=ROBOT)
        edge.subscribe(ch.ROBOT_POSE, RobotPose, self._on_pose, robot=ROBOT)
        edge.serve(ch.MAP_SNAPSHOT, self._snapshot)

    def _on_state(self, _ids: dict[str, str], state: RobotState) -> None:
        self.state = state

    def _on_pose(self, _ids: dict[str, str], pose: RobotPose) -> None:
        self.pose = pose

    async def _snapshot(self, _ids: dict[str, str], _request: None) -> MapSnapshot:
        await self._serves_snapshots.wait()
        return self._map.snapshot()

    async def run(self) -> None:
        """Play the fog until cancelled."""
        cycles = 0
        while True:
            cycles += 1
            if not self.map_silent:
                self._edge.publish(ch.MAP_HEARTBEAT, self._map.heartbeat(self._clock.now()))
            if not self.planner_silent and cycles % _RELEASE_CYCLES == 0:
                self._publish_plan()
            if not self.operator_silent and cycles % _OPERATOR_CYCLES == 0:
                await self._operate()
            await asyncio.sleep(_PERIOD_S)

    async def _operate(self) -> None:
        """Reset a fault and enable a robot that waits for it."""
        state = self.state
        if state is not None and state.awaits_operator:
            await self._commands.send("reset" if state.mode == "FAULT" else "enable", ROBOT, state)

    async def stop_unsigned(self) -> None:
        """Disable the robot, as anybody may."""
        await self._commands.send("disable", ROBOT, None)

    # --- planner ---

    def send_on(self, *, margin: float = 0.0) -> None:
        """Plan along the corridor: on, or back from its end; `margin` (m) from the middle."""
        pose = self.pose
        if pose is None:
            return
        left, right = self._ends
        heading_right = self._points[-1][0] == right if self._points else True
        if heading_right and pose.x > right - _TURN_BEFORE_M:
            heading_right = False
        elif not heading_right and pose.x < left + _TURN_BEFORE_M:
            heading_right = True
        self._plan += 1
        self._points = [(pose.x, self._y + margin), (right if heading_right else left, self._y)]
        self._publish_plan(anew=True)

    def _publish_plan(self, *, anew: bool = False) -> None:
        if not self._points:
            return
        version, stamp = self._map.version, self._clock.stamp()
        goal_id, (x, y) = f"g{self._plan}", self._points[-1]
        goal = RobotGoal(goal_id=goal_id, pose=Pose(x=x, y=y, theta=0.0), stamp=stamp, planner_epoch=_PLANNER_EPOCH)
        self._edge.publish(ch.ROBOT_GOAL, goal, robot=ROBOT)
        seq = version.seq + self.seq_ahead
        if anew or self.state is None or self.state.plan_id != self._plan or self.state.goal_id != goal_id:
            path = RobotPath(
                plan_id=self._plan,
                planner_epoch=_PLANNER_EPOCH,
                goal_id=goal_id,
                points=self._points,
                map_epoch=version.epoch,
                map_seq=seq,
                released_length=1e3,
                stamp=stamp,
            )
            self._edge.publish(ch.ROBOT_PATH, path, robot=ROBOT)
        release = RobotRelease(
            plan_id=self._plan,
            planner_epoch=_PLANNER_EPOCH,
            released_length=1e3,
            map_epoch=version.epoch,
            map_seq=seq,
        )
        self._edge.publish(ch.ROBOT_RELEASE, release, robot=ROBOT)

    # --- map ---

    def block(self, x: float, y: float, *, lost: bool = False) -> None:
        """Make a square of the map lethal, its middle at (x, y; m); if `lost`, its delta and snapshots never arrive."""
        geometry = self._map.geometry
        column, row = geometry.cell(x - _ZONE_M / 2, y - _ZONE_M / 2)
        size = round(_ZONE_M / geometry.resolution)
        self._zone = Window(column, row, size, size)
        self._before = self._map.layers["cost"][self._zone.rows, self._zone.columns].copy()
        if lost:
            self._serves_snapshots.clear()
        self._write(np.full_like(self._before, LETHAL), publish=not lost)

    def unblock(self) -> None:
        """Undo `block`."""
        if self._zone is None:
            return
        self._serves_snapshots.set()
        self._write(self._before, publish=True)
        self._zone = None

    def _write(self, cells: np.ndarray[tuple[int, int], np.dtype[np.uint8]], *, publish: bool) -> None:
        assert self._zone is not None
        deltas = self._map.write([("cost", self._zone, cells)], [], [])
        if publish:
            for delta in deltas:
                self._edge.publish(ch.MAP_DELTA, delta)

    async def until(self, condition: Callable[[], bool], timeout_s: float, expected: str) -> None:
        """Wait for a condition; raises `TimeoutError` that names what was expected and the robot's state."""
        deadline = self._clock.now() + timeout_s
        while not condition():
            if self._clock.now() > deadline:
                state = self.state
                situation = "no state received" if state is None else f"{state.mode}: {'; '.join(state.reasons)}"
                raise TimeoutError(f"not within {timeout_s:.0f} s: {expected}; {situation}")
            await asyncio.sleep(0.005)
