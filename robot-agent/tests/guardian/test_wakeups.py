"""What wakes a guardian: commands while its wheels rest, the frames of its base while they turn, and its heartbeat."""

from __future__ import annotations

import os
import pty
import select
import signal
import socket
import time
import tty
from contextlib import ExitStack

import pytest
from lateness import Lateness

from fog_runtime.configuration.robot_file import default_robot
from robot_agent.bases.roomba600.emulator import RoombaEmulator
from robot_agent.device_signature import LineCheck
from robot_agent.guardian.core import GuardianCore
from robot_agent.guardian.link import WheelCommand, encode
from robot_agent.guardian.process import Guardian, GuardianSettings
from robot_agent.guardian.timing import HEARTBEAT_MAX_S
from robot_agent.hardware import Awakening, WakeLine
from robot_agent.registry import make_base, signatures
from robot_agent.serial_port import Port, open_port

pytestmark = pytest.mark.live

LONG_S = 5.0


class Line:
    """A base's end of a serial line, and the port at its other end."""

    def __init__(self, contexts: ExitStack) -> None:
        self.base, slave = pty.openpty()
        contexts.callback(os.close, self.base)
        tty.setraw(slave)
        path = os.ttyname(slave)
        os.close(slave)
        self.port: Port = contexts.enter_context(open_port(path, 115200))


class Rig:
    """A guardian whose cycles the test runs, at an emulated base, with an agent on its socket."""

    def __init__(self, contexts: ExitStack, tmp_path) -> None:
        self.line = Line(contexts)
        self.emulator = RoombaEmulator()
        beats, beat = os.pipe()
        alive, closed = os.pipe()
        for descriptor in (beats, beat, alive, closed):
            contexts.callback(os.close, descriptor)
        os.set_blocking(beats, False)
        self.beats = beats
        path = str(tmp_path / "guardian.sock")
        listener = contexts.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
        listener.bind(path)
        listener.listen(1)
        listener.settimeout(0)
        settings = GuardianSettings(
            base_fd=self.line.port.fileno(), heartbeat_fd=beat, watchdog_fd=alive, guardian_socket=path
        )
        core = GuardianCore(make_base(default_robot()))
        check = LineCheck(self.line.port.path, "roomba600", signatures())
        self.guardian = Guardian(settings, core, listener, check)
        self.core = core
        self.agent = contexts.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET))
        self.agent.connect(path)
        self.guardian._accept()
        contexts.callback(self.guardian._drop_agent, "the test ends")
        self.seq = 0

    def answer(self) -> None:
        """Let the base take what was written to it, and send what it has to send."""
        now = time.monotonic()
        while select.select((self.line.base,), (), (), 0.0)[0]:
            self.emulator.receive(os.read(self.line.base, 4096), now)
        self.emulator.tick(now, 0.015)
        os.write(self.line.base, self.emulator.outgoing(now))

    def drive(self, speed: float) -> None:
        self.seq += 1
        self.agent.send(encode(WheelCommand(seq=self.seq, left=speed, right=speed)))

    def cycle(self, seconds: float) -> None:
        self.guardian._wait(seconds)
        self.guardian._cycle()

    def now(self) -> float:
        return self.guardian._clock.now()

    @property
    def sent_at(self) -> float:
        """The time of the guardian's last heartbeat, from which its next wait counts."""
        return self.guardian._heartbeats._sent_at

    def heartbeats(self) -> int:
        try:
            return len(os.read(self.beats, 4096))
        except BlockingIOError:
            return 0


@pytest.fixture
def rig(tmp_path):
    with ExitStack() as contexts:
        yield Rig(contexts, tmp_path)


def test_guardian_waits_no_longer_than_its_next_heartbeat_may(rig):
    late = Lateness(lambda: [os.getpid()])
    rig.cycle(0.0)
    assert rig.heartbeats() == 1
    for _ in range(2):
        before = rig.sent_at
        rig.cycle(LONG_S)
        assert HEARTBEAT_MAX_S - 0.01 < rig.sent_at - before < LONG_S / 2 + late.seconds()
        assert rig.heartbeats() == 1


def test_commands_wake_a_guardian_at_rest_and_frames_one_whose_wheels_turn(rig):
    deadline = time.monotonic() + 60.0
    while not rig.core.moving:
        assert time.monotonic() < deadline
        rig.answer()
        rig.drive(0.1)
        rig.cycle(LONG_S)  # which the command ends
    rig.line.port.read_available()
    rig.drive(0.1)
    # The frames' time, or what is left until a heartbeat: on a busy machine most of that has passed.
    until = min(rig.now() + 0.02, rig.sent_at + HEARTBEAT_MAX_S)
    rig.cycle(0.02)
    assert rig.now() >= until - 0.001
    assert rig.core._command.seq == rig.seq  # read in the cycle all the same
    rig.agent.close()
    begun, late = time.monotonic(), Lateness(lambda: [os.getpid()])
    rig.cycle(LONG_S)  # which the end of the link ends
    assert time.monotonic() - begun < HEARTBEAT_MAX_S + 1.0 + late.seconds()
    assert rig.guardian._agent is None


@pytest.mark.parametrize(("line", "released"), [(WakeLine("rts", 1.2), [("rts", False)] * 2), (None, [])])
def test_line_that_wakes_the_base_is_free_after_the_begin_and_the_end_of_a_guardian(rig, monkeypatch, line, released):
    lines = []
    monkeypatch.setattr(Port, "set_line", lambda _port, name, *, on: lines.append((name, on)))
    rig.core.driver.awakening = Awakening(bauds=(115200,), line=line)
    rig.guardian.end(signal.SIGTERM, None)
    assert rig.guardian.run() == 0
    assert lines == released
