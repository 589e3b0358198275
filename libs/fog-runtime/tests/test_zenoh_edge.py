"""The zenoh edge against real router processes."""

import asyncio
import contextlib
import itertools
import json
import os
import signal
import threading
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
import zenoh
from prometheus_client import REGISTRY

from fog_contracts import channels as ch
from fog_contracts import messages as m
from fog_contracts.codec import ContractError, encode
from fog_contracts.follower import MapFollower
from fog_contracts.grid import GridGeometry, Window
from fog_contracts.handlers import RefusedMessageError
from fog_contracts.replica import MasterMap
from fog_runtime.clock import SystemClock
from fog_runtime.transports.edges import Edges
from fog_runtime.transports.zenoh_declarations import ASKER
from fog_runtime.transports.zenoh_edge import ZenohEdge, session_config
from fog_runtime.transports.zenoh_query import PART_BYTES, decode_announcement
from fog_supervisor.net import free_port
from fog_supervisor.servers import start_router

pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def shared_router(tmp_path_factory):
    with start_router(tmp_path_factory.mktemp("router")) as router:
        yield router


@pytest.fixture
def router(shared_router):
    """Return a running router, restarted if the previous test killed it."""
    shared_router.start()
    return shared_router


def edge(endpoint, name="e1", site="lab"):
    return ZenohEdge.open(connect=[endpoint], clock=SystemClock(), role="test", id=name, site=site)


def is_stopped(pid):
    """Return whether all threads of a process have stopped: on a busy machine they do so later than the signal."""
    threads = Path(f"/proc/{pid}/task").iterdir()
    return all((thread / "stat").read_text("utf-8").rpartition(")")[2].split()[0] == "T" for thread in threads)


