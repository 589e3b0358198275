"""The planner's service: messages keep their time of arrival, urgent ones start a cycle at once."""

from __future__ import annotations

import asyncio
import threading
import time
from itertools import accumulate
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import httpx
import pytest
from manual_clock import ManualClock
from prometheus_client import REGISTRY
from ring_map import LEFT, RIGHT, RingMap, goal, pose

import planner.plan_records
import planner.service
from fog_contracts import channels as ch
from fog_contracts.handlers import Moment, Publication, RefusedMessageError
from fog_contracts.messages import EgressRequest, PlanRequest, Pose, RobotGoal, RobotPath
from fog_runtime.health import Health
from fog_runtime.http import Tokens
from fog_runtime.transports.zenoh_declarations import ASKER
from planner.api import make_api
from planner.core import PlannerCore
from planner.plan_records import PathRecord
from planner.query_queue import BusyError
from planner.service import Service

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Mapping, Sequence

    from fog_contracts.handlers import Handler, Ids
    from planner.service import CycleResult


class Session:
    """Records subscriptions, served queries and refused messages."""

    def __init__(self) -> None:
        self.subscribed: dict[ch.Channel, Callable[[dict[str, str], Any], None]] = {}
        self.served: set[ch.Channel] = set()
        self.refused: list[tuple[ch.Channel, str, str]] = []

    def subscribe(self, channel: ch.Channel, _kind: type, handler: Callable[..., None], **_ids: str) -> None:
        self.subscribed[channel] = handler

    def serve(self, channel: ch.Channel, _handler: object, **_ids: str) -> None:
        self.served.add(channel)

    connected = True

    def publish(self, channel: ch.Channel, message: object, **ids: str) -> None:
        """Publish nothing."""

    def refuse(self, channel: ch.Channel, key: str, reason: str) -> None:
        self.refused.append((channel, key, reason))


class RecordingCore(PlannerCore):
    """Records the moment of each handled message."""

    def __init__(self) -> None:
        super().__init__(epoch=1)
        self.handled: list[tuple[ch.Channel, Moment]] = []

    def handlers(self) -> Mapping[ch.Channel, Handler]:
        def recording(channel: ch.Channel, handler: Handler) -> Handler:
            def handle(ids: Ids, message: Any, at: Moment) -> list[Publication]:
                self.handled.append((channel, at))
                return list(handler(ids, message, at))

            return handle

        return {channel: recording(channel, handler) for channel, handler in super().handlers().items()}


class Rig:
    def __init__(self, core: PlannerCore) -> None:
        self.core, self.clock, self.session = core, ManualClock(10.0), Session()
        self.service = Service(self.core, cast("Any", None), cast("Any", self.session), self.clock, Health())
        self.service.subscribe()
        self.published: list[Publication] = []

    def cycle(self) -> CycleResult:
        """Run one cycle; return what it leaves to do."""
        return self.service._cycle.run(self.service._edges.now, self.published.extend)


@pytest.fixture
def rig() -> Rig:
    return Rig(RecordingCore())


def test_service_subscribes_to_every_channel_and_serves_every_query_of_the_core(rig: Rig) -> None:
    assert rig.session.subscribed.keys() == rig.core.handlers().keys()
    assert rig.session.served == rig.core.query_handlers().keys()


@pytest.mark.usefixtures("rig")
def test_counters_have_a_value_before_their_first_event() -> None:
    for name, labels in (
        ("fognav_plans_total", {"reason": "clearing"}),
        ("fognav_plan_refusals_total", {"code": "205"}),
        ("fognav_plans_avoided_total", {"reason": "unreachable"}),
        ("fognav_stage_seconds_count", {"stage": "plan"}),
    ):
        assert REGISTRY.get_sample_value(name, labels) is not None, name


def test_messages_keep_their_time_of_arrival_until_the_core_handles_them(rig: Rig) -> None:
    rig.session.subscribed[ch.MAP_HEARTBEAT]({}, RingMap().master.heartbeat(0.0))
    rig.clock.advance(1.0)
    rig.session.subscribed[ch.ROBOT_POSE]({"robot": "r1"}, pose(1.0, 7.0))
    assert rig.core.handled == []
    rig.clock.advance(8.0)
    rig.cycle()
    assert [(channel.name, at.now) for channel, at in rig.core.handled] == [
        (ch.MAP_HEARTBEAT.name, 10.0),
        (ch.ROBOT_POSE.name, 11.0),
    ]
    rig.cycle()
    assert len(rig.core.handled) == 2


def test_only_urgent_messages_start_a_cycle_at_once(rig: Rig) -> None:
    ring_map = RingMap()
    rig.session.subscribed[ch.MAP_HEARTBEAT]({}, ring_map.master.heartbeat(0.0))
    assert not rig.service._wake.is_set()
    for delta in ring_map.put("z1", (9.0, 10.0, 11.0, 12.0)):
        rig.session.subscribed[ch.MAP_DELTA]({}, delta)
    assert rig.service._wake.is_set()


