"""Calibrating without a driver: which movements a robot makes in a free square, and what ends them.

Each movement is undone by the next, so that a robot whose wheels and axle are not as its settings say comes back to
where it stood. It drives as any hand does (ADR 64): gate, stop field, guardian and the agent's dead man's switch guard
it, and a tool that dies stops it.
"""

from __future__ import annotations

import contextlib
import math
import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from fog_contracts.messages import ReasonCode
from fognav.output import FailedError, WrongUseError, print_line
from fognav.robot_page.calibrating import USED, DriveLog, bars, known
from fognav.robot_page.driving import take_over
from fognav.robot_page.recording_view import until_told
from fognav.robot_page.view import LocalRobotErrors, RobotView
from robot_agent.agent.recording.input_log import BaseReceived, Published, ScanReceived
from robot_agent.calibration import CalibrationError, Calibrator
from robot_agent.local_client import LocalRobot, LocalRobotError
from robot_agent.localization.odometry import wheel_travel

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from numpy.typing import NDArray

    from robot_agent.config import AgentConfig

SQUARE_M: Final = 1.2
ROUNDS: Final = 3
"""Of 190 s for a robot of 0.17 m in its square: more would add little to what is known, and much to what slips."""
SPEED_M_S: Final = 0.12
_TURN_RAD_S: Final = 0.5
_MARGIN_M: Final = 0.1
"""Beside a body whose odometry is 15 % wrong, and whose wheels slip."""
_STRAIGHT_M: Final = 0.65
"""The calibration compares scans 0.6 m apart."""
_TURN_RAD: Final = 1.25 * math.tau
_LEFT_M: Final = 0.15
"""So much farther (m) than it should it may be, by its own odometry, until it stops."""
_FREE_M: Final = 0.05
_INTRUDER_M: Final = 0.15
"""So far (m) within the free circle something must be: where a lidar is that is not calibrated, is not known well."""
_INTRUDER_POINTS: Final = 3
_SECTORS: Final = 36
_SECTORS_SEEN: Final = 0.75
_STUCK_S: Final = 2.0
_MOVED: Final = 0.01
_READY_S: Final = 10.0
_PERIOD_S: Final = 0.05
_STOPS: Final = frozenset({ReasonCode.OBSTACLE_NEAR, ReasonCode.LIDAR_BLIND})


class _Move(NamedTuple):
    """Drive at v (m/s) and w (rad/s) until the way (m), or the heading (rad) if it turns, has come to `until`."""

    v: float
    w: float
    until: float


def _round(reach: float) -> list[_Move]:
    """Return the movements of a round for a robot whose middle stays within `reach` (m) of where it stands."""
    ahead, back = _Move(SPEED_M_S, 0.0, reach), _Move(-SPEED_M_S, 0.0, -reach)
    straight = [ahead, back, ahead, back, _Move(SPEED_M_S, 0.0, 0.0)]
    turns = [_Move(0.0, _TURN_RAD_S, _TURN_RAD), _Move(0.0, -_TURN_RAD_S, -_TURN_RAD), _Move(0.0, _TURN_RAD_S, 0.0)]
    v = _TURN_RAD_S * reach / 2.0
    arcs = [
        _Move(v, _TURN_RAD_S, math.tau), _Move(-v, -_TURN_RAD_S, 0.0),
        _Move(v, -_TURN_RAD_S, -math.tau), _Move(-v, _TURN_RAD_S, 0.0),
        _Move(-v, _TURN_RAD_S, math.tau), _Move(v, -_TURN_RAD_S, 0.0),
        _Move(-v, -_TURN_RAD_S, -math.tau), _Move(v, _TURN_RAD_S, 0.0),
    ]  # fmt: skip
    return [*straight, *turns, *arcs]


