"""Measures a planner's real process with many robots, as `fleet` measures its core: the same floor, places and hazards.

Planner, Redis and zenoh router are processes of their own; map-service and robots are stand-ins in this one. They do
what the planner can see of the real ones, at the real rates: the map with its zones, deltas and heartbeats; poses and
states of robots that stand still and name the path that they have. A time runs from the publication of a hazard and its
delta to the arrival of a robot's path or refusal at that robot's subscriber, on zenoh's own threads, so that both
encodings, the router and the planner's queues count.
"""

from __future__ import annotations

import asyncio
import re
import time
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Final, NamedTuple

import psutil
import zenoh

from fog_contracts import channels as ch
from fog_contracts.codec import decode
from fog_contracts.messages import RobotPath
from fog_runtime.clock import SystemClock, ticker
from fog_runtime.transports.zenoh_edge import ZenohEdge, session_config
from fog_supervisor.supervisor import NotReadyError, log_tail
from fognav.output import FailedError
from fognav.programs import PLANNER, REDIS, ROUTER
from fognav.stack import Stack, StackConfig, StackUsers
from fognav_experiments.bench.common import SITE, ask, following, in_background, standing, write_site
from fognav_experiments.bench.fleet import closures, hazard_message, percentile

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable, Mapping, Sequence

    from fog_contracts.channels import Channel
    from fog_contracts.messages import HazardArea, MapDelta
    from fognav_experiments.bench.fleet import FleetMap, Trip

QUIET_S: Final = 1.0
"""How long no path may change until a measurement ends; the bytes of a change are counted for as long."""
_READY_S: Final = 120.0
_BENCH: Final = "bench"
"""The user who stands for the map-service and the robots."""
_FIELD_BYTES: Final = re.compile(r"^fognav_planner_goal_fields_bytes (\S+)$", re.MULTILINE)


async def measure(
    map_: FleetMap,
    fleet: Mapping[str, Trip],
    trials: int,
    on_progress: Callable[[int, int], object],
    quiet_s: float = QUIET_S,
) -> dict[str, object]:
    """Run the trials and return the figures; times in ms. Raises `FailedError` when the planner does not answer."""
    async with _planner(map_, fleet, quiet_s) as planner:
        await planner.send_all()
        await planner.settle()
        changes = _Changes([], [], [])
        steady = await planner.world.steady_bytes()
        for number, (across, wall) in enumerate(closures(map_, trials)):
            change, seq = planner.world.change, 4 * number
            begin = hazard_message(across, seq, blocked=True)
            changes.replanned.append(await change(map_.put(across), begin, refused=False))
            end = hazard_message(across, seq + 1, blocked=False)
            await change(map_.clear(across), end, refused=False)
            # New goals: a path that was just moved to another way would not be moved back for a while.
            await planner.send_all()
            await planner.settle()
            begin = hazard_message(wall, seq + 2, blocked=True)
            changes.cut_off.append(await change(map_.put(wall), begin, refused=True))
            end = hazard_message(wall, seq + 3, blocked=False)
            changes.back.append(await change(map_.clear(wall), end, refused=False))
            await planner.settle()
            on_progress(number + 1, trials)
        return {
            **changes.figures(),
            "rss_mb": round(planner.process.memory_info().rss / 1e6, 1),
            "front_rss_mb": round(sum(child.memory_full_info().uss for child in planner.process.children()) / 1e6, 1),
            "goal_fields_mb": round(await planner.field_bytes() / 1e6, 1),
            "bytes_per_robot": changes.bytes_per_robot(),
            "steady_bytes_per_robot_s": round(steady),
        }


@dataclass(frozen=True)
class _Changes:
    """What followed the hazards across all paths, those that cut all goals off, and the end of these."""

    replanned: list[Change]
    cut_off: list[Change]
    back: list[Change]

    def figures(self) -> dict[str, object]:
        replans = [ms for change in self.replanned for ms in change.times()]
        return {
            "replans": len(replans),
            "replan_p50_ms": percentile(replans, 50),
            "replan_p99_ms": percentile(replans, 99),
            "cut_off_ms": percentile([max(change.times()) for change in self.cut_off], 50),
            "cut_off_explained_ms": percentile([change.until_last() for change in self.cut_off], 50),
            "back_ms": percentile([max(change.times()) for change in self.back], 50),
        }

    def bytes_per_robot(self) -> int:
        return round(sum(change.bytes_per_robot() for change in self.replanned) / len(self.replanned))