class ReplyingCore(PlannerCore):
    """Replies to poses of the robot r1 with a goal, and refuses those of other robots."""

    def handlers(self) -> Mapping[ch.Channel, Handler]:
        def answer(ids: Ids, _pose: Any, _at: Moment) -> list[Publication]:
            if ids["robot"] != "r1":
                raise RefusedMessageError("unknown robot")
            return [Publication(ch.ROBOT_GOAL, RobotGoal(goal_id="g", pose=None), ids)]

        return {ch.ROBOT_POSE: answer}


def test_message_refused_by_a_handler_is_reported_and_the_cycle_continues() -> None:
    rig = Rig(ReplyingCore(epoch=1))
    for robot in ("r2", "r1"):
        rig.session.subscribed[ch.ROBOT_POSE]({"robot": robot}, pose(1.0, 7.0))
    rig.cycle()
    assert [p.ids for p in rig.published] == [{"robot": "r1"}]
    assert rig.session.refused == [(ch.ROBOT_POSE, "fog/*/robots/r2/pose", "unknown robot")]


class BrokenCore(PlannerCore):
    """Fails on every pose."""

    def handlers(self) -> Mapping[ch.Channel, Handler]:
        def fail(_ids: Ids, _pose: Any, _at: Moment) -> list[Publication]:
            raise ZeroDivisionError("a bug")

        return {ch.ROBOT_POSE: fail}


def test_handler_that_fails_is_logged_and_the_cycle_continues(caplog: pytest.LogCaptureFixture) -> None:
    rig = Rig(BrokenCore(epoch=1))
    rig.session.subscribed[ch.ROBOT_POSE]({"robot": "r1"}, pose(1.0, 7.0))
    rig.cycle()
    assert rig.published == []
    assert "handler_failed" in caplog.messages


class SlowCore(PlannerCore):
    """Whose searches take 30 ms by the rig's clock; records the robots in the order of their searches."""

    def __init__(self, clock: list[ManualClock]) -> None:
        super().__init__(epoch=1)
        self.searched: list[str] = []
        self._clock = clock

    def plan(self, at: Moment) -> Iterator[str]:
        for robot in super().plan(at):
            self._clock[0].advance(0.03)
            self.searched.append(robot)
            yield robot


@pytest.mark.parametrize(("urgent", "searches"), [(False, [4, 1]), (True, [2, 2, 1])])
def test_paths_are_published_one_by_one_and_a_long_cycle_leaves_the_rest_for_the_next_sooner_if_a_delta_waits(
    *, urgent: bool, searches: list[int]
) -> None:
    clock: list[ManualClock] = []
    core = SlowCore(clock)
    rig = Rig(core)
    clock.append(rig.clock)
    ring_map = RingMap()
    core.load(ring_map.master.snapshot(), 10.0)
    core.handlers()[ch.MAP_HEARTBEAT]({}, ring_map.master.heartbeat(0.0), Moment(10.0, 10.0))
    robots = [f"r{number}" for number in range(5)]
    for number, robot in enumerate(robots):
        core.handlers()[ch.ROBOT_POSE]({"robot": robot}, pose(LEFT[0], LEFT[1] + 0.7 * number), Moment(10.0, 10.0))
        core.set_goal(robot, goal(*RIGHT, robot))
    with_path: list[list[str]] = []
    searched: list[int] = []

    def emit(publications: Sequence[Publication]) -> None:
        with_path.append([p.ids["robot"] for p in publications if isinstance(p.message, RobotPath)])
        searched.append(len(core.searched))
        if urgent:
            rig.service._cycle.queue_message(ch.MAP_DELTA, lambda *_: (), {}, None, rig.service._edges.now())

    for count, done in zip(searches, accumulate(searches), strict=True):
        result = rig.service._cycle.run(rig.service._edges.now, emit)
        assert result.unfinished == (done < len(robots))
        assert core.searched == robots[:done]
        # Each path was published before the next search began.
        published = [(found, number) for found, number in zip(with_path, searched, strict=True) if found]
        assert published == [([robot], number + 1) for number, robot in enumerate(robots[:done])][-count:]
        with_path.clear()
        searched.clear()


def test_what_was_published_is_recorded_a_part_at_a_time_and_oldest_first() -> None:
    record = PathRecord()
    path = RobotPath(
        plan_id=1, planner_epoch=1, goal_id="g", points=[(0.0, 0.0), (1.0, 0.0)], map_epoch=1, map_seq=1,
        released_length=1.0, goal_theta=None, refusal=None, traces=[],
    )  # fmt: skip
    record.add([Publication(ch.ROBOT_PATH, path, {"robot": f"r{number}"}) for number in range(5)], 1.0)
    parts = []
    while record.take_over(2):
        parts.append(sorted(record.paths))
        assert len(parts) <= 3, f"there is no end of six paths, two at a time: {parts}"
        if len(parts) == 1:  # what comes meanwhile is recorded after it
            record.add([Publication(ch.ROBOT_PATH, path, {"robot": "r5"})], 2.0)
    assert parts == [["r0", "r1"], ["r0", "r1", "r2", "r3"]]
    assert sorted(record.paths) == ["r0", "r1", "r2", "r3", "r4", "r5"]


