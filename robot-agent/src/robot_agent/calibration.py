"""How a robot's wheels and lidar really are, from what it measured while it was driven around in any room.

Method: Censi, Franchi, Marchionni and Oriolo, IEEE T-RO 29(2), 2013. The lidar's own motion between two scans, found by
matching them, is compared with what the wheels say: rotations give wheel by axle in one linear step, translations give
axle and the lidar's pose in another. Both are the start of a least-squares fit of all at once, with the time by which
scans are older than the counters. Its uncertainty is that of the fit, scaled by what the residuals really are.
"""

from __future__ import annotations

import copy
import math
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np

from fog_kernels.matching import Reference, normals
from fog_mapping.poses import between, compose
from fog_mapping.scans import Scan
from fog_mapping.trajectory import independent
from robot_agent.agent.recording.input_log import BaseReceived, ScanReceived, Started
from robot_agent.calibrated import LEVEL, NAMES, Calibration, Figure, motion_noise
from robot_agent.localization.odometry import wheel_travel

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from robot_agent.calibrated import Alphas
    from robot_agent.config import AgentConfig

    _Track = tuple[NDArray[np.float64], NDArray[np.float64]]
    """Poses of odometry, shape (n, 3), and their times (s)."""

_STEP_M: Final = 0.6
_STEP_RAD: Final = 1.0
_OVERLAP: Final = 3
"""A step begins each third of a step: so many count as one."""
_SHORTEST_S: Final = 0.3
_LONGEST_S: Final = 8.0
_SURFACE_M: Final = 0.4
_LEAST_RETURNS: Final = 60
_TURN: Final = math.radians(1.0)
_GATES: Final = np.array([0.3] * 3 + [0.15] * 4 + [0.1] * 5)
_LEAST_STEPS: Final = 20
_MIRROR_STEPS: Final = 12
_WORST_SHARE: Final = 0.02
_DEVIATIONS: Final = 4.0
_PASSES: Final = 3
_FULL_TURN: Final = 1.5 * math.pi
_STRAIGHT_M: Final = 2.0
_STRAIGHT_RAD: Final = 0.05
_TINY: Final = 1e-6
_PAUSE_S: Final = 0.25
_STOOD_M: Final = 0.005
"""Of counters that were silent for longer than that, and went on by more than this since, nobody knows by what way."""


class CalibrationError(ValueError):
    """What was recorded does not tell; the message names what is missing."""


class Driven(NamedTuple):
    """How far (m) a recording goes straight, and turns (rad) to the left and to the right."""

    straight_m: float
    left_rad: float
    right_rad: float

    def missing(self) -> list[str]:
        """Return what must be driven yet."""
        told = []
        if self.left_rad < _FULL_TURN:
            told.append(f"turn in place to the left: {self.left_rad / math.tau:.1f} of 0.75 turns are driven")
        if self.right_rad < _FULL_TURN:
            told.append(f"turn in place to the right: {self.right_rad / math.tau:.1f} of 0.75 turns are driven")
        if self.straight_m < _STRAIGHT_M:
            told.append(f"drive straight ahead or back: {self.straight_m:.1f} of {_STRAIGHT_M:g} m are driven")
        return told


class _Laser(NamedTuple):
    angles: NDArray[np.float32]
    ranges: NDArray[np.float32]
    started_at: float
    ended_at: float


class _Step(NamedTuple):
    """The lidar's motion (3,; m, m, rad) between the ends of two scans, with its information (3, 3)."""

    begin: float
    end: float
    motion: NDArray[np.float64]
    information: NDArray[np.float64]


