from __future__ import annotations

import asyncio
import threading
import time

import msgspec
import numpy as np
import pytest
from guardian_rig import DEADLINE_S
from little_world import AGENT, LittleWorld

from fog_contracts import channels as ch
from fog_contracts.follower import GRACE_S
from fog_contracts.grid import Window
from fog_contracts.messages import MapSnapshot, RobotCommand
from fog_runtime.clock import SystemClock
from fog_runtime.health import Health
from robot_agent.agent import service as service_module
from robot_agent.agent.core import AgentCore
from robot_agent.agent.edges.map_loader import MapLoader, Store
from robot_agent.agent.service import Service
from robot_agent.localization.pose import SavedPose


class Fog:
    """A map-service that answers when the test lets it."""

    def __init__(self):
        self.answers = asyncio.Queue()
        self.requests = 0
        self.handlers = {}
        self.polled = set()
        self.served = {}

    def subscribe(self, channel, _kind, handler, **_ids):
        self.handlers[channel] = handler

    def subscribe_polled(self, channel, _kind, handler, **_ids):
        self.handlers[channel] = handler
        self.polled.add(channel)

    def poll(self):
        pass

    def serve(self, channel, handler, **ids):
        self.served[channel] = (handler, ids)

    async def query(self, _channel, _request, kind, _timeout):
        assert kind is MapSnapshot
        self.requests += 1
        return await self.answers.get()


class FakeGuardian:
    def __init__(self):
        self.sent = []

    def receive(self):
        pass

    def send(self, command):
        self.sent.append((time.monotonic(), command))


class FakeLidar:
    def __init__(self):
        self.polled = []
        self.fetched = 0

    def fetch(self):
        self.fetched += 1

    def poll(self, now, *, on):
        assert on
        self.polled.append(now)
        return self.scans

    scans = ()


class Rig:
    def __init__(self, tmp_path):
        self.world = LittleWorld()
        self.master = self.world.master
        self.fog = Fog()
        self.core = AgentCore(AGENT, seed=1)
        store, clock = Store(tmp_path), SystemClock()
        self.service = Service(self.core, self.fog, store, clock, Health())
        self.map_loader = MapLoader(self.core, self.fog, store, clock, site=self.master.site)
        self.service.subscribe()
        self.changes = 0

    def change(self):
        self.changes += 1
        return self.master.write([("cost", Window(3, 3, 2, 2), np.full((2, 2), 100 + self.changes, np.uint8))], [], [])

    def deliver(self, deltas):
        for delta in deltas:
            self.fog.handlers[ch.MAP_DELTA]({}, delta)

    def send_heartbeat(self):
        self.fog.handlers[ch.MAP_HEARTBEAT]({}, self.master.heartbeat(1.0))

    async def until(self, condition):
        end = time.monotonic() + DEADLINE_S
        while not condition():
            assert time.monotonic() < end
            await asyncio.sleep(0.01)


@pytest.fixture
def rig(tmp_path):
    return Rig(tmp_path)


@pytest.fixture
async def mapping(rig):
    task = asyncio.create_task(rig.map_loader.snapshot_loop())
    yield rig
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


async def test_changes_during_the_fetch_of_a_snapshot_are_applied_after_it(mapping):
    await mapping.until(lambda: mapping.fog.requests == 1)
    old = mapping.master.snapshot()
    mapping.deliver(mapping.change())
    mapping.deliver(mapping.change())
    mapping.fog.answers.put_nowait(old)
    await mapping.until(lambda: mapping.core.replica.version == mapping.master.version)
    assert mapping.fog.requests == 1
    assert not mapping.core.wants_snapshot(SystemClock().now())


def test_every_query_of_the_core_is_served_and_commands_are_logged(rig, caplog):
    assert rig.fog.served.keys() == rig.core.query_handlers().keys()
    handler, ids = rig.fog.served[ch.ROBOT_COMMAND]
    assert ids == {"robot": AGENT.robot}
    command = RobotCommand(kind="enable", robot=AGENT.robot, operator="ann", nonce="n" * 16)
    caplog.set_level("INFO")
    assert not handler(ids, command).accepted
    assert "command" in caplog.messages


async def test_the_stream_runs_at_half_its_rate_while_the_robot_has_nothing_to_do(rig, monkeypatch):
    idle = True
    monkeypatch.setattr(AgentCore, "idle", property(lambda _core: idle))
    guardian, lidar = FakeGuardian(), FakeLidar()
    task = asyncio.create_task(rig.service.stream_loop(guardian, lidar))
    await rig.until(lambda: len(lidar.polled) >= 5)
    assert np.diff(lidar.polled).min() > service_module.STREAM_S
    idle, before = False, len(lidar.polled)
    await rig.until(lambda: np.diff(lidar.polled[before:]).min(initial=1.0) < 1.5 * service_module.STREAM_S)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    assert len(guardian.sent) == len(lidar.polled)