class SquareDrive:
    """Decides what a robot in a free square does next, by its own counters and scans. Pure.

    `now` is s of any monotonic clock.
    """

    def __init__(self, config: AgentConfig, square: float = SQUARE_M) -> None:
        """Plan for a robot in the middle of a free square of this side (m); raises `WrongUseError` for a small one."""
        self._config = config
        self._free = 0.5 * square
        self.reach = self._free - config.radius - _MARGIN_M
        if self.reach < _STRAIGHT_M / 2.0:
            least = 2.0 * (_STRAIGHT_M / 2.0 + config.radius + _MARGIN_M)
            raise WrongUseError(
                f"a square of {square:g} m is too small for a robot of radius {config.radius:.2f} m: "
                f"it needs --square {math.ceil(10.0 * least) / 10.0:g} at least"
            )
        self._moves = _round(self.reach)
        self._counters: tuple[float, float] | None = None
        self._way = self._turned = self._x = self._y = 0.0
        self._moved_at: tuple[float, float, float] | None = None

    @property
    def done(self) -> bool:
        """Whether the round is over."""
        return not self._moves

    def again(self) -> None:
        """Begin another round."""
        self._moves = _round(self.reach)
        self._way = self._turned = 0.0
        self._moved_at = None

    def on_counters(self, left: float, right: float) -> None:
        """Take the wheels' counters in (m)."""
        before, self._counters = self._counters, (left, right)
        if before is None:
            return
        drive = self._config.drive_train
        rolled = [
            share * wheel_travel(now, last, drive.travel_wrap_m)
            for share, now, last in zip(drive.shares, self._counters, before, strict=True)
        ]
        ahead, turned = 0.5 * sum(rolled), (rolled[1] - rolled[0]) / drive.axle_m
        self._x += ahead * math.cos(self._turned + 0.5 * turned)
        self._y += ahead * math.sin(self._turned + 0.5 * turned)
        self._way, self._turned = self._way + ahead, self._turned + turned

    def motion(self, now: float) -> tuple[float, float]:
        """Return v (m/s) and w (rad/s); zero at the end of the round."""
        while self._moves and self._reached(self._moves[0]):
            self._moves.pop(0)
            self._way = 0.0 if self._moves and self._moves[0].w else self._way
            self._moved_at = None
        if self._moved_at is None:
            self._moved_at = now, self._way, self._turned
        return (self._moves[0].v, self._moves[0].w) if self._moves else (0.0, 0.0)

    def _reached(self, move: _Move) -> bool:
        if move.w:
            return (move.until - self._turned) * move.w <= 0.0
        return (move.until - self._way) * move.v <= 0.0

    def problem(self, now: float) -> str:
        """Return why the robot must stop by its own odometry; empty if it need not."""
        if math.hypot(self._x, self._y) > self.reach + _LEFT_M:
            return f"it is {math.hypot(self._x, self._y):.2f} m from where it stood: do its wheels slip?"
        if self._moves and self._moved_at is not None:
            since, way, turned = self._moved_at
            if abs(self._way - way) > _MOVED or abs(self._turned - turned) > _MOVED:
                self._moved_at = now, self._way, self._turned
            elif now - since > _STUCK_S:
                return f"its wheels have not turned for {_STUCK_S:g} s"
        return ""

    @staticmethod
    def unseen(points: NDArray[np.float64]) -> str:
        """Return why nobody knows what is free around a robot that sees these points, as for `unfit`; else empty."""
        bearing = np.arctan2(points[:, 1], points[:, 0])
        sectors = np.unique(np.floor((bearing + math.pi) / math.tau * _SECTORS).astype(int) % _SECTORS).size
        if sectors >= _SECTORS_SEEN * _SECTORS:
            return ""
        return (
            f"its lidar sees something in {sectors} of {_SECTORS} directions only: nobody knows what is free "
            "there. Choose a place with walls within its reach"
        )

    def unfit(self, points: NDArray[np.float64], spare: float = _FREE_M) -> str:
        """Return why a robot that sees these points (n, 2; m, in its frame) must not begin; empty if it may.

        spare: m, by how much what stands around it must be farther away than the square's side.
        """
        if reason := self.unseen(points):
            return reason
        far, bearing = np.hypot(points[:, 0], points[:, 1]), np.arctan2(points[:, 1], points[:, 0])
        others = far > self._config.radius
        nearest = int(np.argmin(np.where(others, far, np.inf)))
        if far[nearest] < self._free + spare:
            side = math.degrees(float(bearing[nearest]))
            return (
                f"something stands {far[nearest]:.2f} m from it, {abs(side):.0f} degrees to the "
                f"{'left' if side >= 0.0 else 'right'}: {self._free + spare:.2f} m must be free all around"
            )
        return ""

    def disturbed(self, points: NDArray[np.float64]) -> str:
        """Return why a robot that sees these points, as for `unfit`, must not drive on; empty if it may."""
        return self.unseen(points) or self.intruder(points)

    def intruder(self, points: NDArray[np.float64]) -> str:
        """Return what has come into the free circle, by points as for `unfit`; empty if nothing has."""
        cos, sin = math.cos(self._turned), math.sin(self._turned)
        x = self._x + cos * points[:, 0] - sin * points[:, 1]
        y = self._y + sin * points[:, 0] + cos * points[:, 1]
        others = np.hypot(points[:, 0], points[:, 1]) > self._config.radius
        inside = int((others & (np.hypot(x, y) < self._free - _INTRUDER_M)).sum())
        return "something has come near" if inside >= _INTRUDER_POINTS else ""


class _Recorded:
    """What is heard of the robot, into calibration, recording and view at once."""

    def __init__(self, robot: LocalRobot, log: DriveLog) -> None:
        self.calibrator = Calibrator()
        self.view = RobotView()
        self.moved = False
        self.by_hand = False
        """Whether it has told that it is driven by hand, by this tool."""
        self._robot = robot
        self._log = log

    def poll(self) -> list[Any]:
        """Take in what has come, and return it."""
        come = self._robot.poll()
        for entry in come:
            before = self.view.base
            self.view.take(entry)
            if isinstance(entry, BaseReceived) and before is not None:
                self.moved = self.moved or entry.feedback.odometry != before.feedback.odometry
            if isinstance(entry, USED):
                self.calibrator.take(entry)
                self._log.write(entry)
        return come


