"""An emulated base on a real pty, the watchdog with its guardian as real processes, and an agent connected to them."""

from __future__ import annotations

import json
import os
import re
import select
import socket
import subprocess
import sys
import termios
import threading
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import TYPE_CHECKING

import psutil
from lateness import Lateness

from fog_supervisor.child import command
from fognav_sim.pty_port import PtyPort
from robot_agent.bases.roomba600.emulator import RoombaEmulator
from robot_agent.guardian.link import WheelCommand, decode_reply, encode

if TYPE_CHECKING:
    import signal

DEADLINE_S = 60.0
STOP_S = 0.3
"""Longest time that the robot's design allows for stopping the wheels."""
LATE_S = 0.02
"""A base whose thread comes later than this sees a command later than its wheels would."""


def wait_for(condition, expected: str, deadline_s: float = DEADLINE_S):
    until = time.monotonic() + deadline_s
    while time.monotonic() < until:
        if value := condition():
            return value
        time.sleep(0.005)
    raise AssertionError(f"not within {deadline_s} s: {expected}")


def lateness() -> Lateness:
    """Return what tells how late a busy machine makes this process and its programs from now on."""
    return Lateness(lambda: [os.getpid(), *(child.pid for child in psutil.Process().children(recursive=True))])


BAUDS = {getattr(termios, name): int(name[1:]) for name in dir(termios) if re.fullmatch(r"B\d+", name)}


def baud_of(fd: int) -> int:
    """Rate of a terminal; a new pty has none, like a line that no host has opened."""
    return BAUDS[termios.tcgetattr(fd)[4]]


class Base:
    """A base behind a pty, run by a thread; it records since when its wheels have been at rest."""

    def __init__(self, link: Path, robot=None) -> None:
        self.link = link
        self.robot = robot or RoombaEmulator()
        self.lock = threading.Lock()
        self.stopped_at: float | None = time.monotonic()
        self.late_s = 0.0
        """How long its thread came late in all: another thread of the test held Python's lock, or there was no core."""
        self.send_in_pieces = False
        """Pass on a few bytes at a time, as adapters with a short latency timer do."""
        self._port: PtyPort | None = None
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self):
        self.plug_in()
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._ends.set()
        self._thread.join()
        self.unplug()

    def plug_in(self) -> None:
        with self.lock:
            self._port = PtyPort(self.link)

    def unplug(self) -> None:
        with self.lock:
            if self._port is not None:
                self._port.close()
                self._port = None

    def send(self, data: bytes) -> None:
        with self.lock:
            self._port.write(data)

    def has_obeyed(self) -> bool:
        """Whether it has taken in all that was written to its port."""
        with self.lock:
            return not select.select((self._port.fileno(),), (), (), 0.0)[0]

    @property
    def moving(self) -> bool:
        return self.stopped_at is None

    @property
    def speeds(self) -> tuple[float, float]:
        return self.robot.wheel_speeds_m_s

    def stopped_within(self, begun: float) -> float:
        """Seconds from `begun` until the wheels were at rest; they still are.

        What a busy machine let this process and its programs wait meanwhile does not count.
        """
        late, own = lateness(), self.late_s
        stopped = wait_for(lambda: self.stopped_at, "the wheels stop")
        return stopped - begun - late.seconds() - (self.late_s - own)

    def _run(self) -> None:
        before = time.monotonic()
        while not self._ends.wait(0.004):
            now = time.monotonic()
            self.late_s += max(0.0, now - before - LATE_S)
            with self.lock:
                if self._port is not None:
                    # At another rate than the host's a device gets garbage, here nothing, and so does the host.
                    heard = baud_of(self._port.fileno()) == self.robot.baud
                    if (data := self._port.read()) and heard:
                        self.robot.receive(data, now)
                    left, right = self.robot.wheel_speeds_m_s
                    self.robot.add_wheel_travel(left * (now - before), right * (now - before))
                    self.robot.tick(now, now - before)
                    sent = self.robot.outgoing(now)
                    if heard:
                        size = 12 if self.send_in_pieces else max(len(sent), 1)
                        for begin in range(0, len(sent), size):
                            self._port.write(sent[begin : begin + size])
                            if self.send_in_pieces:
                                time.sleep(0.001)
            before = now
            if self.robot.wheel_speeds_m_s != (0.0, 0.0):
                self.stopped_at = None
            elif self.stopped_at is None:
                self.stopped_at = now


