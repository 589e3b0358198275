"""Measures a warning, live: from the first echo of an obstacle at a sensor node to the path that a robot receives.

Broker, Redis, router, aggregator, map-service and planner are processes of their own, with TLS and passwords. The
site's nodes run the firmware's code in this one, in front of a simulated floor, with an MQTT connection each; the
robot is a stand-in with a goal. All times are of this machine's clock.
"""

from __future__ import annotations

import asyncio
import random
import time
from abc import ABC, abstractmethod
from contextlib import asynccontextmanager
from typing import TYPE_CHECKING, Any, Final, NamedTuple, TypeVar

import numpy as np
import zenoh

from fog_contracts import channels as ch
from fog_contracts.codec import decode, encode
from fog_contracts.messages import MapDelta, RobotPath
from fog_runtime.clock import SystemClock, ticker
from fog_runtime.transports.zenoh_edge import session_config
from fog_supervisor.supervisor import NotReadyError, log_tail
from fognav.output import FailedError
from fognav.programs import AGGREGATOR, MAP_SERVICE, PLANNER, SERVERS, SERVICES
from fognav.stack import Stack, StackConfig, users_of
from fognav_experiments.bench.common import ask, following, in_background, standing
from fognav_sim.barrier import BarrierError, barrier_across
from fognav_sim.drive.hazard import draw_hazard, entry_distance
from fognav_sim.live import StillFloor, VirtualNode, run_nodes
from fognav_sim.nodes import make_nodes
from fognav_sim.world import World

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Awaitable, Callable, Iterable, Mapping, Sequence
    from contextlib import AbstractAsyncContextManager

    from fog_contracts.messages import Pose, Trace
    from fog_contracts.site import NodeSite
    from fog_runtime.configuration.site import LoadedSite
    from fog_runtime.credentials import Credentials
    from fog_supervisor import net
    from fognav_sim.drive.hazard import PlannedHazard

    TraceKey = tuple[str, int, int]  # area, epoch and sequence number

T = TypeVar("T")

BENCH: Final = "bench"
"""The user who stands for the robot."""
READY_S: Final = 120.0
TIMEOUT_S: Final = 10.0
"""A warning that has not reached the robot after this is missed."""
POLL_S: Final = 0.02
_NODES_STEP_S: Final = 0.002
"""How often the nodes' code runs, which a board's does without a pause: an echo is timed as exactly."""
_PHASE_S: Final = 0.3
"""Obstacles come at any moment of the nodes' cycle, which is shorter than this."""


class Warned(NamedTuple):
    """The moments (s of this machine's clock) of one warning, in their order."""

    echo: float
    reading: float
    confirmed: float
    delta: float
    path: float


_SPANS: Final = {
    "echo_to_path": ("echo", "path"),
    "echo_to_reading": ("echo", "reading"),
    "reading_to_confirmed": ("reading", "confirmed"),
    "confirmed_to_delta": ("confirmed", "delta"),
    "delta_to_path": ("delta", "path"),
}


class WatchedWorld(World):
    """A world that tells when a node's sonar first measured something nearer than its limit."""

    echo: float | None = None

    def sonar(self, node: NodeSite, index: int) -> float | None:
        """Return what a sonar measures (m)."""
        measured = super().sonar(node, index)
        if self.echo is None and measured is not None and measured < node.sonars[index].range_limit:
            self.echo = time.time()
        return measured


class _Deltas:
    """When the map's deltas arrived (s), by the traces of the hazards in them."""

    def __init__(self) -> None:
        self.arrived: dict[TraceKey, float] = {}

    def on_delta(self, sample: zenoh.Sample) -> None:
        """Note a delta; it is called on another thread."""
        now = time.time()
        delta = decode(ch.MAP_DELTA, sample.payload.to_bytes(), MapDelta)
        for trace in delta.traces:
            self.arrived[_key(trace)] = now


def _key(trace: Trace) -> TraceKey:
    return trace.area, trace.epoch, trace.seq