def drive(path: Path, log: Path, square: float, seconds: float | None) -> Calibrator:
    """Let the robot at this socket calibrate itself, recorded into `log`, until Ctrl-C or all is known well.

    Raises `FailedError` if it must not begin, or has to stop.
    """
    with (
        LocalRobotErrors(),
        LocalRobot(path) as robot,
        DriveLog(log) as kept,
        until_told(seconds) as ends,
    ):
        heard = _Recorded(robot, kept)
        try:
            config = _ready(heard, ends)
            if config is not None:
                plan = SquareDrive(config, square)
                if reason := plan.unfit(heard.view.points()):
                    raise FailedError(f"the robot does not drive by itself: {reason}")
                _rounds(robot, heard, plan, ends)
        finally:
            with contextlib.suppress(LocalRobotError):  # without an agent nothing drives
                robot.hand_back()
            if not heard.moved:
                log.unlink(missing_ok=True)  # it holds nothing, and the next try needs its name
        return heard.calibrator


def _ready(heard: _Recorded, ends: Callable[[], bool]) -> AgentConfig | None:
    """Return the robot's configuration, once it and a scan are there; None if it is to end before."""
    until = time.monotonic() + _READY_S
    while heard.view.scan is None or heard.view.base is None or heard.view.config is None:
        if ends():
            return None
        if time.monotonic() > until:
            missing = "scan" if heard.view.scan is None else "counter of the wheels"
            raise FailedError(f"no {missing} comes within {_READY_S:g} s: see `fognav robot bringup`")
        heard.poll()
        time.sleep(_PERIOD_S)
    return heard.view.config


def _rounds(robot: LocalRobot, heard: _Recorded, plan: SquareDrive, ends: Callable[[], bool]) -> None:
    """Drive rounds until the figures are known well; raises `FailedError` when the robot has to stop.

    It stays taken over while it stands between them: so a stop by anybody ends this, and no next round undoes it.
    """
    take_over(robot)
    with ThreadPoolExecutor(1) as solver:
        for number in range(1, ROUNDS + 1):
            _drive(robot, heard, plan, lambda: plan.done or ends())
            if ends():
                return
            told, known_well = _figures(robot, heard, plan, solver, ends)
            print_line(f"round {number} of {ROUNDS}: {told}")
            if known_well or ends() or number == ROUNDS:
                return
            # It stood a while, and may have looked finished. It is some centimetres off: walls may be nearer now.
            if reason := plan.unfit(heard.view.points(), -_FREE_M):
                raise FailedError(f"the robot does not drive on by itself: {reason}")
            plan.again()


def _figures(
    robot: LocalRobot, heard: _Recorded, plan: SquareDrive, solver: ThreadPoolExecutor, ends: Callable[[], bool]
) -> tuple[str, bool]:
    """Stand until the figures are known, and a scan of now; return as `_solve` does. Raises as `_drive` does."""
    asked, before = solver.submit(_solve, heard.calibrator.snapshot()), heard.view.scan
    _drive(robot, heard, plan, lambda: (asked.done() and heard.view.scan is not before) or ends())
    return asked.result()


def _solve(calibrator: Calibrator) -> tuple[str, bool]:
    """Return how well the figures are known, in words, and whether that is well enough."""
    try:
        found = calibrator.solve()
    except CalibrationError as error:
        return str(error), False
    return bars(found), all(share >= 1.0 for _, share in known(found))


def _drive(robot: LocalRobot, heard: _Recorded, plan: SquareDrive, ends: Callable[[], bool]) -> None:
    """Drive, or stand once the round is over, until that ends; raises `FailedError` when the robot has to stop."""
    due = time.monotonic()
    while not ends():
        for entry in heard.poll():
            match entry:
                case BaseReceived():
                    plan.on_counters(entry.feedback.odometry.left_m, entry.feedback.odometry.right_m)
                case ScanReceived() if heard.by_hand and not plan.done:
                    if reason := plan.disturbed(heard.view.points()):
                        raise FailedError(f"the robot has stopped: {reason}")
                case Published() if heard.by_hand or entry.message["mode"] == "TELEOP":
                    heard.by_hand = True
                    _heed(entry.message)
        now = time.monotonic()
        if reason := plan.problem(now):
            raise FailedError(f"the robot has stopped: {reason}")
        robot.steer(*plan.motion(now))
        due = max(due + _PERIOD_S, now)
        time.sleep(max(0.0, due - time.monotonic()))


def _heed(state: dict[str, Any]) -> None:
    """Raise `FailedError` if the robot has stopped, or is kept from moving."""
    if state["mode"] != "TELEOP" or _STOPS & set(state["codes"]):
        raise FailedError(f"the robot has stopped: {'; '.join(state['reasons'])}")