class _Planner:
    """The running planner, and the world around it."""

    def __init__(self, stack: Stack, world: StandIns, fleet: Mapping[str, Trip]) -> None:
        self.world = world
        self._fleet = fleet
        self._ask = partial(ask, stack, PLANNER)
        self.process = psutil.Process(stack.pids()[PLANNER])

    async def send_all(self) -> None:
        """Give every robot a mission, as an operator does, and wait for the paths; raises `FailedError`."""
        await self._know(len(self._fleet))
        goal_ids = {}
        for robot, (_, (x, y)) in self._fleet.items():
            response = await self._ask("PUT", f"/api/v1/robots/{robot}/goal", {"pose": {"x": x, "y": y}})
            if not isinstance(response.body, dict) or "goal_id" not in response.body:
                raise FailedError(f"the planner refused the goal of {robot} at ({x}, {y}): {response.reason}")
            goal_ids[robot] = response.body["goal_id"]
        paths = self.world.receivers.paths
        await self.world.until(
            lambda: all(
                (path := paths.get(robot)) is not None and path.goal_id == goal and path.refusal is None
                for robot, goal in goal_ids.items()
            ),
            "every robot has a path to its goal. Choose another --seed if a zone lies on a goal",
        )

    async def _know(self, robots: int) -> None:
        """Wait until the planner has heard of so many robots: it has goals for no others."""
        deadline = time.monotonic() + _READY_S
        while not isinstance(found := (await self._ask("GET", "/api/v1/robots")).body, list) or len(found) < robots:
            if time.monotonic() > deadline:
                raise FailedError(f"the planner does not know its {robots} robots within {_READY_S:.0f} s: {found}")
            await asyncio.sleep(QUIET_S / 10)

    async def field_bytes(self) -> float:
        """Return the memory of all distance fields."""
        found = _FIELD_BYTES.search(str((await self._ask("GET", "/metrics")).body))
        if found is None:
            raise FailedError("the planner's /metrics lack fognav_planner_goal_fields_bytes")
        return float(found[1])

    async def settle(self) -> None:
        """Wait until paths and distance fields change no more; raises `FailedError`."""
        deadline, before = time.monotonic() + _READY_S, 0.0
        while not (before > 0 and await self.field_bytes() == before):
            if time.monotonic() > deadline:
                raise FailedError(f"the planner's distance fields still change after {_READY_S:.0f} s")
            before = await self.field_bytes()
            await self.world.quiet(time.perf_counter())


@asynccontextmanager
async def _planner(map_: FleetMap, fleet: Mapping[str, Trip], quiet_s: float) -> AsyncIterator[_Planner]:
    """Run a planner with its servers, all on the loopback address, and the stand-ins; end them with the context."""
    with TemporaryDirectory(prefix="fognav-") as folder:
        write_site(Path(folder), map_.floor)
        users = StackUsers(site=SITE, unrestricted=(_BENCH,))
        async with Stack(StackConfig(site_dir=Path(folder), robot="none", users=users)) as stack:
            for name in (REDIS, ROUTER):
                stack.supervisor.start(name)
            await stack.supervisor.wait_ready([REDIS, ROUTER], _READY_S)
            async with _stand_ins(stack, map_, fleet, quiet_s) as world:
                stack.supervisor.start(PLANNER)
                try:
                    await stack.supervisor.wait_ready([PLANNER], _READY_S)
                    yield _Planner(stack, world, fleet)
                except (FailedError, NotReadyError) as error:
                    raise FailedError(f"{error}\n{log_tail(stack.log(PLANNER))}") from error


@asynccontextmanager
async def _stand_ins(
    stack: Stack, map_: FleetMap, fleet: Mapping[str, Trip], quiet_s: float
) -> AsyncIterator[StandIns]:
    """Run map-service and robots on two sessions of the router: what the planner sees, and what reaches the robots."""
    endpoint, own = stack.zenoh_endpoint, stack.security.credentials(_BENCH)
    config = session_config("client", connect=[endpoint], credentials=own)
    with await asyncio.to_thread(zenoh.open, config) as session:
        receivers = Receivers(session, SITE, list(fleet))
        async with ZenohEdge.open(
            connect=[endpoint], clock=SystemClock(), role="map-service", id=SITE, site=SITE, credentials=own
        ) as edge:
            world = StandIns(edge, map_, fleet, receivers, quiet_s)
            try:
                async with in_background(world.publish_loop(), "stand-ins"):
                    yield world
            finally:
                receivers.close()