def first_warning(
    paths: Iterable[Arrived], area: str, placed: float, echo: float | None, deltas: Mapping[TraceKey, float]
) -> Warned | None:
    """Return the moments of the first of these paths around an area that answers an obstacle; None if one is missing.

    The obstacle was placed at `placed` (s), and had its first echo at `echo`. `deltas` says when those of the map
    arrived (s): a path may be here before the delta that it answers, since each has a subscriber of its own.
    """
    for arrived in paths:
        trace = next((t for t in arrived.path.traces if t.area == area and t.first_reading >= placed), None)
        delta = None if trace is None else deltas.get(_key(trace))
        if trace is not None and delta is not None and echo is not None:
            return Warned(echo, trace.first_reading, trace.confirmed, delta, arrived.at)
    return None


async def measure(
    loaded: LoadedSite, rule: str, trials: int, seed: int, on_progress: Callable[[], object]
) -> dict[str, Any]:
    """Return the percentiles (ms) of a debounce rule's warnings; raises `FailedError` when the fog does not answer.

    The site's first robot stands where it starts, and its goal is that of the site's demonstration.
    """
    site = loaded.site
    floor = StillFloor(loaded, (), SystemClock(), world=WatchedWorld)
    assert isinstance(floor.world, WatchedWorld)
    extra = {"DEBOUNCE": rule, "HAZARDS_WAIT_S": "0"}
    users = users_of(site, unrestricted=(BENCH,))
    config = StackConfig(site_dir=loaded.directory, robot="none", extra=extra, users=users)
    async with Stack(config) as stack:
        await stack.start_servers(READY_S)
        for name in SERVICES:
            stack.supervisor.start(name)
        try:
            await stack.supervisor.wait_ready([*SERVERS, *SERVICES], READY_S)
        except NotReadyError as error:
            raise FailedError(f"{error}\n{log_tail(stack.log(PLANNER))}") from error
        async with running_nodes(loaded, floor, stack.mqtt_url, stack.security.credentials):
            own = stack.security.credentials(BENCH)
            settings = session_config("client", connect=[stack.zenoh_endpoint], credentials=own)
            with await asyncio.to_thread(zenoh.open, settings) as session:
                trial = Trials(stack, loaded, floor.world, session, seed)
                async with trial.robot.publishing():
                    warned = [await trial.run(number, on_progress) for number in range(trials)]
    return figures(rule, warned)


def figures(rule: str, warned: Sequence[Warned | None]) -> dict[str, Any]:
    """Return how many warnings were measured and missed, and the percentiles of their pieces (ms)."""
    arrived = [each for each in warned if each is not None]
    row: dict[str, Any] = {"rule": rule, "warnings": len(warned), "missed": len(warned) - len(arrived)}
    for name, (begin, end) in _SPANS.items():
        times = [1000.0 * (getattr(each, end) - getattr(each, begin)) for each in arrived]
        for label, p in (("p50", 50), ("p99", 99), ("max", 100)):
            row[f"{name}_{label}_ms"] = round(float(np.percentile(times, p)), 1) if times else None
    return row


@asynccontextmanager
async def running_nodes(
    loaded: LoadedSite, floor: StillFloor, brokers: str, credentials: Callable[[str], Credentials]
) -> AsyncIterator[None]:
    """Run all nodes of the site, each with its own connection to one of the `brokers` (comma separated)."""
    clock = SystemClock()
    nodes = [
        VirtualNode(sensor, floor, brokers, clock, loaded.site.id, credentials(sensor.node.id))
        for sensor in make_nodes(loaded.site.nodes, int(time.time()), clock.now(), "firmware", apart=0.025)
    ]
    async with in_background(run_nodes(nodes, clock, _NODES_STEP_S), "nodes"):
        yield


