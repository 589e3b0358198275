"""Stand-ins for a map-service and a fleet's robots, beside a real planner: what they publish, and what reaches robots.

They do what the planner can see of the real ones, at the real rates: the map with its zones, deltas and heartbeats;
poses and states of robots that stand still and name the path that they have. A robot's subscribers note when each
message arrives, on zenoh's own threads.
"""

from __future__ import annotations

import asyncio
import time
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple

from fog_contracts import channels as ch
from fog_contracts.codec import decode
from fog_contracts.messages import RobotPath, RobotPose, RobotState
from fog_runtime.clock import SystemClock, ticker
from fognav.output import FailedError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    import zenoh

    from fog_contracts.channels import Channel
    from fog_contracts.messages import HazardArea, MapDelta
    from fog_runtime.transports.zenoh_edge import ZenohEdge
    from fognav_experiments.bench.fleet import FleetMap, Trip

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
        pose = RobotPose(
            x=x, y=y, theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.17, height=0.1,
            stamp=self._clock.stamp(),
        )  # fmt: skip
        self._edge.publish(ch.ROBOT_POSE, pose, robot=robot)

    def _publish_state(self, robot: str) -> None:
        path = self.receivers.paths.get(robot)
        if path is None:
            return
        state = RobotState(
            mode="NORMAL", reasons=[], enabled=True, battery=None, goal_id=path.goal_id, map_epoch=path.map_epoch,
            map_seq=path.map_seq, plan_id=path.plan_id, planner_epoch=path.planner_epoch, stamp=self._clock.stamp(),
        )  # fmt: skip
        self._edge.publish(ch.ROBOT_STATE, state, robot=robot)

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
