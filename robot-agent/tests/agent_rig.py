"""A robot in a tiny world: emulated base and lidar on ptys, a zenoh router, and a map-service and planner by hand.

The world lives in a thread; the robot's three processes are the real ones.
"""

from __future__ import annotations

import asyncio
import math
import os
import threading
import time
import urllib.error
import urllib.request
import uuid
from contextlib import ExitStack
from typing import TYPE_CHECKING

import numpy as np
import programs
from guardian_rig import DEADLINE_S, Base, Process, Watchdog
from little_world import KEY, L_PATH, L_ROOMS, grid_of
from msgspec.structs import replace

from fog_contracts import channels as ch
from fog_contracts.commands import sign
from fog_contracts.costs import LETHAL, Inflation
from fog_contracts.grid import Window
from fog_contracts.messages import (
    CommandReply,
    Pose,
    RobotCommand,
    RobotGoal,
    RobotObstacles,
    RobotPath,
    RobotPose,
    RobotRelease,
    RobotState,
)
from fog_contracts.replica import MasterMap
from fog_kernels.inflation import inflate, inflation_table
from fog_kernels.raycast import cast
from fog_runtime.clock import SystemClock
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fognav_sim.hardware import seen_from_dock
from fognav_sim.pty_port import PtyPort
from robot_agent.lidars.rplidar_a1.emulator import RplidarEmulator

if TYPE_CHECKING:
    from pathlib import Path

    from secured_servers import SecuredRouter

    from fog_runtime.concurrency import Slot

SITE = "lab"
ROBOT = "r1"
AXLE = 0.235


class Body(Base):
    """Base and lidar of a robot in the L-shaped corridors."""

    def __init__(self, folder: Path, pose=(2.0, 2.0, 0.0)) -> None:
        super().__init__(folder / "roomba")
        self.static, self.geometry = grid_of(L_ROOMS, 15.0, 12.0)
        self.solid = (self.static == 254).astype(np.uint8)
        self.pose = pose
        self.dock: tuple[float, float, float] | None = None
        """The robot's pose on its dock; set it before the robot starts."""
        self.scanner = RplidarEmulator(self._measure)
        self.lidar_link = folder / "lidar"
        self.lidar_port = PtyPort(self.lidar_link)
        self._rng = np.random.default_rng(3)
        self._world = threading.Thread(target=self._simulate, daemon=True)

    def __enter__(self):
        super().__enter__()
        self._world.start()
        return self

    def __exit__(self, *details):
        super().__exit__(*details)
        self._world.join()
        self.lidar_port.close()

    def _measure(self, angles, _at):
        g, (x, y, theta) = self.geometry, self.pose
        ranges = cast(self.solid, g.resolution, g.origin_x, g.origin_y, x, y, angles + theta, 12.0)
        return ranges + 0.01 * self._rng.standard_normal(len(ranges))

    def _simulate(self) -> None:
        before = time.monotonic()
        while not self._ends.wait(0.01):
            now = time.monotonic()
            left, right = self.speeds
            x, y, theta = self.pose
            distance, turned = (left + right) / 2 * (now - before), (right - left) / AXLE * (now - before)
            middle = theta + turned / 2
            self.pose = (x + distance * math.cos(middle), y + distance * math.sin(middle), theta + turned)
            if self.dock is not None:
                self.robot.set_dock(
                    *seen_from_dock(self.pose, Pose(x=self.dock[0], y=self.dock[1], theta=self.dock[2]))
                )
            if data := self.lidar_port.read():
                self.scanner.receive(data, now)
            self.lidar_port.write(self.scanner.outgoing(now))
            before = now