async def until(condition, failure, seconds=60.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, failure
        await asyncio.sleep(0.01)


def pose(x):
    return m.RobotPose(x=x, y=0.0, theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.2, height=0.3, stamp=1.0)


def delta(seq, size=10):
    return m.MapDelta(
        epoch=1, seq=seq, part=0, parts=1, layer="cost", x=0, y=0, w=size, h=1, packing="raw", cells=bytes(size), hash=0
    )


def master():
    geometry = GridGeometry(8, 8, 0.05, 0.0, 0.0)
    cells = np.zeros(geometry.shape, dtype=np.uint8)
    return MasterMap("lab", geometry, cells, cells, 1)


def zones(seq):
    return m.ZoneSet(epoch=1, seq=seq, zones=[], active=[])


def counter(name, channel):
    return REGISTRY.get_sample_value(name, {"channel": channel.name}) or 0.0


def bytes_of(channel, direction):
    return REGISTRY.get_sample_value("fognav_bytes_total", {"channel": channel.name, "direction": direction}) or 0.0


async def publish_until(publisher, channel, make, condition, failure, **ids):
    """Publish repeatedly: a subscription takes a moment to reach the publisher."""
    deadline = time.monotonic() + 60.0
    n = 0
    while not condition():
        assert time.monotonic() < deadline, failure
        publisher.publish(channel, make(n), **ids)
        n += 1
        await asyncio.sleep(0.02)


async def until_present(observer, expected):
    async with asyncio.timeout(60):
        while await observer.present() != expected:  # noqa: ASYNC110  # the router knows, and tells nobody unasked
            await asyncio.sleep(0.02)


async def test_messages_are_delivered_to_subscribers_of_their_key_with_ids(router):
    seen, one = [], []
    async with edge(router.endpoint, "a") as a, edge(router.endpoint, "b") as b:
        assert a.connected
        b.subscribe(ch.ROBOT_POSE, m.RobotPose, lambda ids, message: seen.append((ids, message.x)))
        b.subscribe(ch.ROBOT_POSE, m.RobotPose, lambda ids, _: one.append(ids), robot="r2")
        slot = b.latest(ch.ROBOT_POSE, m.RobotPose, robot="r1")
        await publish_until(a, ch.ROBOT_POSE, lambda n: pose(float(n)), slot.get, "no pose", robot="r1")
        await publish_until(a, ch.ROBOT_POSE, lambda _: pose(-1.0), lambda: one, "no pose", robot="r2")
    assert ({"robot": "r1"}, slot.get().x) in seen
    assert all(ids == {"robot": "r2"} for ids in one)
    assert not a.connected


async def test_subscribers_receive_only_their_own_sites_messages(router):
    other, own = [], []
    async with edge(router.endpoint) as a, edge(router.endpoint, site="other") as b:
        b.subscribe(ch.ZONES, m.ZoneSet, lambda _, message: other.append(message))
        a.subscribe(ch.ZONES, m.ZoneSet, lambda _, message: own.append(message))
        await publish_until(a, ch.ZONES, zones, lambda: own, "nothing came")
    assert other == []


async def test_busy_loop_gets_only_the_newest_pose_but_every_delta(router):
    poses, deltas = [], []
    async with edge(router.endpoint, "a") as a, edge(router.endpoint, "b") as b:
        b.subscribe(ch.ROBOT_POSE, m.RobotPose, lambda _, message: poses.append(message.x))
        b.subscribe(ch.MAP_DELTA, m.MapDelta, lambda _, message: deltas.append(message.seq))
        await publish_until(a, ch.ROBOT_POSE, lambda _: pose(-1.0), lambda: poses, "no pose", robot="r1")
        a.publish(ch.MAP_DELTA, delta(0))
        await until(lambda: deltas, "no delta")
        await asyncio.sleep(0.2)
        poses.clear()
        for n in range(1, 101):
            a.publish(ch.ROBOT_POSE, pose(float(n)), robot="r1")
            a.publish(ch.MAP_DELTA, delta(n))
        time.sleep(0.5)  # noqa: ASYNC251  # blocks the loop on purpose while messages arrive
        await until(lambda: deltas == list(range(101)), "deltas are missing or out of order")
        await until(lambda: poses and poses[-1] == 100.0, "the newest pose was not delivered")
    assert len(poses) < 20


async def test_polled_messages_wait_for_the_next_look_and_the_newest_are_kept(router):
    polled, pushed = [], []
    async with edge(router.endpoint, "a") as a, edge(router.endpoint, "b") as b:
        b.subscribe_polled(ch.ROBOT_POSE, m.RobotPose, lambda ids, message: polled.append((ids, message.x)))
        b.subscribe(ch.ROBOT_POSE, m.RobotPose, lambda _, message: pushed.append(message.x))
        await publish_until(a, ch.ROBOT_POSE, lambda _: pose(-1.0), lambda: pushed, "no pose", robot="r1")
        for n in range(1, 101):
            a.publish(ch.ROBOT_POSE, pose(float(n)), robot="r1")
        await until(lambda: pushed[-1] == 100.0, "the last pose did not come")
        assert polled == []

        def has_polled(x):
            # A pose comes to the two subscribers one after the other, in an order that nobody promises.
            b.poll()
            return polled[-1:] == [({"robot": "r1"}, x)]

        await until(lambda: has_polled(100.0), "the last pose did not wait")
        count = len(polled)
        assert 1 <= count <= 16 + 1
        b.poll()
        assert len(polled) == count
        a.publish(ch.ROBOT_POSE, pose(101.0), robot="r1")
        await until(lambda: has_polled(101.0), "the next pose did not come")
        assert [x for _, x in polled[count:]] == [101.0]
        count = len(polled)
    b.poll()
    assert len(polled) == count, "nothing arrives on a closed session"


async def test_messages_that_wait_to_be_polled_are_handled_before_those_that_were_sent_after_them(router):
    handled, fetches = [], []
    writer, follower = master(), MapFollower()
    follower.on_snapshot(writer.snapshot(), 0.0)

    def on_heartbeat(_ids, message, at):
        handled.append(("heartbeat", message.seq))
        follower.on_heartbeat(message, at.now)
        return []

    def on_delta(_ids, message, at):
        handled.append(("delta", message.seq))
        follower.on_delta(message, at.now)
        fetches.append(follower.wants_snapshot(at.now))
        return []

    async with edge(router.endpoint, "a") as a, edge(router.endpoint, "b") as b:
        Edges(SystemClock(), zenoh=b).subscribe(
            {ch.MAP_DELTA: on_delta, ch.MAP_HEARTBEAT: on_heartbeat}, lambda _: None, polled=[ch.MAP_HEARTBEAT]
        )

        def connected():
            b.poll()
            return handled

        await publish_until(a, ch.MAP_HEARTBEAT, lambda _: writer.heartbeat(0.0), connected, "no heartbeat")
        for cost in itertools.count(1):
            handled.clear()
            fetches.clear()
            writer.set_epoch(writer.version.epoch + 1)  # another map-service takes over
            a.publish(ch.MAP_HEARTBEAT, writer.heartbeat(1.0))
            (change,) = writer.write([("cost", Window(0, 0, 1, 1), np.full((1, 1), cost, dtype=np.uint8))], [], [])
            a.publish(ch.MAP_DELTA, change)
            await until(lambda change=change: ("delta", change.seq) in handled, "the change did not come")
            if handled[0][0] == "heartbeat":
                break
            # It was dropped, as one may be while its link is busy: then the follower needs the map.
            follower.on_snapshot(writer.snapshot(), 0.0)
    assert handled[-2:] == [("heartbeat", change.seq - 1), ("delta", change.seq)]
    assert fetches == [False]
    assert follower.version == writer.version


async def test_polled_messages_are_checked_and_come_to_a_session_that_opened_late(tmp_path):
    polled, port = [], free_port()
    endpoint, channel = f"tcp/127.0.0.1:{port}", ch.ROBOT_POSE
    before = counter("fognav_refused_messages_total", channel)
    async with edge(endpoint, "b") as b:
        b.subscribe_polled(channel, m.RobotPose, lambda _, message: polled.append(message.x))
        b.poll()
        with pytest.raises(ValueError, match="must not be lost"):
            b.subscribe_polled(ch.MAP_DELTA, m.MapDelta, lambda _ids, _message: None)

        def come():
            b.poll()
            return polled

        def refused():
            b.poll()
            return counter("fognav_refused_messages_total", channel) == before + 2

        with start_router(tmp_path, port):
            async with edge(endpoint, "a") as a:
                await publish_until(a, channel, lambda n: pose(float(n)), come, "no pose", robot="r1")
                with raw_session(endpoint) as raw:
                    raw.put("fog/lab/robots/r3/pose", b"\xc1 not msgpack")
                    raw.put("fog/lab/robots/r4/pose", b"x" * (channel.limit + 1))
                    await until(refused, "not all were refused")


async def test_late_subscriber_gets_the_latest_zones_and_recent_deltas(router):
    got, deltas = [], []
    async with edge(router.endpoint, "a") as a:
        for n in range(3):
            a.publish(ch.ZONES, zones(n))
            a.publish(ch.MAP_DELTA, delta(n))
        async with edge(router.endpoint, "b") as b:
            b.subscribe(ch.ZONES, m.ZoneSet, lambda _, message: got.append(message.seq))
            b.subscribe(ch.MAP_DELTA, m.MapDelta, lambda _, message: deltas.append(message.seq))
            await until(lambda: got and len(deltas) >= 3, "earlier messages were not delivered")
    assert got == [2]
    assert deltas == [0, 1, 2]


async def test_everything_resumes_after_a_restart_of_the_router_without_a_lost_delta(router):
    poses, deltas = [], []
    async with edge(router.endpoint, "a") as a, edge(router.endpoint, "b") as b:
        b.subscribe(ch.ROBOT_POSE, m.RobotPose, lambda _, message: poses.append(message.x))
        b.subscribe(ch.MAP_DELTA, m.MapDelta, lambda _, message: deltas.append(message.seq))
        a.serve(ch.PLANNER_PLAN, lambda _, request: m.PlanReply(length=request.goal.x))
        await publish_until(a, ch.ROBOT_POSE, lambda _: pose(1.0), lambda: poses, "no pose", robot="r1")
        a.publish(ch.MAP_DELTA, delta(0))
        await until(lambda: deltas, "no delta")
        router.kill()
        await until(lambda: not a.connected and not b.connected, "the loss was not noticed")
        for n in range(1, 21):
            a.publish(ch.MAP_DELTA, delta(n))
        assert await b.query(ch.PLANNER_PLAN, plan(2.0), m.PlanReply, 0.5) is None
        router.start()
        await until(lambda: a.connected and b.connected, "no reconnection")
        poses.clear()
        await publish_until(a, ch.ROBOT_POSE, lambda _: pose(2.0), lambda: poses, "no pose again", robot="r1")
        await until(lambda: deltas == list(range(21)), f"deltas are missing: {deltas}")
        await query_until_answered(b, 3.0)


def plan(x):
    at = m.Pose(x=x, y=0.0, theta=0.0)
    return m.PlanRequest(start=at, goal=at)


async def query_until_answered(querier, x, seconds=60.0):
    """Query until a reply arrives."""
    deadline = time.monotonic() + seconds
    while True:
        reply = await querier.query(ch.PLANNER_PLAN, plan(x), m.PlanReply, 1.0)
        if reply is not None:
            assert reply.length == x
            return
        assert time.monotonic() < deadline, "no answer"
        await asyncio.sleep(0.02)


async def test_edge_opened_before_any_router_works_once_there_is_one(tmp_path):
    port = free_port()
    endpoint = f"tcp/127.0.0.1:{port}"
    got, deltas = [], []
    async with edge(endpoint, "a") as a, edge(endpoint, "b") as b:
        assert not a.connected
        b.subscribe(ch.ZONES, m.ZoneSet, lambda _, message: got.append(message.seq))
        b.subscribe(ch.MAP_DELTA, m.MapDelta, lambda _, message: deltas.append(message.seq))
        a.declare_liveliness("planner", "p1")
        a.serve(ch.PLANNER_PLAN, lambda _, request: m.PlanReply(length=request.goal.x))
        for n in range(3):
            a.publish(ch.ZONES, zones(n))
            a.publish(ch.MAP_DELTA, delta(n))
        before = counter("fognav_dropped_messages_total", ch.ROBOT_POSE)
        a.publish(ch.ROBOT_POSE, pose(1.0), robot="r1")
        assert counter("fognav_dropped_messages_total", ch.ROBOT_POSE) == before + 1
        assert await b.query(ch.PLANNER_PLAN, plan(1.0), m.PlanReply, 0.5) is None
        assert await b.present() == set()
        with start_router(tmp_path, port):
            await until(lambda: a.connected and b.connected, "no connection")
            await query_until_answered(b, 4.0)
            await until(lambda: got == [2] and deltas == [0, 1, 2], f"missing: {got} {deltas}")
            await until_present(b, {("planner", "p1")})


async def test_threads_that_publish_while_sessions_open_lose_no_delta_after_the_first_that_arrives(tmp_path):
    port = free_port()
    endpoint = f"tcp/127.0.0.1:{port}"
    deltas, errors = [], []
    connected = threading.Event()
    async with edge(endpoint, "a") as a, edge(endpoint, "b") as b:
        b.subscribe(ch.MAP_DELTA, m.MapDelta, lambda _, message: deltas.append(message.seq))

        def publish(seqs):
            try:
                for seq in seqs:
                    a.publish(ch.MAP_DELTA, delta(seq))
                    a.publish(ch.ROBOT_POSE, pose(1.0), robot=f"r{seq}")
                    connected.wait(0.02)  # all that are left, as soon as there are connections
            except Exception as error:  # noqa: BLE001  # shown by the test
                errors.append(error)

        threads = [threading.Thread(target=publish, args=(range(first, 100, 2),)) for first in (0, 1)]
        for thread in threads:
            thread.start()
        with start_router(tmp_path, port):
            await until(lambda: a.connected and b.connected, "no connection")
            connected.set()
            await asyncio.to_thread(lambda: [thread.join() for thread in threads])
            await until(lambda: {98, 99} <= set(deltas), f"the last ones are missing: {deltas}")
    assert errors == []
    # What a publisher sent before its subscriber heard of it may be passed over. What comes after the first, may not.
    for first in (0, 1):
        arrived = [seq for seq in deltas if seq % 2 == first]
        assert arrived == list(range(arrived[0], 100, 2))


async def test_message_that_zenoh_fails_to_send_is_counted_and_does_not_end_the_caller(router):
    async with edge(router.endpoint) as a:
        a.publish(ch.ROBOT_POSE, pose(1.0), robot="r1")
        await asyncio.to_thread(a._session.close)
        before = counter("fognav_dropped_messages_total", ch.ROBOT_POSE)
        for robot in ("r1", "r2", "r2"):
            a.publish(ch.ROBOT_POSE, pose(1.0), robot=robot)
        assert counter("fognav_dropped_messages_total", ch.ROBOT_POSE) == before + 3


async def test_queries_are_answered_by_plain_and_async_handlers_with_ids(router):
    async def command(ids, request):
        await asyncio.sleep(0)
        return m.CommandReply(accepted=True, reason=f"{ids['robot']} {request.kind}")

    snapshot = m.ZoneSet(epoch=1, seq=7, zones=[], active=[])
    async with edge(router.endpoint, "a") as a, edge(router.endpoint, "b") as b:
        a.serve(ch.ROBOT_COMMAND, command, robot="r1")
        a.serve(ch.ZONES, lambda *_: snapshot)
        a.serve(ch.PLANNER_PLAN, lambda _, request: m.PlanReply(length=request.goal.x))
        await query_until_answered(b, 5.0)
        order = m.RobotCommand(kind="enable", robot="r1", operator="o", nonce="n" * 16, issued_at=1.0)
        reply = await b.query(ch.ROBOT_COMMAND, order, m.CommandReply, 5.0, robot="r1")
        assert reply == m.CommandReply(accepted=True, reason="r1 enable")
        assert await b.query(ch.ZONES, None, m.ZoneSet, 5.0) == snapshot
        # r2 is not served: the query ends without a reply, long before its timeout.
        assert await b.query(ch.ROBOT_COMMAND, order, m.CommandReply, 5.0, robot="r2") is None


async def test_large_reply_arrives_complete(router):
    big = m.MapSnapshot(
        site="lab", epoch=1, seq=1, hash=1, cost=bytes(range(256)) * 40_000, speed=b"", static=b"",
        geometry=m.MapGeometry(width=1, height=1, resolution=0.05, origin_x=0.0, origin_y=0.0),
    )  # fmt: skip
    async with edge(router.endpoint, "a") as a, edge(router.endpoint, "b") as b:
        a.serve(ch.MAP_SNAPSHOT, lambda *_: big)
        a.serve(ch.PLANNER_PLAN, lambda _, request: m.PlanReply(length=request.goal.x))
        await query_until_answered(b, 1.0)
        assert await b.query(ch.MAP_SNAPSHOT, None, m.MapSnapshot, 20.0) == big


async def test_session_that_asks_too_much_leaves_the_others_their_answers(router):
    asked, answers = [], asyncio.Event()

    async def slow(_ids, _request):
        asked.append(ASKER.get())
        await answers.wait()
        return zones(1)

    async with edge(router.endpoint, "a") as a, edge(router.endpoint, "b") as b, edge(router.endpoint, "c") as c:
        a.serve(ch.ZONES, slow)
        async with asyncio.timeout(60), asyncio.TaskGroup() as tasks:
            greedy = [tasks.create_task(b.query(ch.ZONES, None, m.ZoneSet, 50.0)) for _ in range(40)]
            await until(lambda: sum(query.done() for query in greedy) == 24, "queries above the limit end at once")
            modest = tasks.create_task(c.query(ch.ZONES, None, m.ZoneSet, 50.0))
            await until(lambda: len(asked) == 17, "another session's query is answered")
            answers.set()
    assert Counter(query.result() is not None for query in greedy) == {True: 16, False: 24}
    assert modest.result() is not None
    assert sorted(Counter(asked).values()) == [1, 16]
    assert "" not in asked


async def test_query_reports_a_failing_and_a_silent_handler(router):
    silent = asyncio.Event()

    async def never(ids, request):
        await silent.wait()

    def fails(ids, request):
        raise RuntimeError("a bug")

    async with edge(router.endpoint, "a") as a, edge(router.endpoint, "b") as b:
        a.serve(ch.MAP_SNAPSHOT, never)
        a.serve(ch.PLANNER_EGRESS, fails)
        a.serve(ch.PLANNER_PLAN, lambda _, request: m.PlanReply(length=request.goal.x))
        await query_until_answered(b, 1.0)
        assert await b.query(ch.MAP_SNAPSHOT, None, m.MapSnapshot, 0.2) is None
        with pytest.raises(ContractError, match="failed"):
            await b.query(ch.PLANNER_EGRESS, m.EgressRequest(robot="r1", pose=plan(0.0).start), m.PlanReply, 5.0)
        await query_until_answered(b, 2.0)


@contextlib.contextmanager
def raw_session(endpoint):
    session = zenoh.open(session_config("client", connect=[endpoint]))
    try:
        yield session
    finally:
        session.close()


async def test_invalid_messages_are_refused_and_counted_and_later_ones_delivered(router):
    seen = []
    channel = ch.ROBOT_POSE
    before = counter("fognav_refused_messages_total", channel)
    async with edge(router.endpoint, "a") as a, edge(router.endpoint, "b") as b:
        b.subscribe(channel, m.RobotPose, lambda ids, _: seen.append(ids["robot"]))
        await publish_until(a, channel, lambda _: pose(1.0), lambda: seen, "no pose", robot="r1")
        with raw_session(router.endpoint) as raw:
            raw.put("fog/lab/robots/r3/pose", b"\xc1 not msgpack")
            raw.put("fog/lab/robots/r4/pose", b"x" * (channel.limit + 1))
            raw.put("fog/lab/robots/R 5/pose", b"\x80")
            raw.put("fog/lab/robots/r6/pose", b"\x80")
            await until(lambda: counter("fognav_refused_messages_total", channel) == before + 4, "not all were refused")
        seen.clear()
        await publish_until(a, channel, lambda _: pose(1.0), lambda: seen, "no message after invalid ones", robot="r7")
    assert set(seen) <= {"r1", "r7"}


async def test_invalid_and_oversized_requests_are_refused_with_the_reason(router):
    async with edge(router.endpoint, "a") as a, edge(router.endpoint, "b") as b:
        a.serve(ch.PLANNER_PLAN, lambda _, request: m.PlanReply(length=request.goal.x))
        await query_until_answered(b, 1.0)

        def ask(payload):
            with raw_session(router.endpoint) as raw:
                return [bytes(r.err.payload).decode() for r in raw.get("fog/lab/planner/plan", payload=payload)]

        assert "start" in (await asyncio.to_thread(ask, b"\x80"))[0]
        assert "over the limit" in (await asyncio.to_thread(ask, b"x" * 2000))[0]


async def test_message_refused_by_its_handler_is_counted_as_refused(router):
    def handler(ids, message):
        raise RefusedMessageError("it can't be used")

    before = counter("fognav_refused_messages_total", ch.ROBOT_POSE)
    failed = counter("fognav_handler_errors_total", ch.ROBOT_POSE)
    async with edge(router.endpoint, "a") as a, edge(router.endpoint, "b") as b:
        b.subscribe(ch.ROBOT_POSE, m.RobotPose, handler)
        await publish_until(
            a,
            ch.ROBOT_POSE,
            lambda _: pose(1.0),
            lambda: counter("fognav_refused_messages_total", ch.ROBOT_POSE) > before,
            "not counted",
            robot="r1",
        )
    assert counter("fognav_handler_errors_total", ch.ROBOT_POSE) == failed


async def test_messages_are_delivered_after_a_handler_raised(router):
    seen = []

    def handler(ids, message):
        seen.append(message.x)
        raise RuntimeError("a bug")

    before = counter("fognav_handler_errors_total", ch.ROBOT_POSE)
    async with edge(router.endpoint, "a") as a, edge(router.endpoint, "b") as b:
        b.subscribe(ch.ROBOT_POSE, m.RobotPose, handler)
        await publish_until(a, ch.ROBOT_POSE, lambda _: pose(1.0), lambda: len(seen) > 2, "no pose", robot="r1")
    assert counter("fognav_handler_errors_total", ch.ROBOT_POSE) >= before + 3


async def test_processes_are_present_for_as_long_as_their_sessions_are_open(router):
    async with edge(router.endpoint, "w") as observer:
        async with edge(router.endpoint, "early") as early:
            early.declare_liveliness("planner", "p1")
            await until_present(observer, {("planner", "p1")})
            async with edge(router.endpoint, "late") as late:
                late.declare_liveliness("robot-agent", "r1")
                await until_present(observer, {("planner", "p1"), ("robot-agent", "r1")})
            await until_present(observer, {("planner", "p1")})
        await until_present(observer, set())


async def test_question_for_the_present_processes_ends_though_the_link_lets_nothing_be_asked(router):
    freed = threading.Event()
    async with edge(router.endpoint) as observer:
        # As when queries block because a connection is congested: no thread is left to ask with.
        blocked = [asyncio.ensure_future(observer.in_thread(freed.wait)) for _ in range(4)]
        try:
            async with asyncio.timeout(60):
                assert await observer.present(0.05) == set()
        finally:
            freed.set()
        await asyncio.gather(*blocked)


async def test_wrong_channel_ids_or_message_type_raises(router):
    async with edge(router.endpoint) as a:
        with pytest.raises(ValueError, match="mqtt"):
            a.publish(ch.NODE_READING, pose(1.0), node="n1")
        with pytest.raises(ValueError, match="robot"):
            a.publish(ch.ROBOT_POSE, pose(1.0))
        with pytest.raises(ValueError, match="site"):
            a.publish(ch.ROBOT_POSE, pose(1.0), site="x", robot="r1")
        with pytest.raises(ContractError, match="RobotPose"):
            a.publish(ch.ROBOT_POSE, zones(1), robot="r1")


async def test_router_logs_its_endpoint_and_ends_on_sigterm(tmp_path):
    router = start_router(tmp_path)
    await until(lambda: "listening" in router.log.read_text(), "no event")
    router.stop()
    events = [json.loads(line) for line in router.log.read_text().splitlines()]
    assert [event["event"] for event in events] == ["listening", "stopping", "stopped"]
    assert events[0]["endpoints"] == [router.endpoint]


def snapshot_of(cells: bytes, seq: int = 1) -> m.MapSnapshot:
    geometry = m.MapGeometry(width=1, height=1, resolution=0.05, origin_x=0.0, origin_y=0.0)
    return m.MapSnapshot(site="lab", epoch=1, seq=seq, hash=1, cost=cells, speed=b"", static=b"", geometry=geometry)


async def test_large_reply_is_fetched_by_several_clients_while_newer_ones_replace_it(router):
    served = [snapshot_of(bytes([seq]) * 300_000, seq) for seq in range(12)]
    asked = itertools.count()
    async with edge(router.endpoint, "a") as a, edge(router.endpoint, "b") as b, edge(router.endpoint, "c") as c:
        a.serve(ch.MAP_SNAPSHOT, lambda *_: served[next(asked) % len(served)])
        a.serve(ch.PLANNER_PLAN, lambda _, request: m.PlanReply(length=request.goal.x))
        await query_until_answered(b, 1.0)
        await query_until_answered(c, 1.0)
        replies = await asyncio.gather(
            *(client.query(ch.MAP_SNAPSHOT, None, m.MapSnapshot, 30.0) for client in (b, c) for _ in range(5))
        )
        assert all(reply in served for reply in replies)


async def test_large_reply_without_flow_control_is_only_announced(router):
    """Whoever asks and never fetches gets a few bytes, however large the reply."""
    async with edge(router.endpoint, "a") as a, edge(router.endpoint, "b") as b:
        a.serve(ch.MAP_SNAPSHOT, lambda *_: snapshot_of(bytes(5_000_000)))
        a.serve(ch.PLANNER_PLAN, lambda _, request: m.PlanReply(length=request.goal.x))
        await query_until_answered(b, 1.0)
        with raw_session(router.endpoint) as session:
            key = ch.MAP_SNAPSHOT.key(site="lab")

            async def fetch(name: str, number: str) -> zenoh.Reply:
                selector = zenoh.Selector(key, {"reply": name, "part": number})
                (part,) = await asyncio.to_thread(lambda: list(session.get(selector)))
                return part

            (reply,) = await asyncio.to_thread(lambda: list(session.get(key)))
            assert len(reply.ok.payload) == 0
            announced = decode_announcement(reply.ok.attachment.to_bytes())
            assert announced.size > 5_000_000
            for number, expected in ((0, PART_BYTES), (announced.parts - 1, announced.size % PART_BYTES)):
                assert len((await fetch(announced.reply, str(number))).ok.payload) == expected
            for wrong in ("-1", "x", str(announced.parts), "9" * 30, "\u0663"):
                assert b"ask again" in bytes((await fetch(announced.reply, wrong)).err.payload)
            assert b"ask again" in bytes((await fetch(announced.reply[:-1] + "x", "0")).err.payload)
            selector = zenoh.Selector(key, {"reply": "of-another-process", "part": "0"})
            assert not await asyncio.to_thread(lambda: list(session.get(selector))), "which may answer it"


async def test_bytes_of_messages_requests_and_replies_are_counted_by_channel_and_direction(router):
    async with edge(router.endpoint, "a") as a, edge(router.endpoint, "b") as b:
        got = []
        b.subscribe(ch.ZONES, m.ZoneSet, lambda _, message: got.append(message))
        a.serve(ch.PLANNER_PLAN, lambda _, request: m.PlanReply(length=request.goal.x))
        await query_until_answered(b, 4.0)
        before = {(c, d): bytes_of(c, d) for c in (ch.ZONES, ch.PLANNER_PLAN) for d in ("sent", "received")}
        a.publish(ch.ZONES, zones(1))
        await until(lambda: got, "no message")
        request, reply = plan(3.0), m.PlanReply(length=3.0)
        assert await b.query(ch.PLANNER_PLAN, request, m.PlanReply, 5.0) == reply
        both = len(encode(ch.PLANNER_PLAN, request)) + len(encode(ch.PLANNER_PLAN, reply, reply=True))
        counted = {key: bytes_of(*key) - count for key, count in before.items()}
        message = len(encode(ch.ZONES, zones(1)))
        assert counted == {
            (ch.ZONES, "sent"): message,
            (ch.ZONES, "received"): message,
            (ch.PLANNER_PLAN, "sent"): both,
            (ch.PLANNER_PLAN, "received"): both,
        }


@pytest.mark.parametrize("declared", [False, True], ids=["absent", "present"])
async def test_router_that_hangs_answers_no_more_in_a_session_that_is_up_and_again_when_it_goes_on(router, declared):
    async with edge(router.endpoint, "p1") as asking:
        if declared:
            asking.declare_liveliness("test", "p1")
        assert await asking.router_answers(60.0)
        os.kill(router.pid, signal.SIGSTOP)
        try:
            await until(lambda: is_stopped(router.pid), "the router's threads run on")
            assert not await asking.router_answers(0.2)
            assert asking.connected
        finally:
            os.kill(router.pid, signal.SIGCONT)
        assert await asking.router_answers(60.0)
        router.kill()
        await until(lambda: not asking.connected, "the session notices the end of its router")
        assert not await asking.router_answers(0.2)
