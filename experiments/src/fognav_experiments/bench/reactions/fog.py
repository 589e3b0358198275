"""The fog as one robot sees it, played by hand over a real zenoh router: map-service, planner and operator.

Each of its parts can fall silent, lose a message or change the map at a known moment.
"""

from __future__ import annotations

import asyncio
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts import channels as ch
from fog_contracts.costs import LETHAL, Inflation
from fog_contracts.grid import Window
from fog_contracts.messages import Pose, RobotGoal, RobotPath, RobotPose, RobotRelease, RobotState
from fog_contracts.replica import MasterMap
from fog_kernels.inflation import inflate, inflation_table
from fog_runtime.robot_commands import RobotCommands

if TYPE_CHECKING:
    from collections.abc import Callable

    from fog_contracts.grid import StaticMap
    from fog_contracts.messages import MapSnapshot
    from fog_runtime.clock import SystemClock
    from fog_runtime.transports.zenoh_edge import ZenohEdge

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
        if state is None:
            return
        waits = state.mode == "INIT" or any("an operator must enable" in reason for reason in state.reasons)
        if state.mode == "FAULT":
            await self._commands.send("reset", ROBOT, state)
        elif waits:
            await self._commands.send("enable", ROBOT, state)

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