async def test_an_operator_of_a_robot_that_stands_by_is_answered_by_its_newest_inputs(rig, monkeypatch):
    guardian, lidar, standing = FakeGuardian(), FakeLidar(), False
    monkeypatch.setattr(AgentCore, "standing_by", property(lambda _core: standing))
    task = asyncio.create_task(rig.service.stream_loop(guardian, lidar))
    await rig.until(lambda: guardian.sent)
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)
    handler, _ = rig.fog.served[ch.ROBOT_COMMAND]
    command = RobotCommand(kind="enable", robot=AGENT.robot, operator="ann", nonce="n" * 16)
    before = len(lidar.polled)
    handler({"robot": AGENT.robot}, command)
    assert len(lidar.polled) == before
    standing = True
    handler({"robot": AGENT.robot}, command)
    assert len(lidar.polled) == before + 1


async def test_a_robot_that_stands_by_decides_nothing_until_there_may_be_something_again(rig, monkeypatch):
    standing, asked = True, []
    monkeypatch.setattr(AgentCore, "standing_by", property(lambda _core: standing))
    monkeypatch.setattr(rig.core, "control_job", asked.append)
    guardian = FakeGuardian()
    loops = [rig.service.control_loop(), rig.service.stream_loop(guardian, FakeLidar())]
    tasks = [asyncio.create_task(loop) for loop in loops]
    try:
        await rig.until(lambda: len(guardian.sent) >= 8)
        assert len(asked) == 1
        standing = False
        await rig.until(lambda: len(asked) >= 3)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


async def test_what_comes_steadily_wakes_nobody_and_all_else_comes_at_once(rig):
    assert rig.fog.polled == {ch.MAP_HEARTBEAT, ch.ROBOT_RELEASE}
    assert rig.fog.handlers.keys() == rig.core.handlers().keys()


async def test_storage_that_hangs_does_not_make_the_service_manager_restart_the_agent(rig, monkeypatch):
    begun, released, signs = threading.Event(), threading.Event(), []

    def hang(_pose):
        begun.set()
        released.wait(DEADLINE_S)

    monkeypatch.setattr(rig.service._manager, "alive", signs.append)
    monkeypatch.setattr(rig.service._store, "put_pose", hang)
    monkeypatch.setattr(rig.core, "pose_to_store", lambda _now: "a pose")
    loops = [
        rig.service.housekeeping_loop(FakeLidar(), FakeGuardian()),
        rig.service.stream_loop(FakeGuardian(), FakeLidar()),
    ]
    tasks = [asyncio.create_task(loop) for loop in loops]
    try:
        await rig.until(begun.is_set)
        before = len(signs)
        await rig.until(lambda: len(signs) > before + 2)
    finally:
        for task in tasks:
            task.cancel()
        released.set()
        await asyncio.gather(*tasks, return_exceptions=True)


async def test_pose_of_a_robot_that_drives_is_stored_within_a_tick_and_one_at_a_time(rig, monkeypatch):
    begun, released, stored = threading.Event(), threading.Event(), []

    def store(pose):
        stored.append(pose)
        begun.set()
        released.wait(DEADLINE_S)

    monkeypatch.setattr(rig.service._store, "put_pose", store)
    monkeypatch.setattr(rig.core, "pose_to_store", lambda now: now)
    monkeypatch.setattr(rig.core, "tick", lambda _at: ())
    rig.service._tick(0.0)
    assert not rig.service._storing
    monkeypatch.setattr(AgentCore, "idle", False)
    rig.service._tick(0.0)
    await rig.until(begun.is_set)
    rig.service._tick(0.0)
    await rig.service._store_pose(0.0)
    assert len(stored) == 1
    released.set()
    await rig.until(lambda: not rig.service._storing)
    rig.service._tick(0.0)
    await rig.until(lambda: len(stored) == 2)


async def test_deltas_of_an_older_map_service_do_not_affect_the_new_map(mapping):
    await mapping.until(lambda: mapping.fog.requests == 1)
    mapping.deliver(mapping.change())
    fresh = LittleWorld()
    fresh.master._version = type(fresh.master.version)(8, 0, fresh.master.version.hash)
    mapping.fog.answers.put_nowait(fresh.master.snapshot())
    await mapping.until(lambda: mapping.core.replica.version == fresh.master.version)
    assert not mapping.core.wants_snapshot(SystemClock().now())


async def test_lost_last_delta_is_detected_by_the_heartbeat_after_a_grace_period(mapping):
    mapping.fog.answers.put_nowait(mapping.master.snapshot())
    await mapping.until(lambda: mapping.core.replica.version == mapping.master.version)
    mapping.change()
    mapping.fog.answers.put_nowait(mapping.master.snapshot())
    begun = time.monotonic()

    def caught_up():
        mapping.send_heartbeat()
        return mapping.core.replica.version == mapping.master.version

    await mapping.until(caught_up)
    assert time.monotonic() - begun >= GRACE_S
    assert mapping.fog.requests == 2


async def test_unanswered_and_damaged_snapshots_are_requested_again(mapping):
    good = mapping.master.snapshot()
    mapping.fog.answers.put_nowait(None)
    mapping.fog.answers.put_nowait(msgspec.structs.replace(good, hash=1))
    mapping.fog.answers.put_nowait(good)
    await mapping.until(lambda: mapping.core.replica.version is not None)
    assert mapping.fog.requests == 3