class Obstacles(ABC):
    """Obstacles that come and go in an area on the robot's way; the one of `planners` that leads takes the goals."""

    planners: Sequence[str] = (PLANNER,)

    def __init__(self, loaded: LoadedSite, world: WatchedWorld, session: zenoh.Session, seed: int) -> None:
        self.loaded, self.world = loaded, world
        self._seed = seed
        self.random = random.Random(seed)  # noqa: S311  # repeatable, no secret
        self._deltas = _Deltas()
        self.said = ""
        """What the planner last said to a goal."""
        site = loaded.site
        robot = site.robots[0]
        self.robot = StandingRobot(session, site.id, robot.id, robot.start)
        session.declare_subscriber(ch.MAP_DELTA.key(site=site.id), self._deltas.on_delta)

    @abstractmethod
    async def ask(self, service: str, method: str, path: str, body: object = None) -> net.Response:
        """Send a request to a service; return its answer, also a refusal; raises `OSError` if it does not answer."""

    @abstractmethod
    def logs(self) -> str:
        """Return what the services said last."""

    async def meet(self, hazard: PlannedHazard, warned: Callable[[str, float], Awaitable[T]]) -> T:
        """Place the obstacle, return what `warned` does, given its area and when it was placed, and clear up."""
        self.robot.forget()
        self.world.echo = None
        placed = time.time()
        self.world.place(hazard.barrier)
        try:
            return await warned(hazard.area.id, placed)
        finally:
            self.world.remove(hazard.barrier.id)
            await self.until(self._clear, "all areas are clear again")

    def around(self, area: str) -> list[Arrived]:
        """Return the paths since the obstacle that don't enter its area."""
        polygon = next(each.polygon for each in self.loaded.site.areas if each.id == area)
        return [each for each in self.robot.paths if entry_distance(each.path.points, polygon) is None]

    async def drive(self, number: int) -> PlannedHazard:
        """Send the robot to the goal, and return an obstacle on its path."""
        site, seed = self.loaded.site, self._seed + number
        assert site.demo is not None
        goal = site.places[site.demo.goal]
        await self.until(self._clear, "all areas are clear")
        where = {"pose": {"x": goal.x, "y": goal.y}}

        async def accepted() -> bool:
            path = f"/api/v1/robots/{self.robot.id}/goal"
            for planner in self.planners:  # a lease may change hands at any time
                try:
                    answer = await self.ask(planner, "PUT", path, where)
                except OSError as error:  # one whose Redis is slow may not answer in time
                    self.said = f"{planner} did not answer: {error}"
                    continue
                if answer.status == 200 and isinstance(answer.body, dict):
                    return True
                self.said = f"{planner} answered {answer.status}: {answer.body}"
            return False

        self.robot.forget()
        await self.until(accepted, "the planner accepts the goal")

        async def drawn() -> bool:
            return bool(self.robot.paths) and self.robot.paths[-1].path.refusal is None

        await self.until(drawn, "the robot has a path")
        points = self.robot.paths[-1].path.points
        try:
            return draw_hazard(site, points, seed, lambda area: barrier_across(area, site, self.loaded.map, seed))
        except BarrierError as error:
            raise FailedError(str(error)) from error

    async def path_around(self, area: str, placed: float) -> float | None:
        """Return the time (s) from the first echo to the first path around the area; None without one in time.

        A planner that has just taken over does not know which hazard its first path answers: it names none.
        """
        deadline = time.monotonic() + TIMEOUT_S
        while time.monotonic() < deadline:
            arrived = next((each.at for each in self.around(area) if each.at >= placed), None)
            if arrived is not None and self.world.echo is not None:
                return arrived - self.world.echo
            await asyncio.sleep(POLL_S)
        return None

    async def _clear(self) -> bool:
        """Whether the aggregator believes all nodes, and none of them sees anything."""
        answer = await self.ask(AGGREGATOR, "GET", "/api/v1/nodes")
        return isinstance(answer.body, list) and all(node["state"] == "clear" for node in answer.body)

    async def until(self, condition: Callable[[], Any], what: str) -> None:
        """Wait for a condition; raises `FailedError` with `what` was waited for after a long time."""
        deadline = time.monotonic() + READY_S
        while not await condition():
            if time.monotonic() > deadline:
                raise FailedError(f"waited {READY_S:.0f} s until {what}; {self.said}\n{self.logs()}")
            await asyncio.sleep(POLL_S)


