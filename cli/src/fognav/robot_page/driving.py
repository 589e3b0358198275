"""Driving by hand by what is held: keys of a terminal, or a game pad."""

from __future__ import annotations

import contextlib
import math
import os
import select
import struct
import sys
import termios
import time
import tty
from typing import TYPE_CHECKING, Final, Protocol

from fognav.output import FailedError, WrongUseError, print_line
from fognav.robot_page.view import LocalRobotErrors, RobotView
from robot_agent.agent.hand_driving import HandReply
from robot_agent.local_client import LocalRobot

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

_PERIOD_S: Final = 0.05
_KEY_S: Final = 0.15
"""A terminal tells no release of a key: one that is not repeated for this long is released."""
_PAD_S: Final = 1.0
"""A game pad out of range or without power tells no release either. One that is well tells something all the while, but
for a stick at its very end: there the robot stops, too, until the button is pressed again."""
_HEALTHY_S: Final = 5.0
"""For so long a robot is asked again that must not move: its lidar may have to start."""
_MOVES: Final = {
    "i": (1, 0), "o": (1, -1), "j": (0, 1), "l": (0, -1), "u": (1, 1), ",": (-1, 0), ".": (-1, 1), "m": (-1, -1),
}  # fmt: skip
_FASTER: Final = {"q": (1.1, 1.1), "z": (0.9, 0.9), "w": (1.1, 1), "x": (0.9, 1), "e": (1, 1.1), "c": (1, 0.9)}
HELP: Final = """\
hold a key to drive:   u i o      q/z faster/slower: both
                       j k l      w/x only ahead and back
                       m , .      e/c only turning
k or space stops, r resets a fault, Ctrl-C ends. Letting go stops the robot."""


class MustNotMoveError(FailedError):
    """The robot's state keeps it from being driven, such as a fault that is latched."""


class _Steering(Protocol):
    """Something that is held to drive."""

    def fileno(self) -> int:
        """Return what `select` waits for."""

    def read(self, now: float) -> str:
        """Take in what has come; return "stop", "reset" or nothing. Raises `FailedError` when it is gone."""

    def motion(self, now: float) -> tuple[float, float]:
        """Return v (m/s) and w (rad/s)."""

    @property
    def lapses_at(self) -> float:
        """When what is held counts as released by itself (s, monotonic); infinite if it does not."""


class Keyboard:
    """Keys as in ROS's teleop_twist_keyboard."""

    def __init__(self, speed: float, turn: float) -> None:
        self._speed, self._turn = speed, turn
        self._held, self._held_at = (0, 0), 0.0

    def fileno(self) -> int:
        """Return the terminal's number."""
        return sys.stdin.fileno()

    def read(self, now: float) -> str:
        """Take in the keys that were pressed."""
        keys = os.read(self.fileno(), 64).decode(errors="ignore")
        if not keys:
            raise FailedError("the terminal is gone: the robot stands")
        for key in keys:
            if key in _MOVES:
                self._held, self._held_at = _MOVES[key], now
            elif key in _FASTER:
                ahead, turning = _FASTER[key]
                self._speed, self._turn = min(self._speed * ahead, 0.15), min(self._turn * turning, 1.0)
                print_line(f"{self._speed:.2f} m/s, {self._turn:.2f} rad/s\r")
            elif key == "r":
                return "reset"
            else:
                self._held = (0, 0)
        return ""

    def motion(self, now: float) -> tuple[float, float]:
        """Return the motion of the key that is held."""
        if now >= self.lapses_at:
            self._held = (0, 0)
        ahead, left = self._held
        return ahead * self._speed, left * self._turn

    @property
    def lapses_at(self) -> float:
        """When the key that is held counts as released."""
        return math.inf if self._held == (0, 0) else self._held_at + _KEY_S


