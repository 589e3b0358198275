from __future__ import annotations

import asyncio
import socket
import time

import msgspec
import pytest
from guardian_rig import DEADLINE_S

from fog_runtime.clock import SystemClock
from robot_agent.agent.edges import guardian_client
from robot_agent.agent.edges.guardian_client import FEEDBACK_TIMEOUT_S, RESET_VALID_S, GuardianClient
from robot_agent.guardian.link import BaseFeedback, WheelCommand, decode_command, encode
from robot_agent.hardware import BaseStatus, WheelOdometry
from robot_agent.localization.odometry import OdometryBuffer

pytestmark = pytest.mark.live

FEEDBACK = BaseFeedback(
    seq=1, status=BaseStatus(battery=0.5), odometry=WheelOdometry(left_m=5.0, right_m=6.0), fault=None, stopped=None
)


class SkippingClock(SystemClock):
    """Real time with leaps forward."""

    skipped = 0.0

    def now(self):
        return super().now() + self.skipped


class Guardian:
    """The other end of the socket."""

    def __init__(self, path):
        self.path = path
        self.listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.listener.bind(str(path))
        self.listener.listen(1)
        self.listener.settimeout(0)
        self.link = None

    async def accept(self):
        self.link, _ = await asyncio.get_running_loop().sock_accept(self.listener)
        self.link.settimeout(0)

    async def receive(self):
        data = await asyncio.get_running_loop().sock_recv(self.link, 4096)
        return decode_command(data)

    def close(self):
        for end in (self.link, self.listener):
            if end is not None:
                end.close()
        self.path.unlink(missing_ok=True)


class Rig:
    def __init__(self, path):
        self.path = path
        self.clock = SkippingClock()
        self.feedback = []
        self.times = []
        self.losses = []
        self.client = GuardianClient(path, self.clock)

    def begin(self):
        self.client.begin(
            lambda feedback, at: (self.feedback.append(feedback), self.times.append(at)),
            lambda _, reason: self.losses.append(reason),
        )

    async def until(self, condition):
        end = time.monotonic() + DEADLINE_S
        while not condition():
            assert time.monotonic() < end
            await asyncio.sleep(0.01)

    async def stream(self):
        """Read the link at a steady rate, as the stream of wheel commands does."""
        while True:
            self.client.receive()
            await asyncio.sleep(0.01)


def command(seq=1, **more):
    return WheelCommand(seq=seq, left=0.1, right=0.2, **more)


@pytest.fixture
async def rig(tmp_path):
    made = Rig(tmp_path / "guardian.sock")
    made.begin()
    tasks = [asyncio.create_task(loop) for loop in (made.client.run(), made.stream())]
    yield made
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


@pytest.fixture
async def guardian(rig):
    """Return a guardian to which the agent of `rig` is connected."""
    made = Guardian(rig.path)
    await made.accept()
    yield made
    made.close()


async def test_what_the_guardian_sent_while_the_agent_was_loaded_is_passed_on_with_its_times(tmp_path):
    guardian, rig = Guardian(tmp_path / "guardian.sock"), Rig(tmp_path / "guardian.sock")
    tasks = [asyncio.create_task(rig.client.run())]
    await guardian.accept()
    begun = time.monotonic()
    sent = [msgspec.structs.replace(FEEDBACK, seq=number, at=begun - 1.0 + 0.1 * number) for number in range(5)]
    for feedback in sent:
        guardian.link.send(encode(feedback))
    await rig.until(lambda: rig.client.pid)
    rig.begin()
    tasks.append(asyncio.create_task(rig.stream()))
    try:
        await rig.until(lambda: len(rig.feedback) == len(sent))
        assert rig.feedback == sent
        assert rig.times == [feedback.at for feedback in sent]
        assert rig.client.send(command(seq=7))
        assert (await guardian.receive()).seq == 7
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        guardian.close()


async def test_link_that_nobody_has_read_for_long_is_made_anew(tmp_path, monkeypatch):
    """Its socket may be full, and the guardian keeps what is newest to itself."""
    guardian, rig = Guardian(tmp_path / "guardian.sock"), Rig(tmp_path / "guardian.sock")
    tasks = [asyncio.create_task(rig.client.run())]
    await guardian.accept()
    guardian.link.send(encode(msgspec.structs.replace(FEEDBACK, at=SystemClock().now() - 40.0)))
    await rig.until(lambda: rig.client.pid)
    loaded = time.monotonic() + 40.0
    with monkeypatch.context() as later:
        later.setattr(guardian_client.time, "monotonic", lambda: loaded)
        rig.begin()
    tasks.append(asyncio.create_task(rig.stream()))
    try:
        with guardian.link:
            await guardian.accept()
        sent = msgspec.structs.replace(FEEDBACK, seq=9, at=SystemClock().now() - 0.2)
        guardian.link.send(encode(sent))
        await rig.until(lambda: rig.feedback)
        assert (rig.feedback, rig.times) == ([sent], [sent.at])
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        guardian.close()