class Trials(Obstacles):
    """Obstacles before the nodes of a stack of this machine."""

    def __init__(
        self, stack: Stack, loaded: LoadedSite, world: WatchedWorld, session: zenoh.Session, seed: int
    ) -> None:
        super().__init__(loaded, world, session, seed)
        self.stack = stack

    async def ask(self, service: str, method: str, path: str, body: object = None) -> net.Response:
        """Send a request to a service; return its answer."""
        return await ask(self.stack, service, method, path, body)

    def logs(self) -> str:
        """Return the ends of the services' logs."""
        return "\n".join(log_tail(self.stack.log(name)) for name in (AGGREGATOR, MAP_SERVICE, *self.planners))

    async def run(self, number: int, on_progress: Callable[[], object]) -> Warned | None:
        """Measure one warning, and clear up after it; None if the robot was not warned."""
        hazard = await self.drive(number)
        await asyncio.sleep(self.random.uniform(0.0, _PHASE_S))
        warned = await self.meet(hazard, self._warned)
        on_progress()
        return warned

    async def _warned(self, area: str, placed: float) -> Warned | None:
        deadline = time.monotonic() + TIMEOUT_S
        while time.monotonic() < deadline:
            warned = first_warning(self.around(area), area, placed, self.world.echo, self._deltas.arrived)
            if warned is not None:
                return warned
            await asyncio.sleep(POLL_S)
        return None


class Arrived(NamedTuple):
    """A path, and when it arrived (s of this machine's clock)."""

    at: float
    path: RobotPath


class StandingRobot:
    """A robot that stands at its pose."""

    def __init__(self, session: zenoh.Session, site: str, id: str, pose: Pose) -> None:  # noqa: A002  # the robot's
        self.id = id
        self.paths: list[Arrived] = []
        """Paths and refusals since the last `forget`, oldest first, each plan once."""
        self.taken_over: dict[int, float] = {}
        """When the first path of each planner's epoch arrived (s)."""
        self._latest: RobotPath | None = None
        self._session, self._pose = session, pose
        self._keys = {row: row.key(site=site, robot=id) for row in (ch.ROBOT_POSE, ch.ROBOT_STATE)}
        self._clock = SystemClock()
        session.declare_subscriber(ch.ROBOT_PATH.key(site=site, robot=id), self._on_path)

    def _on_path(self, sample: zenoh.Sample) -> None:
        """Note a path; it is called on another thread."""
        now = time.time()
        path, before = decode(ch.ROBOT_PATH, sample.payload.to_bytes(), RobotPath), self._latest
        if before is not None and path.planner_epoch < before.planner_epoch:
            return  # of a planner that was replaced
        if before is None or (path.planner_epoch, path.plan_id) != (before.planner_epoch, before.plan_id):
            self._latest = path
            self.taken_over.setdefault(path.planner_epoch, now)
            self.paths.append(Arrived(now, path))

    def latest(self) -> RobotPath:
        """Return the latest path; it must have one."""
        assert self._latest is not None
        return self._latest

    def forget(self) -> None:
        """Forget the paths so far."""
        self.paths = []

    def publishing(self) -> AbstractAsyncContextManager[None]:
        """Publish pose and state meanwhile."""
        return in_background(self._publish(), "robot")

    async def _publish(self) -> None:
        x, y, theta = self._pose.x, self._pose.y, self._pose.theta
        async for _ in ticker(self._clock, ch.ROBOT_POSE.period_s):
            stamp = self._clock.stamp()
            self._session.put(self._keys[ch.ROBOT_POSE], encode(ch.ROBOT_POSE, standing(x, y, stamp, theta)))
            if (path := self._latest) is not None:
                self._session.put(self._keys[ch.ROBOT_STATE], encode(ch.ROBOT_STATE, following(path, stamp)))
