"""The whole stack on the site `estig` with the demo's operator, and what the tests need to monitor and to break it."""

from __future__ import annotations

import asyncio
import json
import math
import os
import re
import shutil
import time
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Self

import programs
from lateness import Lateness

from fog_contracts import channels as ch
from fog_contracts.messages import NodeReading, SimCommand
from fog_runtime.clock import SystemClock
from fog_runtime.configuration.parts import DEFAULT_BASE, DEFAULT_LIDAR
from fog_runtime.configuration.site import load_site
from fog_runtime.transports.mqtt_edge import MqttEdge
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fog_supervisor import net
from fognav.demo.machine import children
from fognav.demo.operator import Operator
from fognav.demo.scene import Scene
from fognav.programs import AGENT, PLANNER, WATCHDOG
from fognav.stack import Stack, StackConfig, users_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from fog_contracts.messages import RobotState, SimTruth
    from fog_supervisor.supervisor import Event

ESTIG = Path(__file__).parents[2] / "sites" / "estig"
ROBOT = "r1"
START = (36.0, 28.4)
"""In the middle corridor, two metres before the area z1."""
MIN_WHEEL_SPEED = 0.15
"""Mean wheel speed (m/s) above which the robot counts as driving."""


def site_that_starts_at(folder: Path, x: float, y: float) -> Path:
    """Copy the site, with another start of its robot."""
    shutil.copytree(ESTIG, folder, ignore=shutil.ignore_patterns("__pycache__"))
    file = folder / "site.toml"
    text, changes = re.subn(r"start = \{.*\}", f"start = {{ x = {x}, y = {y}, theta = 0.0 }}", file.read_text("utf-8"))
    assert changes == 1
    file.write_text(text, "utf-8")
    return folder


@dataclass(frozen=True)
class TruthLine:
    """One line of the simulator's truth log."""

    at: float
    left: float
    right: float
    x: float
    y: float
    contacts: int

    @property
    def stopped(self) -> bool:
        """Whether both wheels are commanded to stop."""
        return self.left == 0.0 and self.right == 0.0

    @property
    def speed(self) -> float:
        """Commanded speed of the robot (m/s)."""
        return abs(self.left + self.right) / 2