class Calibrator:
    """Entries of an input log in, a calibration out."""

    def __init__(self) -> None:
        self.config: AgentConfig | None = None
        self._times: list[float] = []
        self._left: list[float] = [0.0]
        self._right: list[float] = [0.0]
        self._counters: tuple[float, float] | None = None
        self._scans: list[_Laser] = []
        self._breaks: list[tuple[float, float]] = []

    def snapshot(self) -> Calibrator:
        """Return one that knows what this one knows now, to solve on another thread while this one takes more in."""
        copied = copy.copy(self)
        for name in ("_times", "_left", "_right", "_scans", "_breaks"):
            setattr(copied, name, list(getattr(self, name)))
        return copied

    def take(self, entry: Any) -> None:  # noqa: ANN401  # of any kind
        """Take an entry in."""
        match entry:
            case Started():
                self.config = entry.config
            case BaseReceived() if self.config is not None:
                self._on_counters(entry, self.config.drive_train.travel_wrap_m)
            case ScanReceived() if self.config is not None:
                scan = entry.scan()
                lidar = self.config.localization
                seen = (scan.ranges_m >= lidar.range_min) & (scan.ranges_m <= lidar.range_max)
                ranges = np.where(seen, scan.ranges_m, np.nan).astype(np.float32)
                angles = np.asarray(scan.angles_rad, np.float32)
                self._scans.append(_Laser(angles, ranges, scan.started_at, scan.ended_at))

    def _on_counters(self, entry: BaseReceived, wrap: float) -> None:
        counters = (entry.feedback.odometry.left_m, entry.feedback.odometry.right_m)
        before, self._counters = self._counters, counters
        if before is None:
            self._times.append(entry.now)
            return
        if entry.now <= self._times[-1]:
            self._counters = before  # the next one has this travel, too
            return
        left, right = (wheel_travel(now, last, wrap) for now, last in zip(counters, before, strict=True))
        if entry.now - self._times[-1] > _PAUSE_S and max(abs(left), abs(right)) > _STOOD_M:
            self._breaks.append((self._times[-1], entry.now))
        self._times.append(entry.now)
        self._left.append(self._left[-1] + left)
        self._right.append(self._right[-1] + right)

    @property
    def start(self) -> NDArray[np.float64]:
        """What the robot's settings say (7,), by `NAMES`; raises `CalibrationError` without them."""
        if self.config is None:
            raise CalibrationError(
                "the recording does not begin with a robot's settings: record with fognav map record"
            )
        lidar, drive = self.config.localization, self.config.drive_train
        return np.array((*drive.shares, drive.axle_m, lidar.lidar_x, lidar.lidar_y, lidar.lidar_yaw, 0.0))

    def driven(self) -> Driven:
        """Return what has been driven, by the robot's settings."""
        if self.config is None or len(self._times) < 2:
            return Driven(0.0, 0.0, 0.0)
        axle = self.config.drive_train.axle_m
        every = max(1, len(self._times) // max(1, round(self._times[-1] - self._times[0]) * 2))
        left, right = np.diff(np.array(self._left)[::every]), np.diff(np.array(self._right)[::every])
        turned, ahead = (right - left) / axle, 0.5 * (left + right)
        straight = np.abs(ahead)[np.abs(turned) < _STRAIGHT_RAD].sum()
        return Driven(float(straight), float(turned[turned > 0].sum()), float(-turned[turned < 0].sum()))

    def solve(self) -> Calibration:
        """Return what the recording tells; raises `CalibrationError` where it tells too little."""
        if missing := self.driven().missing():
            raise CalibrationError(f"this can't be told yet: {'; '.join(missing)}")
        guess, mirrored = self.start, self._is_mirrored()
        steps: list[_Step] = []
        found = guess, np.eye(7), steps
        for number in range(_PASSES):
            steps = self._steps(guess, mirrored=mirrored, wide=number == 0)
            if len(steps) < _LEAST_STEPS:
                raise CalibrationError(
                    f"only {len(steps)} pairs of scans fit each other, {_LEAST_STEPS} are needed: drive where walls "
                    "are within the lidar's reach, and keep people away"
                )
            if number == 0:
                guess = self._closed_form(steps, guess)
            found = self._fit(steps, guess)
            guess = found[0]
        values, covariance, used = found
        errors = self._residuals(used, values)
        metres, radians = (float(np.sqrt((e**2).sum(axis=1).mean())) for e in (errors[:, :2], errors[:, 2:]))
        halves = LEVEL * np.sqrt(np.diag(covariance))
        figures = {name: Figure(float(v), float(h)) for name, v, h in zip(NAMES, values, halves, strict=True)}
        return Calibration(figures, mirrored, len(used), metres, radians, self._noise(steps, values))

    def _noise(self, steps: Sequence[_Step], values: NDArray[np.float64]) -> Alphas:
        """Return the noise of the wheels by all of the lidar's motions: those that fit worst are where wheels slip."""
        assert self.config is not None
        track, mount = self._track(values), values[3:6]
        begins, ends = (self._at(track, np.array([getattr(step, name) for step in steps])) for name in ("begin", "end"))
        off = compose(compose(mount, self._residuals(steps, values)), between(mount, np.zeros(3)))
        return motion_noise(between(begins, ends), off, self.config.localization)

    def end_error(self, values: NDArray[np.float64], *, mirrored: bool) -> tuple[float, float, float]:
        """Return how far (m, rad) the wheels are off at the end of this drive by its scans, and how long (m) it is.

        It must end where it began, as Borenstein and Feng's square does: raises `CalibrationError` where the last scan
        does not show the place of the first.
        """
        track = self._track(values)
        ends = [
            number for number, scan in enumerate(self._scans) if self._times[0] + 0.5 < scan.ended_at < self._times[-1]
        ]
        pair = (
            [self._scan(self._scans[n], track, values[3:6], mirrored=mirrored) for n in (ends[0], ends[-1])]
            if ends
            else []
        )
        if not pair or pair[0] is None or pair[1] is None:
            raise CalibrationError("this drive has no two scans that show anything")
        if self._breaks:
            begin, end = (at - self._times[0] for at in self._breaks[0])
            raise CalibrationError(
                f"the wheels were not heard from {begin:.1f} s to {end:.1f} s of this drive: record it again"
            )
        reference = Reference(pair[0].points, pair[0].normals)
        guess = between(pair[0].odometry, pair[1].odometry)
        hit = reference.search(pair[1].points, (0.0, 0.0, float(guess[2])), 0.5, 0.5, _TURN, 0.5)
        if hit is None:
            raise CalibrationError(
                "this drive does not end where it began, by its scans: drive a square back to its start"
            )
        ends_at = reference.align(pair[1].points, pair[1].normals, hit.pose, hit.pose, np.eye(3), _GATES)
        off = between(np.array(ends_at.pose), guess)
        poses = track[0]
        length = float(np.hypot(*np.diff(poses[:, :2], axis=0).T).sum())
        return math.hypot(off[0], off[1]), abs(float(off[2])), length

    # --- odometry by a set of parameters ---

    def _track(self, values: NDArray[np.float64]) -> _Track:
        """Return the poses (n, 3) of the robot at the times of the counters, and these times as scans have them."""
        left, right = values[0] * np.diff(self._left), values[1] * np.diff(self._right)
        turned, ahead = (right - left) / values[2], 0.5 * (left + right)
        theta = np.concatenate(([0.0], np.cumsum(turned)))
        middle = theta[:-1] + 0.5 * turned
        x = np.concatenate(([0.0], np.cumsum(ahead * np.cos(middle))))
        y = np.concatenate(([0.0], np.cumsum(ahead * np.sin(middle))))
        return np.column_stack((x, y, theta)), np.array(self._times) + values[6]

    @staticmethod
    def _at(track: _Track, times: NDArray[np.float64]) -> NDArray[np.float64]:
        poses, stamps = track
        return np.column_stack([np.interp(times, stamps, poses[:, column]) for column in range(3)])

    def _scan(self, laser: _Laser, track: _Track, mount: NDArray[np.float64], *, mirrored: bool) -> Scan | None:
        """Return a scan without skew, in the lidar's frame at its end; None if it shows little."""
        count = len(laser.angles)
        times = laser.started_at + (laser.ended_at - laser.started_at) * np.arange(1, count + 1) / count
        seen = np.isfinite(laser.ranges)
        if int(seen.sum()) < _LEAST_RETURNS:
            return None
        at = compose(self._at(track, times[seen]), mount)
        end = compose(self._at(track, np.array([laser.ended_at]))[0], mount)
        angles = (-1.0 if mirrored else 1.0) * laser.angles[seen].astype(np.float64)
        ranges = laser.ranges[seen].astype(np.float64)
        seen_at = np.column_stack((ranges * np.cos(angles), ranges * np.sin(angles), np.zeros(len(angles))))
        points = between(end, compose(at, seen_at))[:, :2]
        order = np.argsort(np.arctan2(points[:, 1], points[:, 0]), kind="stable")
        points = np.ascontiguousarray(points[order])
        return Scan(0, points, normals(points, _SURFACE_M), end)

    # --- the lidar's own motions ---

    def _pairs(self, track: _Track) -> list[tuple[int, int]]:
        ends = np.array([scan.ended_at for scan in self._scans])
        breaks = np.reshape(self._breaks, (-1, 2))
        stretch = np.searchsorted(breaks[:, 1], [scan.started_at for scan in self._scans], side="right")
        whole = stretch == np.searchsorted(breaks[:, 0], ends)
        inside = (ends > self._times[0] + 0.5) & (ends < self._times[-1]) & whole
        poses = self._at(track, ends)
        numbers = np.flatnonzero(inside).tolist()
        pairs, last = [], None
        for place, begin in enumerate(numbers):
            if last is not None and not _far(poses[last], poses[begin], 1.0 / _OVERLAP):
                continue
            last = begin
            for number in numbers[place + 1 :]:
                if ends[number] - ends[begin] > _LONGEST_S or stretch[number] != stretch[begin]:
                    break
                if ends[number] - ends[begin] >= _SHORTEST_S and _far(poses[begin], poses[number], 1.0):
                    pairs.append((begin, number))
                    break
        return pairs

    def _steps(self, values: NDArray[np.float64], *, mirrored: bool, wide: bool) -> list[_Step]:
        track, mount = self._track(values), values[3:6]
        scans: dict[int, Scan | None] = {}
        steps = []
        for pair in self._pairs(track):
            for number in pair:
                if number not in scans:
                    scans[number] = self._scan(self._scans[number], track, mount, mirrored=mirrored)
            first, second = (scans[number] for number in pair)
            if first is None or second is None:
                continue
            guess = between(first.odometry, second.odometry)
            motion = _matched(first, second, guess, wide=wide)
            if motion is not None:
                begin, end = (self._scans[number].ended_at for number in pair)
                steps.append(_Step(begin, end, *motion))
        return steps

    def _is_mirrored(self) -> bool:
        """Return whether the scans turn one way where the wheels turn the other."""
        values = self.start
        track, votes, asked = self._track(values), 0, 0
        for first, second in self._pairs(track):
            turned = float(
                self._at(track, np.array([self._scans[n].ended_at for n in (first, second)]))[:, 2] @ (-1, 1)
            )
            if abs(turned) < 0.5 * _STEP_RAD:
                continue
            pair = [self._scan(self._scans[n], track, values[3:6], mirrored=False) for n in (first, second)]
            if pair[0] is None or pair[1] is None:
                continue
            reference = Reference(pair[0].points, pair[0].normals)
            scores = []
            for turn in (turned, -turned):
                hit = reference.search(pair[1].points, (0.0, 0.0, turn), 0.2, 0.3 * abs(turned), _TURN, 0.0)
                scores.append(0.0 if hit is None else hit.score)
            votes += scores[1] > scores[0]
            asked += 1
            if asked == _MIRROR_STEPS:
                break
        return 2 * votes > asked

    # --- the fit ---

    def _closed_form(self, steps: Sequence[_Step], start: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return Censi's solution: wheels by axle from rotations, then axle and the lidar's pose from translations."""
        stamps = np.array(self._times)
        begins, ends = (np.array([getattr(step, name) for step in steps]) for name in ("begin", "end"))
        left, right = (
            np.interp(ends, stamps, travel) - np.interp(begins, stamps, travel)
            for travel in (np.array(self._left), np.array(self._right))
        )
        turned = np.array([step.motion[2] for step in steps])
        by_axle, *_ = np.linalg.lstsq(np.column_stack((-left, right)), turned, rcond=None)
        unit = start.copy()
        unit[:3] = by_axle[0], by_axle[1], 1.0
        track = self._track(unit)
        rows, sides = [], []
        for step, begin, end in zip(steps, self._at(track, begins), self._at(track, ends), strict=True):
            moved = between(begin, end)
            cos, sin = math.cos(moved[2]), math.sin(moved[2])
            rows.append(np.array([[moved[0], cos - 1.0, -sin], [moved[1], sin, cos - 1.0]]))
            sides.append(np.array([[step.motion[0], -step.motion[1]], [step.motion[1], step.motion[0]]]))
        known, seen = np.concatenate(rows), np.concatenate(sides)
        solved = np.linalg.pinv(known) @ seen
        heading = np.linalg.svd(seen - known @ solved)[2][-1]
        axle, x, y = solved @ heading
        if axle < 0.0:
            heading, axle, x, y = -heading, -axle, -x, -y
        yaw = math.atan2(heading[1], heading[0])
        return np.array((by_axle[0] * axle, by_axle[1] * axle, axle, x, y, yaw, start[6]))

    def _residuals(self, steps: Sequence[_Step], values: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return by how much (n, 3) the lidar's motions by scans differ from those that the wheels say."""
        track = self._track(values)
        begins, ends = (np.array([getattr(step, name) for step in steps]) for name in ("begin", "end"))
        expected = between(compose(self._at(track, begins), values[3:6]), compose(self._at(track, ends), values[3:6]))
        return between(expected, np.array([step.motion for step in steps]))

    def _fit(
        self, steps: Sequence[_Step], start: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], list[_Step]]:
        """Return values (7,), covariance (7, 7) and the steps that were used, without the worst."""
        values, used = start.copy(), list(steps)
        scales = np.array((1.0, 1.0, 1.0, 0.1, 0.1, 0.1, 0.05))
        normal = np.eye(7)
        for round_ in range(8):
            roots = np.array([np.linalg.cholesky(step.information + 1e-3 * np.eye(3)).T for step in used])
            errors = self._residuals(used, values)
            white = np.einsum("nij,nj->ni", roots, errors)
            slopes = np.empty((len(used), 3, 7))
            for column, scale in enumerate(scales):
                nudged = values.copy()
                nudged[column] += 1e-4 * scale
                slopes[:, :, column] = (self._residuals(used, nudged) - errors) / 1e-4
            white_slopes = np.einsum("nij,njk->nik", roots, slopes).reshape(-1, 7)
            # What residuals really are: matches err more than they say, and wheels slip.
            spread = 1.4826 * float(np.median(np.abs(white)))
            normal = white_slopes.T @ white_slopes / (_OVERLAP * spread**2)
            if np.linalg.cond(normal) > 1e12:
                raise CalibrationError(
                    "the drive does not tell wheels, axle and lidar apart: drive arcs to both sides, too"
                )
            change = -np.linalg.solve(normal, white_slopes.T @ white.ravel() / (_OVERLAP * spread**2)) * scales
            values = values + change
            if round_ >= 2:
                far = np.linalg.norm(white, axis=1)
                keep = far <= min(np.quantile(far, 1.0 - _WORST_SHARE), _DEVIATIONS * spread * math.sqrt(3.0))
                if round_ == 2:
                    used = [step for step, kept in zip(used, keep, strict=True) if kept]
            elif np.abs(change / scales).max() < _TINY:
                continue
        return values, np.asarray(np.linalg.inv(normal) * np.outer(scales, scales), np.float64), used


def _far(one: NDArray[np.float64], other: NDArray[np.float64], share: float) -> bool:
    """Return whether two poses are this share of a step apart."""
    moved = between(one, other)
    return math.hypot(moved[0], moved[1]) >= share * _STEP_M or abs(float(moved[2])) >= share * _STEP_RAD


def _matched(
    first: Scan, second: Scan, guess: NDArray[np.float64], *, wide: bool
) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return the motion (3,) between two scans and its information (3, 3); None if they do not fit."""
    moved, turned = math.hypot(guess[0], guess[1]), abs(float(guess[2]))
    reference = Reference(first.points, first.normals)
    half = moved + 0.15 if wide else 0.05 + 0.1 * moved
    half_turn = 0.08 + (0.3 if wide else 0.05) * turned
    hit = reference.search(second.points, tuple(guess), half, half_turn, _TURN, 0.3)
    if hit is None:
        return None
    aligned = reference.align(second.points, second.normals, hit.pose, hit.pose, np.eye(3), _GATES)
    information = independent(aligned.information)
    if np.linalg.eigvalsh(information)[0] < 1.0:
        return None
    return np.array(aligned.pose), information