class WaitingCore(PlannerCore):
    """Whose second search waits until the first one's path was published; notes whether it was."""

    def __init__(self, published: threading.Event) -> None:
        super().__init__(epoch=1)
        self.searching, self.may_end = threading.Event(), threading.Event()
        self.waited_for_path: list[bool] = []
        self._published = published

    def plan(self, at: Moment) -> Iterator[str]:
        for number, robot in enumerate(super().plan(at)):
            if number:
                self.waited_for_path.append(self._published.wait(60.0))
            else:
                self.searching.set()
                self.may_end.wait(60.0)
            yield robot


async def test_path_is_published_while_the_event_loop_is_busy_and_others_are_searched(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    published = threading.Event()
    core = WaitingCore(published)
    rig = Rig(core)
    ring_map = RingMap()
    core.load(ring_map.master.snapshot(), 10.0)
    core.handlers()[ch.MAP_HEARTBEAT]({}, ring_map.master.heartbeat(0.0), Moment(10.0, 10.0))
    for robot in ("r0", "r1"):
        core.handlers()[ch.ROBOT_POSE]({"robot": robot}, pose(*LEFT), Moment(10.0, 10.0))
        core.set_goal(robot, goal(*RIGHT, robot))
    monkeypatch.setattr(
        rig.session, "publish", lambda channel, *_, **__: published.set() if channel is ch.ROBOT_PATH else None
    )
    planning = asyncio.create_task(rig.service.plan_loop())
    rig.service._wake.set()
    assert await asyncio.to_thread(core.searching.wait, 60.0), "no search has begun in a minute"
    core.may_end.set()
    assert published.wait(60.0)  # keeps the event loop busy meanwhile
    deadline = time.monotonic() + 60.0
    while len(core.waited_for_path) < 1:
        assert time.monotonic() < deadline, "no second search has begun in a minute"
        await asyncio.sleep(0.001)
    planning.cancel()
    rig.service.close()
    assert core.waited_for_path == [True]


class FullQueue:
    """Refuses every query, and keeps who asked."""

    def __init__(self) -> None:
        self.askers: list[str] = []

    async def run(self, _kind: str, asker: str, _work: object) -> object:
        self.askers.append(asker)
        raise BusyError("4 of your queries are waiting already")


async def test_each_session_that_asks_over_zenoh_is_an_asker_of_its_own(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rig.service, "_queue", queue := FullQueue())
    at = Pose(x=1.0, y=7.0, theta=0.0)
    for session in ("a1", "b2"):
        asking = ASKER.set(session)
        await rig.service._serve_plan({}, PlanRequest(start=at, goal=at))
        for robot in ("r1", "r2"):  # whichever it names
            await rig.service._serve_egress({}, EgressRequest(robot=robot, pose=at))
        ASKER.reset(asking)
    assert [len(set(queue.askers[:3])), len(set(queue.askers[3:])), len(set(queue.askers))] == [1, 1, 2]


async def test_queries_that_do_not_fit_are_answered_with_503_and_over_zenoh_with_when_to_ask_again(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(planner.service, "BUSY_PAUSE_S", 0.0)
    monkeypatch.setattr(rig.service, "_queue", FullQueue())
    at = Pose(x=1.0, y=7.0, theta=0.0)
    for reply in (
        await rig.service._serve_plan({}, PlanRequest(start=at, goal=at)),
        await rig.service._serve_egress({}, EgressRequest(robot="r1", pose=at)),
    ):
        assert reply.retry_after
        assert reply.refusal
        assert "waiting" in reply.refusal.reason
    app = make_api(rig.service, cast("Any", SimpleNamespace(robots=[], places={})), Health(), Tokens())
    async with httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://planner") as client:
        place = {"x": 1.0, "y": 7.0, "theta": 0.0}
        answer = await client.post("/api/v1/plan", json={"start": place, "goal": place})
    assert (answer.status_code, answer.headers["content-type"]) == (503, "application/problem+json")
    assert answer.headers["retry-after"] == "1"
    assert "waiting" in answer.json()["detail"]


def test_moments_say_whether_the_time_of_day_is_known() -> None:
    service = Service(
        PlannerCore(epoch=1), cast("Any", None), cast("Any", Session()), ManualClock(), Health(),
        synchronized=lambda: False,
    )  # fmt: skip
    assert not service._edges.now().synchronized
    service.close()