async def test_missing_guardian_is_reported_and_connected_when_it_starts(rig):
    await rig.until(lambda: rig.losses)
    assert "does the watchdog run?" in rig.losses[0]
    assert not rig.client.send(command())
    guardian = Guardian(rig.path)
    await guardian.accept()
    await rig.until(lambda: rig.client.send(command(seq=7)))
    assert (await guardian.receive()).seq == 7
    guardian.link.send(encode(FEEDBACK))
    await rig.until(lambda: rig.feedback == [FEEDBACK])
    guardian.close()
    await rig.until(lambda: "the guardian closed the link" in rig.losses)


async def test_bad_feedback_is_ignored_and_a_silent_base_is_reported(rig, guardian):
    guardian.link.send(b"\xc1 nonsense")
    guardian.link.send(encode(FEEDBACK))
    await rig.until(lambda: rig.feedback == [FEEDBACK])
    rig.losses.clear()
    rig.client.send(command())
    assert not rig.losses
    rig.clock.skipped = FEEDBACK_TIMEOUT_S + 0.01
    rig.client.send(command())
    assert "receives nothing from the base" in rig.losses[0]
    guardian.link.send(encode(FEEDBACK))
    await rig.until(lambda: len(rig.feedback) == 2)
    rig.losses.clear()
    rig.client.send(command())
    assert not rig.losses


@pytest.mark.parametrize(
    ("age", "trusted"), [(0.04, True), (0.3, True), (20.0, True), (31.0, False), (-0.01, False), (None, False)]
)
async def test_feedback_counts_from_when_it_was_sent_by_the_clock_of_both(rig, guardian, age, trusted):
    now = time.monotonic()
    rig.clock.now = lambda: now
    guardian.link.send(encode(msgspec.structs.replace(FEEDBACK, at=None if age is None else now - age)))
    await rig.until(lambda: rig.feedback)
    assert rig.times == [pytest.approx(now - age if trusted else now, abs=1e-6)]


async def test_feedback_that_waited_while_the_agent_was_late_keeps_its_times_and_so_all_odometry(rig, guardian):
    now = time.monotonic()
    rig.clock.now = lambda: now
    ages = [0.05 * count for count in range(16, -1, -1)]
    for age in ages:
        guardian.link.send(encode(msgspec.structs.replace(FEEDBACK, at=now - age)))
    await rig.until(lambda: len(rig.times) == len(ages))
    assert rig.times == pytest.approx([now - age for age in ages], abs=1e-6)
    odometry = OdometryBuffer()
    for number, at in enumerate(rig.times):
        odometry.add(at, 0.015 * number, 0.0, 0.0)
    assert odometry.pose(now - 0.4).x == pytest.approx(0.015 * 8, abs=1e-6)
    assert odometry.twist()[0] == pytest.approx(0.3, abs=1e-3)


async def test_times_of_feedback_never_go_back_even_when_another_clock_shows_late(rig, guardian):
    now = time.monotonic()
    rig.clock.now = lambda: now
    for age in (0.2, 0.3, -5.0, 0.1):
        guardian.link.send(encode(msgspec.structs.replace(FEEDBACK, at=now - age)))
    await rig.until(lambda: len(rig.times) == 4)
    assert rig.times == pytest.approx([now - 0.2, now - 0.2, now, now], abs=1e-6)


async def test_a_flood_of_feedback_does_not_block_the_stream(rig, guardian):
    await rig.until(lambda: rig.client.send(command()))
    sent = 0
    try:
        while True:
            guardian.link.send(encode(FEEDBACK))
            sent += 1
    except BlockingIOError:
        pass
    assert sent > 64
    rig.client.receive()
    assert len(rig.feedback) == 64
    await rig.until(lambda: len(rig.feedback) == sent)


async def test_refusal_by_the_guardian_is_the_reason_and_the_agent_asks_again(rig):
    guardian = Guardian(rig.path)
    for _ in range(2):
        await guardian.accept()
        guardian.link.send(encode("another agent is connected"))
        rig.losses.clear()
        await rig.until(lambda: rig.losses)
        assert rig.losses[0] == "the guardian refuses this agent: another agent is connected"
        guardian.link.close()
    guardian.close()


async def test_reset_without_a_guardian_is_passed_on_soon_after_or_expires(rig):
    rig.client.send(command(reset=True))
    guardian = Guardian(rig.path)
    await guardian.accept()
    await rig.until(lambda: rig.client.send(command()))
    assert (await guardian.receive()).reset
    rig.client.send(command())
    assert not (await guardian.receive()).reset
    guardian.close()
    await rig.until(lambda: not rig.client.send(command()))
    rig.client.send(command(reset=True))
    rig.clock.skipped = RESET_VALID_S + 0.1
    guardian = Guardian(rig.path)
    await guardian.accept()
    await rig.until(lambda: rig.client.send(command()))
    assert not (await guardian.receive()).reset
    guardian.close()


async def test_a_guardian_that_does_not_read_never_blocks_the_agent(rig, guardian):
    await rig.until(lambda: rig.client.send(command()))
    sent = 0
    while rig.client.send(command()):
        sent += 1
        assert sent < 100_000