class GamePad:
    """A game pad by Linux's joystick interface: a shoulder button is held, the left stick steers.

    One that has told nothing for `_PAD_S` may be out of range: the button counts as released until it is pressed again.
    """

    _EVENT = struct.Struct("<IhBB")
    _BUTTON, _AXIS, _FIRST = 0x01, 0x02, 0x80
    _SHOULDERS = frozenset({4, 5})

    def __init__(self, device: Path, speed: float, turn: float) -> None:
        """Open it; raises `WrongUseError`."""
        self._device, self._speed, self._turn = device, speed, turn
        self._axes: dict[int, float] = {}
        self._held: set[int] = set()
        self._heard_at = 0.0
        try:
            self._file = os.open(device, os.O_RDONLY | os.O_NONBLOCK)
        except OSError as error:
            raise WrongUseError(
                f"{device}: {error.strerror}. Name the game pad, as /dev/input/js0, which the group `input` may read"
            ) from error

    def fileno(self) -> int:
        """Return the device's number."""
        return self._file

    def read(self, now: float) -> str:
        """Take in what has changed."""
        self.motion(now)  # what comes after a silence does not undo its end
        try:
            data = os.read(self._file, 64 * self._EVENT.size)
        except BlockingIOError:
            return ""
        except OSError as error:
            raise FailedError(f"{self._device}: {error.strerror}: the robot stands") from error
        if not data:
            raise FailedError(f"{self._device}: the game pad is gone: the robot stands")
        self._heard_at = now
        for _, value, kind, number in self._EVENT.iter_unpack(data[: len(data) // self._EVENT.size * self._EVENT.size]):
            if kind & self._AXIS:
                self._axes[number] = value / 32767.0
            elif kind & self._BUTTON and number in self._SHOULDERS:
                # What is held when the device is opened is not the word of somebody who looks.
                (self._held.add if value and not kind & self._FIRST else self._held.discard)(number)
        return ""

    def motion(self, now: float) -> tuple[float, float]:
        """Return the motion of the stick while a shoulder button is held."""
        if now >= self.lapses_at:
            self._held.clear()
        if not self._held:
            return 0.0, 0.0
        ahead, left = -self._axes.get(1, 0.0), -self._axes.get(0, 0.0)
        return ahead * self._speed, left * self._turn

    @property
    def lapses_at(self) -> float:
        """When the button that is held counts as released."""
        return self._heard_at + _PAD_S if self._held else math.inf


def drive(path: Path, steering: _Steering) -> None:
    """Drive the robot at this socket until Ctrl-C; raises `FailedError`."""
    with LocalRobotErrors(), LocalRobot(path) as robot:
        view = RobotView()
        _take_over_or_wait(robot, steering)
        told, said = "", (0.0, 0.0)
        due = time.monotonic()
        with contextlib.suppress(KeyboardInterrupt):
            while True:
                wait = max(0.0, min(due, steering.lapses_at) - time.monotonic())
                ready, _, _ = select.select([steering.fileno(), robot.fileno()], [], [], wait)
                now = time.monotonic()
                word = steering.read(now) if steering.fileno() in ready else ""
                for entry in robot.poll():
                    if isinstance(entry, HandReply):
                        print_line(entry.reason + "\r")
                    else:
                        view.take(entry)
                if word == "reset":
                    print_line(robot.reset().reason + "\r")
                    _take_over_or_wait(robot, steering)
                told = _tell(view, told)
                motion = steering.motion(now)
                if now >= due or (motion == (0.0, 0.0) != said):  # who lets go is not made to wait
                    robot.steer(*motion)
                    due, said = max(due + _PERIOD_S, now), motion
        robot.hand_back()


def _take_over_or_wait(robot: LocalRobot, steering: _Steering) -> None:
    """Take the robot over; who has a key that resets its fault is told why it must not move yet."""
    try:
        take_over(robot)
    except MustNotMoveError as error:
        if not isinstance(steering, Keyboard):
            raise
        print_line(f"{error}. r resets a fault whose cause is gone, and tries again\r")


def take_over(robot: LocalRobot) -> None:
    """Take the robot over, as soon as it may move; raises `FailedError` with its reason if it may not.

    Of these, `MustNotMoveError` says that it will when its state allows.
    """
    until = time.monotonic() + _HEALTHY_S
    while not (reply := robot.take_over()).accepted:
        if reply.code != "must_not_move" or time.monotonic() > until:
            kind = MustNotMoveError if reply.code in {"must_not_move", "fault_latched"} else FailedError
            raise kind(f"the robot refuses to be driven by hand: {reply.reason}")
        time.sleep(_PERIOD_S)


def _tell(view: RobotView, before: str) -> str:
    """Print mode and reasons when they change; return them."""
    state = view.state
    text = f"{state.get('mode', '')}: {'; '.join(state.get('reasons', []))}" if state else before
    if text != before:
        print_line(text + "\r")
    return text


@contextlib.contextmanager
def raw_terminal() -> Iterator[None]:
    """Read single keys while the context is open, unechoed."""
    before = termios.tcgetattr(sys.stdin)
    try:
        tty.setcbreak(sys.stdin)
        yield
    finally:
        termios.tcsetattr(sys.stdin, termios.TCSADRAIN, before)