class Process:
    """A program with a log, in a `with` block; a subclass starts it."""

    log_file: Path
    process = None
    ends_within_s = 5.0

    def start(self) -> None:
        raise NotImplementedError

    def __enter__(self):
        self.start()
        return self

    def __exit__(self, *_):
        if self.process.poll() is None:
            self.process.terminate()
        try:
            self.process.wait(self.ends_within_s)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()

    @property
    def events(self) -> list[dict]:
        return [json.loads(line) for line in self.log_file.read_text().splitlines() if line.startswith("{")]


class Watchdog(Process):
    """`python -m robot_agent.guardian.watchdog` and its log."""

    def __init__(self, folder: Path, base_port: Path) -> None:
        self.log_file = folder / "watchdog.log"
        self.socket = folder / "guardian.sock"
        self.environment = {
            **os.environ,
            "FOGNAV_BASE_PORT": str(base_port),
            "FOGNAV_GUARDIAN_SOCKET": str(self.socket),
        }

    def start(self) -> None:
        with self.log_file.open("ab") as log:
            self.process = subprocess.Popen(
                command(sys.executable, "-m", "robot_agent.guardian.watchdog"), env=self.environment, stderr=log,
                stdout=log,
            )  # fmt: skip

    def count(self, event: str) -> int:
        return sum(line["event"] == event for line in self.events)

    def guardian(self) -> int | None:
        """Process id of the guardian that runs now."""
        children = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
        return int(children[0]) if children else None


class Agent:
    """The real agent's behaviour on the guardian's socket: commands at 20 Hz, feedback received."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.wheels: tuple[float, float] | None = (0.0, 0.0)
        self.maneuver = None
        self.reset = False
        self.refused: str | None = None
        self.feedback = None
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._ends.set()
        self._thread.join()

    def _run(self) -> None:
        seq = 0
        while not self._ends.is_set():
            with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as link:
                try:
                    link.connect(str(self.path))
                    link.settimeout(0.05)
                    due = time.monotonic()
                    while not self._ends.is_set():
                        if self.wheels is not None and time.monotonic() >= due:
                            seq += 1
                            due = time.monotonic() + 0.05
                            reset, self.reset = self.reset, False
                            left, right = self.wheels
                            command = WheelCommand(seq=seq, left=left, right=right, reset=reset, maneuver=self.maneuver)
                            # One that is refused finds the link closed, and the reason in it.
                            with suppress(BrokenPipeError):
                                link.send(encode(command))
                        try:
                            data = link.recv(4096)
                        except TimeoutError:
                            continue
                        if not data:
                            break
                        reply = decode_reply(data)
                        if isinstance(reply, str):
                            self.refused = reply
                        else:
                            self.feedback = reply
                except OSError:
                    pass
            self._ends.wait(0.05)


class Rig:
    """Base, watchdog, guardian and agent, ready to drive."""

    def __init__(self, folder: Path, base: str = "roomba600", robot=None) -> None:
        self.base = Base(folder / "base", robot)
        self.watchdog = Watchdog(folder, self.base.link)
        self.watchdog.environment["FOGNAV_BASE"] = base
        self.agent = Agent(self.watchdog.socket)
        self._stack = ExitStack()

    def __enter__(self):
        for part in (self.base, self.watchdog, self.agent):
            self._stack.enter_context(part)
        return self

    def __exit__(self, *details):
        self._stack.__exit__(*details)

    def drive(self) -> None:
        """Drive at 0.3 m/s, once the guardian is connected."""
        self.agent.wheels = (0.3, 0.3)
        wait_for(lambda: self.base.speeds == (0.3, 0.3), "the base drives")

    def end_guardian(self, number: signal.Signals) -> float:
        """Send the guardian a signal; return when that was."""
        pid = self.watchdog.guardian()
        os.kill(pid, number)
        return time.monotonic()