class Fog:
    """The fog as the robot sees it: a map with its heartbeat, and a planner with one path."""

    def __init__(self, edge: ZenohEdge, clock: SystemClock, body: Body) -> None:
        self.edge = edge
        self.clock = clock
        table = inflation_table(body.geometry.resolution, Inflation(cost_scaling=6.0))
        self._table = table
        cost = inflate(body.static.copy(), table)
        self.master = MasterMap(SITE, body.geometry, body.static, cost, epoch=7)
        self.goal: RobotGoal | None = None
        self.points: list[tuple[float, float]] = []
        self.serves = True
        self.sent: RobotCommand | None = None
        self.snapshots = 0
        self.states: list[RobotState] = []
        self.poses: Slot[RobotPose] = edge.latest(ch.ROBOT_POSE, RobotPose, robot=ROBOT)
        self.obstacles: Slot[RobotObstacles] = edge.latest(ch.ROBOT_OBSTACLES, RobotObstacles, robot=ROBOT)
        edge.subscribe(ch.ROBOT_STATE, RobotState, self._on_state, robot=ROBOT)
        edge.serve(ch.MAP_SNAPSHOT, self._snapshot)

    def _on_state(self, _ids, state) -> None:
        """End a goal that the robot has reached, as the planner does."""
        self.states.append(state)
        if self.goal is not None and state.goal_reached and state.goal_id == self.goal.goal_id:
            self.goal = replace(self.goal, pose=None)

    def _snapshot(self, _ids, _request):
        self.snapshots += 1
        return self.master.snapshot()

    @property
    def state(self) -> RobotState | None:
        return self.states[-1] if self.states else None

    async def run(self) -> None:
        cycles = 0
        while True:
            cycles += 1
            if self.serves:
                self.edge.publish(ch.MAP_HEARTBEAT, self.master.heartbeat(self.clock.stamp()))
                if self.goal is not None and cycles % 5 == 0:
                    self.plan()
            await asyncio.sleep(0.1)

    def plan(self) -> None:
        version = self.master.version
        self.edge.publish(ch.ROBOT_GOAL, self.goal, robot=ROBOT)
        if self.goal.pose is None:
            return
        path = RobotPath(
            plan_id=1,
            planner_epoch=3,
            goal_id=self.goal.goal_id,
            points=self.points,
            map_epoch=version.epoch,
            map_seq=version.seq,
            released_length=1e3,
            stamp=self.clock.stamp(),
        )
        if self.state is None or self.state.plan_id != path.plan_id or self.state.goal_id != path.goal_id:
            self.edge.publish(ch.ROBOT_PATH, path, robot=ROBOT)
        release = RobotRelease(
            plan_id=path.plan_id,
            planner_epoch=path.planner_epoch,
            released_length=path.released_length,
            map_epoch=version.epoch,
            map_seq=version.seq,
        )
        self.edge.publish(ch.ROBOT_RELEASE, release, robot=ROBOT)

    def block(self, left: float, bottom: float, right: float, top: float) -> None:
        """Make a rectangle (m) lethal in the master costmap."""
        g = self.master.geometry
        window = g.window_around(left, bottom, right - 1e-6, top - 1e-6)
        raw = self.master.static.copy()
        raw[window.rows, window.columns] = LETHAL
        for delta in self.master.write([("cost", Window(0, 0, g.width, g.height), inflate(raw, self._table))], [], []):
            self.edge.publish(ch.MAP_DELTA, delta)

    def send_robot_to_the_corner(self) -> None:
        self.points = L_PATH[:3]
        x, y = self.points[-1]
        self.goal = RobotGoal(goal_id="g1", pose=Pose(x=x, y=y, theta=0.0), stamp=self.clock.stamp(), planner_epoch=3)
        self.plan()

    async def command(self, kind: str, *, key: bytes = KEY) -> CommandReply | None:
        unsigned = RobotCommand(
            kind=kind,
            robot=ROBOT,
            operator="ann",
            nonce=uuid.uuid4().hex,
            boot=self.state.boot,
            issued_at=self.state.clock,
        )
        self.sent = sign(unsigned, key)
        return await self.repeat_command()

    async def repeat_command(self) -> CommandReply | None:
        """Send the last command again, byte by byte, as one who recorded it would."""
        return await self.edge.query(ch.ROBOT_COMMAND, self.sent, CommandReply, 3.0, robot=ROBOT)