class LiveSystem:
    """A running stack and its operator."""

    def __init__(
        self, folder: Path, *, base: str = DEFAULT_BASE, lidar: str = DEFAULT_LIDAR, patience: float = 1.0
    ) -> None:
        """`patience` multiplies the time limits of waiting, for tests that measure nothing."""
        self._patience = patience
        self.events: list[Event] = []
        self.readings: list[NodeReading] = []
        self._truth_log = folder / "truth.jsonl"
        self._site = load_site(site_that_starts_at(folder / "site", *START))
        config = StackConfig(
            site_dir=self._site.directory,
            robot=ROBOT,
            base=base,
            lidar=lidar,
            extra={"TRUTH_LOG": str(self._truth_log)},
            users=users_of(self._site.site),
        )
        self.stack = Stack(config, self.events.append)
        self.clock = SystemClock()
        self.scene = Scene(self._site, ROBOT, 1, 1.0)
        self._contexts = AsyncExitStack()
        self._enabling: asyncio.Task[None] | None = None

    async def __aenter__(self) -> Self:
        try:
            self._contexts.enter_context(programs.fork_supervised())
            await self._contexts.enter_async_context(self.stack)
            await self.stack.start()
            edge = await self._contexts.enter_async_context(
                ZenohEdge.open(
                    connect=[self.stack.zenoh_endpoint],
                    clock=self.clock,
                    role="console",
                    id="test",
                    site=self._site.site.id,
                    credentials=self.stack.security.credentials("console"),
                )
            )
            self.operator = Operator(edge, self.stack, self.scene, self.clock)
            console = self.stack.security.credentials("console")
            mqtt = MqttEdge(self.stack.mqtt_url, "live-test", self.clock, site=self._site.site.id, credentials=console)
            mqtt.on(ch.NODE_READING, self._on_reading, NodeReading)
            listening = asyncio.create_task(mqtt.run())
            self._contexts.push_async_callback(_end, listening)
            self.start_operator()
            await self.until(lambda: self.scene.truth is not None, 10, "the ground truth is received")
            await self.until(lambda: bool(self.scene.pose and self.scene.pose.localized), 30, "the robot is localized")
            await self.wait_all_clear(20)
        except BaseException:
            await self.__aexit__(None, None, None)
            raise
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.stop_operator()
        await self._contexts.aclose()

    def _on_reading(self, ids: dict[str, str], reading: NodeReading) -> None:
        if ids["node"] == "n1":
            self.readings.append(reading)

    # --- the operator ---

    def start_operator(self) -> None:
        """Start the operator, who enables the robot whenever it waits for that."""
        if self._enabling is None:
            self._enabling = asyncio.create_task(self.operator.keep_enabled())

    async def stop_operator(self) -> None:
        """Stop the operator: nobody enables the robot any more."""
        if self._enabling is not None:
            await _end(self._enabling)
            self._enabling = None

    async def send_goal(self, x: float, y: float) -> net.Response:
        """Send the robot to a position, with any heading."""
        body = {"pose": {"x": x, "y": y}}
        return await self.request(PLANNER, "PUT", f"/api/v1/robots/{ROBOT}/goal", body)

    async def request(self, service: str, method: str, path: str, body: object) -> net.Response:
        """Send an HTTP request to a service, with the administrator's token."""
        port = self.stack.port(service)
        assert port is not None
        return await asyncio.to_thread(net.request, method, port, path, body=body, token=self.stack.token)

    async def simulate(self, command: SimCommand) -> None:
        """Change the simulated world."""
        reply = await self.operator.simulate(command)
        assert reply is not None
        assert reply.accepted, reply.reason

    # --- monitoring ---

    @property
    def truth(self) -> SimTruth:
        """The latest ground truth."""
        assert self.scene.truth is not None
        return self.scene.truth

    @property
    def state(self) -> RobotState:
        """The robot's latest state."""
        assert self.scene.state is not None
        return self.scene.state

    @property
    def localization_error(self) -> float:
        """Distance (m) between the robot's estimated and true position."""
        pose = self.scene.pose
        assert pose is not None
        return math.hypot(pose.x - self.truth.x, pose.y - self.truth.y)

    def hazard(self, area: str) -> str:
        """Return an area's published state."""
        known = self.scene.hazards.get(area)
        return known.hazard.state if known else "not published"

    @property
    def guardian(self) -> int | None:
        """Process id of the guardian."""
        watchdog = self.stack.supervisor.pid(WATCHDOG)
        return next(iter(children(watchdog)), None) if watchdog is not None else None

    def starts(self) -> dict[str, int]:
        """How often each process was started."""
        return {name: self.stack.supervisor.starts(name) for name in self.stack.supervisor.names}

    def log_lines(self, since: float) -> list[TruthLine]:
        """Return the lines of the truth log since a moment (monotonic s)."""
        found = []
        with self._truth_log.open("rb") as file:
            # 100 lines a second of at most some 300 bytes.
            file.seek(0, 2)
            file.seek(max(0, file.tell() - int((time.monotonic() - since + 1.0) * 100 * 300)))
            texts = file.read().split(b"\n")[1:-1]
        for text in texts:
            line = json.loads(text)
            if line["t_mono"] >= since:
                found.append(
                    TruthLine(line["t_mono"], line["left"], line["right"], line["x"], line["y"], line["contacts"])
                )
        return found

    def stopping_time(self, moment: float) -> float:
        """Return the time (s) from a moment until the wheels stopped for good; fails if they still turn."""
        lines = self.log_lines(moment)
        assert lines
        assert lines[-1].stopped, "the wheels still turn"
        last = max((line.at for line in lines if not line.stopped), default=moment)
        return last - moment

    def lateness(self) -> Lateness:
        """Return what tells how late a busy machine makes this process and its programs from now on."""

        def pids() -> list[int]:
            started = list(self.stack.pids().values())
            return [os.getpid(), *started, *(one for pid in started for one in children(pid))]

        return Lateness(pids)

    # --- waiting ---

    async def until(self, condition: Callable[[], bool], timeout_s: float, description: str) -> None:
        """Wait until the condition holds."""
        deadline = time.monotonic() + timeout_s * self._patience
        while not condition():
            if time.monotonic() > deadline:
                raise AssertionError(
                    f"timeout after {timeout_s:.0f} s, waiting until {description}; {self.situation()}"
                )
            await asyncio.sleep(0.02)

    def situation(self) -> str:
        """Return the robot's state and the last events, for the message of a failure."""
        events = "\n".join(f"{at:7.1f} {text}" for at, text in list(self.scene.events)[-25:])
        position = f"({self.truth.x:.2f}, {self.truth.y:.2f})"
        return f"the robot is in {self.state.mode} at {position}: {self.state.reasons}\n{events}"

    async def wait_all_clear(self, timeout_s: float) -> None:
        """Wait until every watched area is clear."""
        areas = {node.area for node in self._site.site.nodes}
        await self.until(lambda: all(self.hazard(area) == "clear" for area in areas), timeout_s, "all areas are clear")

    async def drive_to(self, x: float, y: float, timeout_s: float = 30) -> None:
        """Send the robot to a position, and wait until it drives in NORMAL mode."""
        answer = await self.send_goal(x, y)
        assert answer.status in (200, 201), answer
        await self.wait_driving(timeout_s)

    async def wait_driving(self, timeout_s: float = 30) -> None:
        """Wait until the robot drives in NORMAL mode."""
        await self.until(
            lambda: self.state.mode == "NORMAL" and self.truth.left + self.truth.right > 2 * MIN_WHEEL_SPEED,
            timeout_s,
            "the robot drives",
        )

    async def wait_progress(self, timeout_s: float = 40) -> None:
        """Wait until the robot's path to its goal is one metre shorter."""
        await self.until(lambda: self.state.goal_distance is not None, timeout_s, "the robot has a path")
        before = self.state.goal_distance or 0.0
        await self.until(
            lambda: (self.state.goal_distance or math.inf) < before - 1.0,
            timeout_s,
            f"the remaining path is 1 m shorter than {before:.1f} m",
        )

    async def wait_agent_restarted(self, starts: int, timeout_s: float = 30) -> None:
        """Wait until the agent was restarted and publishes."""
        supervisor = self.stack.supervisor
        await self.until(lambda: supervisor.starts(AGENT) > starts, timeout_s, "the agent is restarted")
        stamp = self.clock.stamp()
        await self.until(lambda: self.state.stamp > stamp, timeout_s, "the new agent publishes")


async def _end(task: asyncio.Task[None]) -> None:
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