async def test_map_that_takes_long_to_prepare_does_not_block_the_stream(mapping, monkeypatch):
    begun, released, prepare = threading.Event(), threading.Event(), mapping.core.prepare_map

    def prepare_slowly(snapshot):
        begun.set()
        released.wait(DEADLINE_S)
        return prepare(snapshot)

    monkeypatch.setattr(mapping.core, "prepare_map", prepare_slowly)
    guardian = FakeGuardian()
    stream = asyncio.create_task(mapping.service.stream_loop(guardian, FakeLidar()))
    try:
        mapping.fog.answers.put_nowait(mapping.master.snapshot())
        await mapping.until(begun.is_set)
        before = len(guardian.sent)
        await mapping.until(lambda: len(guardian.sent) >= before + 5)
        assert mapping.core.replica.version is None
        released.set()
        await mapping.until(lambda: mapping.core.replica.version == mapping.master.version)
    finally:
        released.set()
        stream.cancel()
        await asyncio.gather(stream, return_exceptions=True)


async def test_hanging_decision_does_not_block_the_stream(rig, monkeypatch):
    release, begun = threading.Event(), threading.Event()

    def hang(_job):
        begun.set()
        release.wait(DEADLINE_S)
        raise AssertionError("the released decision must not run")

    monkeypatch.setattr(service_module, "decide", hang)
    monkeypatch.setattr(rig.core, "control_job", lambda _now: object())
    guardian, lidar = FakeGuardian(), FakeLidar()
    loops = rig.service.control_loop(), rig.service.stream_loop(guardian, lidar)
    tasks = [asyncio.create_task(loop) for loop in loops]
    try:
        await rig.until(begun.is_set)
        before = len(guardian.sent)
        await rig.until(lambda: len(guardian.sent) >= before + 20)
        assert [command.seq for _, command in guardian.sent] == list(range(1, len(guardian.sent) + 1))
        assert len(lidar.polled) == len(guardian.sent)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        release.set()


class Decisions:
    """Decides when the test lets it, and records which decisions have begun and which were accepted."""

    def __init__(self, rig, monkeypatch):
        self.events = []
        self.may_end = threading.Event()
        self.failure = None
        self.guardian = FakeGuardian()
        monkeypatch.setattr(service_module, "decide", self._decide)
        monkeypatch.setattr(rig.core, "control_job", lambda now: now)
        monkeypatch.setattr(rig.core, "accept", lambda job: self.events.append(("accepted", job)))

    def _decide(self, job):
        self.events.append(("begun", job))
        assert self.may_end.wait(DEADLINE_S)
        if self.failure is not None:
            raise self.failure
        return job

    def seen(self, kind):
        return [job for event, job in self.events if event == kind]


@pytest.fixture
def decisions(rig, monkeypatch):
    return Decisions(rig, monkeypatch)


async def test_no_decision_begins_beside_one_that_is_slower_than_its_period_and_the_next_counts_as_late(rig, decisions):
    loops = rig.service.control_loop(), rig.service.stream_loop(decisions.guardian, FakeLidar())
    tasks = [asyncio.create_task(loop) for loop in loops]
    try:
        await rig.until(lambda: decisions.seen("begun"))
        before = len(decisions.guardian.sent)
        # At twice the rate of decisions or more, these are more than two periods.
        await rig.until(lambda: len(decisions.guardian.sent) >= before + 12)
        assert len(decisions.seen("begun")) == 1
        decisions.may_end.set()
        await rig.until(lambda: len(decisions.seen("accepted")) >= 2)
    finally:
        decisions.may_end.set()
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    first, second = decisions.seen("begun")[:2]
    period = rig.core.profile.control_period
    assert second - first >= 2 * period, "the time of its inputs is that at which it begins"
    assert rig.service._loop_health().control_p99_s >= period / 2


async def test_an_error_in_a_decision_ends_a_loop_of_the_agent(rig, decisions):
    decisions.failure = ZeroDivisionError("in a decision")
    decisions.may_end.set()
    loops = rig.service.control_loop(), rig.service.stream_loop(decisions.guardian, FakeLidar())
    tasks = [asyncio.create_task(loop) for loop in loops]
    done, others = await asyncio.wait(tasks, timeout=DEADLINE_S, return_when=asyncio.FIRST_EXCEPTION)
    for task in others:
        task.cancel()
    await asyncio.gather(*others, return_exceptions=True)
    assert [task.exception() for task in done] == [decisions.failure]


async def test_pose_that_a_full_disk_has_refused_is_stored_once_there_is_room(tmp_path, monkeypatch):
    folder = tmp_path / "data"
    folder.write_text("where no folder can be")
    rig = Rig(folder)
    pose = SavedPose(site="lab", x=1.0, y=2.0, theta=3.0, sigma_xy=0.1, sigma_theta=0.1)
    told = iter([pose])
    monkeypatch.setattr(rig.core, "pose_to_store", lambda _now: next(told, None))
    await rig.service._store_pose(1.0)
    folder.unlink()
    await rig.service._store_pose(2.0)
    assert Store(folder).pose("lab") == pose