_STEP_S: Final = 0.01
_STEPS: Final = round(ch.ROBOT_POSE.period_s / _STEP_S)
"""Robots publish one after another, as unsynchronized ones do: a pose in each round of so many steps."""
_ROUNDS: Final = round(ch.ROBOT_STATE.period_s / ch.ROBOT_POSE.period_s)
"""A state follows each of so many poses."""
_TIMEOUT_S: Final = 60.0
_POLL_S: Final = 0.02
_FOR_ALL: Final = (ch.MAP_DELTA, ch.MAP_HEARTBEAT, ch.HAZARD, ch.ZONES)
"""What every robot receives alike."""
_FOR_ONE: Final = (ch.ROBOT_GOAL, ch.ROBOT_PATH, ch.ROBOT_RELEASE)


class Arrival(NamedTuple):
    """A message that arrived: when (s of `perf_counter`), for which robot ("": for each), and its payload."""

    at: float
    channel: Channel
    robot: str
    data: bytes


class Answer(NamedTuple):
    """A path or refusal that differs from its robot's last one, and when it arrived (s of `perf_counter`)."""

    at: float
    robot: str
    path: RobotPath


class Receivers:
    """The robots' subscribers: the map's are shared, those of goal, path and release are each robot's own."""

    def __init__(self, session: zenoh.Session, site: str, robots: Sequence[str]) -> None:
        self._new: list[Arrival] = []
        self.arrivals: list[Arrival] = []
        """All messages since the last `forget`."""
        self.answers: list[Answer] = []
        """All changes of paths and refusals since the last `forget`."""
        self.paths: dict[str, RobotPath] = {}
        """Each robot's last path or refusal."""
        own = [(channel, robot, channel.key(site=site, robot=robot)) for robot in robots for channel in _FOR_ONE]
        common = [(channel, "", channel.pattern(site=site)) for channel in _FOR_ALL]
        self._subscribers = [
            session.declare_subscriber(key, partial(self._on_sample, channel, robot))
            for channel, robot, key in [*common, *own]
        ]

    def _on_sample(self, channel: Channel, robot: str, sample: zenoh.Sample) -> None:
        """Note a message; runs on zenoh's threads."""
        self._new.append(Arrival(time.perf_counter(), channel, robot, sample.payload.to_bytes()))

    def collect(self) -> None:
        """Take over what has arrived."""
        count = len(self._new)
        arrived, self._new[:count] = self._new[:count], []
        self.arrivals += arrived
        for at, channel, robot, data in arrived:
            if channel is not ch.ROBOT_PATH:
                continue
            path, before = decode(channel, data, RobotPath), self.paths.get(robot)
            self.paths[robot] = path
            if before is None or (before.plan_id, before.refusal) != (path.plan_id, path.refusal):
                self.answers.append(Answer(at, robot, path))

    def close(self) -> None:
        """End the subscriptions."""
        for subscriber in self._subscribers:
            subscriber.undeclare()  # type: ignore[no-untyped-call]  # zenoh's stubs give it no types

    def forget(self) -> None:
        """Forget arrivals and answers; the last paths stay."""
        self.collect()
        self.arrivals, self.answers = [], []


@dataclass
class Change:
    """What followed a change of the map: when it was published (s of `perf_counter`), the first answers, and all."""

    begun: float
    first: dict[str, Answer]
    answers: list[Answer]
    arrivals: list[Arrival]

    def times(self) -> list[float]:
        """Return the time (ms) until each robot's first answer."""
        return [1000.0 * (answer.at - self.begun) for answer in self.first.values()]

    def until_last(self) -> float:
        """Return the time (ms) until the last answer of all, a refusal that was worded anew among them."""
        return 1000.0 * (max((answer.at for answer in self.answers), default=self.begun) - self.begun)

    def bytes_per_robot(self) -> float:
        """Return the bytes of hazard, delta, path and release that one of the robots with an answer received."""
        common = sum(len(item.data) for item in self.arrivals if item.channel in (ch.HAZARD, ch.MAP_DELTA))
        own = sum(
            len(item.data)
            for item in self.arrivals
            if item.robot in self.first and item.channel in (ch.ROBOT_PATH, ch.ROBOT_RELEASE)
        )
        return common + own / max(1, len(self.first))