class AgentProcess(Process):
    """The agent, as `python -m robot_agent` starts it."""

    ends_within_s = 10.0

    def __init__(
        self, folder: Path, router: SecuredRouter, watchdog: Watchdog, body: Body, further=None, start=(2.0, 2.0, 0.0)
    ) -> None:
        self.log_file = folder / "agent.log"
        self.data = folder / "data"
        self.input_log = folder / "inputs.mcap"
        self._port_file = folder / "agent.port"
        site, key = folder / "site", folder / "operator.key"
        site.mkdir(exist_ok=True)
        x, y, theta = start
        start_pose = f"start = {{ x = {x}, y = {y}, theta = {theta} }}\nradius = 0.17"
        dock = "" if body.dock is None else "dock = {{ x = {}, y = {}, theta = {} }}\n".format(*body.dock)
        (site / "site.toml").write_text(f'id = "{SITE}"\n[[robots]]\nid = "{ROBOT}"\n{start_pose}\n{dock}')
        key.write_text(KEY.hex() + "\n")
        self._environment = {
            **os.environ,
            "FOGNAV_ROBOT": ROBOT,
            "FOGNAV_SITE_DIR": str(site),
            "FOGNAV_DATA_DIR": str(self.data),
            "FOGNAV_LIDAR_PORT": str(body.lidar_link),
            "FOGNAV_GUARDIAN_SOCKET": str(watchdog.socket),
            "FOGNAV_OPERATOR_KEY_FILE": str(key),
            "FOGNAV_ZENOH_CONNECT": router.url,
            **router.site.environment(ROBOT),
            "FOGNAV_PORT_FILE": str(self._port_file),
            "FOGNAV_SEED": "1",
            "FOGNAV_INPUT_LOG": str(self.input_log),
            **(further or {}),
        }

    def start(self) -> None:
        self._port_file.unlink(missing_ok=True)
        self.process = programs.start("robot_agent", self._environment, self.log_file)

    @property
    def port(self) -> int:
        """The port of the agent's health server."""
        return int(self._port_file.read_text())

    def get(self, path: str) -> tuple[int, str]:
        """GET from the agent's health server; status 0 while it is not there."""
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{self.port}{path}", timeout=2.0) as answer:
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            with error:
                return error.code, error.read().decode()
        except (OSError, ValueError):
            return 0, ""


async def until(condition, expected: str, deadline_s: float = DEADLINE_S):
    end = time.monotonic() + deadline_s
    while time.monotonic() < end:
        if value := condition():
            return value
        await asyncio.sleep(0.01)
    raise AssertionError(f"not within {deadline_s} s: {expected}")


def is_by_delay(reason: str) -> bool:
    """Return whether a robot says that a maneuver ended because its computer, or the emulated body, was late."""
    late = ("the agent sent no fresh command", "; this computer was ", "the lidar has been silent for")
    return any(words in reason for words in late)


class Robot:
    """The whole robot, started; `fog` is None until `async with`."""

    def __init__(self, folder: Path, router: SecuredRouter, **further: str) -> None:
        """Prepare; `further` variables configure the agent."""
        self.body = Body(folder)
        self.watchdog = Watchdog(folder, self.body.link)
        self.agent = AgentProcess(folder, router, self.watchdog, self.body, further)
        self.fog: Fog | None = None
        self._router = router
        self._parts = ExitStack()

    async def __aenter__(self):
        for part in (self.body, self.watchdog, self.agent):
            self._parts.enter_context(part)
        clock = SystemClock()
        own = self._router.site.credentials()
        self._open = ZenohEdge.open(
            connect=[self._router.url], clock=clock, role="fog", id="test", site=SITE, credentials=own
        )
        edge = await self._open.__aenter__()
        self.fog = Fog(edge, clock, self.body)
        self._fog_task = asyncio.create_task(self.fog.run())
        return self

    async def __aexit__(self, *details):
        self._fog_task.cancel()
        await asyncio.gather(self._fog_task, return_exceptions=True)
        await self._open.__aexit__(*details)
        await asyncio.to_thread(self._parts.close)

    async def localized(self) -> None:
        """Wait until the robot is localized and needs only an operator's enable."""
        waits = ["waiting for an operator to enable"]
        await until(lambda: self.fog.state and self.fog.state.reasons == waits, "the robot waits for its enable")

    def error(self) -> float:
        """Distance (m) between the robot's estimated and true position."""
        estimate, (x, y, _) = self.fog.poses.get(), self.body.pose
        return math.hypot(estimate.x - x, estimate.y - y)