class StandIns:
    """A map-service with this map, and the robots of `fleet`, which stand where it says.

    Without a new path for `quiet_s`, the answers to a change are complete.
    """

    def __init__(
        self, edge: ZenohEdge, map_: FleetMap, fleet: Mapping[str, Trip], receivers: Receivers, quiet_s: float
    ) -> None:
        self._edge, self._map, self._fleet = edge, map_, fleet
        self._clock = SystemClock()
        self._quiet_s = quiet_s
        self.receivers = receivers
        edge.serve(ch.MAP_SNAPSHOT, lambda _ids, _request: map_.master.snapshot())
        edge.publish(ch.ZONES, map_.zone_set())

    async def publish_loop(self) -> None:
        """Publish the map's heartbeat, and the robots' poses and states, until cancelled."""
        robots, step = list(self._fleet), 0
        async for now in ticker(self._clock, _STEP_S):
            self.receivers.collect()
            if step % _STEPS == 0:
                self._edge.publish(ch.MAP_HEARTBEAT, self._map.master.heartbeat(now, self._clock.id))
            for number in range(step % _STEPS, len(robots), _STEPS):
                self._publish_pose(robots[number])
                if (step + number) // _STEPS % _ROUNDS == 0:
                    self._publish_state(robots[number])
            step += 1

    def _publish_pose(self, robot: str) -> None:
        x, y = self._fleet[robot].place
        self._edge.publish(ch.ROBOT_POSE, standing(x, y, self._clock.stamp()), robot=robot)

    def _publish_state(self, robot: str) -> None:
        path = self.receivers.paths.get(robot)
        if path is not None:
            self._edge.publish(ch.ROBOT_STATE, following(path, self._clock.stamp()), robot=robot)

    async def change(self, deltas: Sequence[MapDelta], hazard: HazardArea, *, refused: bool) -> Change:
        """Publish a change of the map; return what followed until every robot has a path, or is `refused` one.

        Robots whose paths it does not affect give no answer. Raises `FailedError`.
        """
        receivers, seq = self.receivers, deltas[0].seq
        receivers.forget()
        begun = time.perf_counter()
        self._edge.publish(ch.HAZARD, hazard, area=hazard.hazard.area)
        for delta in deltas:
            self._edge.publish(ch.MAP_DELTA, delta)
        await self.until(
            lambda: all((path.refusal is not None) == refused for path in receivers.paths.values()),
            "every robot has its refusal" if refused else "every robot has a path",
        )
        await self.quiet(begun)
        answers = [answer for answer in receivers.answers if answer.path.map_seq >= seq]
        first: dict[str, Answer] = {}
        for answer in answers:
            if (answer.path.refusal is not None) == refused:
                first.setdefault(answer.robot, answer)
        within = [item for item in receivers.arrivals if begun <= item.at < begun + self._quiet_s]
        return Change(begun, first, answers, within)

    async def steady_bytes(self) -> float:
        """Return the bytes that one robot receives in a second while nothing changes."""
        seconds = 2.0 * self._quiet_s
        self.receivers.forget()
        begun = time.perf_counter()
        await asyncio.sleep(seconds)
        self.receivers.collect()
        within = [item for item in self.receivers.arrivals if begun <= item.at < begun + seconds]
        common = sum(len(item.data) for item in within if not item.robot)
        own = sum(len(item.data) for item in within if item.robot)
        return (common + own / len(self._fleet)) / seconds

    async def quiet(self, begun: float) -> None:
        """Wait until no path or refusal has changed for a while since `begun` (s of `perf_counter`)."""

        def silent() -> bool:
            last = max((answer.at for answer in self.receivers.answers), default=begun)
            return time.perf_counter() - max(begun, last) >= self._quiet_s

        await self.until(silent, "no robot's path changes any more")

    async def until(self, condition: Callable[[], bool], what: str) -> None:
        """Wait for a condition; raises `FailedError`, with `what` was waited for, after a minute."""
        deadline = time.monotonic() + _TIMEOUT_S
        self.receivers.collect()
        while not condition():
            if time.monotonic() > deadline:
                raise FailedError(f"the planner gave no such answers within {_TIMEOUT_S:.0f} s: {what}")
            await asyncio.sleep(_POLL_S)
            self.receivers.collect()
