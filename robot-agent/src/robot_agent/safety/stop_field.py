"""How fast the robot may go along its arc: it must come to rest before what its lidar sees, and see what is there.

The stop field knows neither map nor path nor who commands, so it holds whatever they say. Guided by the speed and
separation rules of ISO 13482 and ISO 3691-4, and Nav2's collision monitor ("approach"), without claiming conformity.

What the lidar does not see is not free. Glass, black surfaces and a blind lidar all give no return. Open space gives
none either, so the map decides: only where it has a wall within a safe range is a missing return suspicious. Directions
that the lidar does not measure at all, by its mask or by a defect, are blind whatever the map says. Pure.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

import numpy as np

from fog_contracts.messages import Reason, ReasonCode
from fog_kernels.sweep import first_contact, half_planes
from robot_agent.footprint import SECTORS

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robot_agent.config import StopFieldConfig, VisibilityConfig
    from robot_agent.footprint import Footprint
    from robot_agent.hardware import DriveTrain, Twist

Wheels = tuple[float, float]
"""Speeds of the left and the right wheel, m/s."""


Zone = Literal["free", "slow", "stop"]


class Limited(NamedTuple):
    """Wheel speeds that may be commanded, the zone that decided them, and why the robot must stand (else None)."""

    wheels: Wheels
    zone: Zone = "free"
    reason: Reason | None = None


_ROUND_M: Final = 0.002
"""A footprint whose corners stand out by less is round: turning in place brings it nearer to nothing."""
_IN_PLACE_SHARE: Final = 0.05
"""Wheels whose mean is less than this share of their turning part mean to turn in place."""
_TOLERANCE_M: Final = 1e-6


def turn_in_place(wheels: Wheels) -> Wheels | None:
    """Return the turn without any advance, if these wheel speeds mean to turn in place; None for an arc.

    Judged by the ratio of the wheels, not by a speed: from rest every arc begins slowly.
    """
    turning = 0.5 * (wheels[1] - wheels[0])
    if abs(0.5 * (wheels[0] + wheels[1])) >= _IN_PLACE_SHARE * abs(turning):
        return None
    return -turning, turning


class StopField:
    """The stop field of one robot: its footprint, and how its base brakes."""

    def __init__(self, footprint: Footprint, drive: DriveTrain, config: StopFieldConfig) -> None:
        self._body = half_planes(footprint.polygon)
        self._drive = drive
        self._config = config
        self._round = footprint.circumscribed_radius - footprint.inscribed_radius < _ROUND_M

    @property
    def reach(self) -> float:
        """Distance (m) from the body's origin beyond which no point matters, at the base's top speed."""
        speed = self._drive.wheel_speed_max_m_s
        return self._body.radius + self._body.mitre * self._config.margin + speed * self._braking_time(speed)

    def limit(self, wheels: Wheels, points: NDArray[np.float64]) -> Limited:
        """Limit wheel speeds so that the robot can stop before contact; the ratio of the wheels, its arc, is kept.

        points: (n, 2) m in `base`, what the lidar sees now. Slow zone: a command acts for the reaction time, then the
        base brakes, and both together end `margin` before the first contact along the arc. Stop zone: zero, when
        nothing faster than `slowest` could. What is within the margin already must not come nearer at all, so the
        errors of single ranges can't lead the robot on by small steps.
        """
        fastest = max(abs(wheels[0]), abs(wheels[1]))
        if fastest == 0.0:
            return Limited(wheels)
        v, w = self._drive.twist(*wheels)
        config, needed = self._config, self._braking_time(fastest)
        contact, index = first_contact(
            points,
            self._body,
            v,
            w,
            horizon=min(needed, math.tau / abs(w) if w else math.inf),
            margin=config.margin,
            tolerance=_TOLERANCE_M,
        )
        if index < 0:
            return Limited(wheels)
        turning = turn_in_place(wheels) if self._round else None
        if turning is not None:
            return Limited(turning)
        share = self._share(fastest, contact)
        if share * fastest < config.slowest:
            reason = f"the lidar sees an obstacle {_side(points[index])}, too near to drive on"
            return Limited((0.0, 0.0), "stop", Reason(ReasonCode.OBSTACLE_NEAR, reason))
        return Limited((wheels[0] * share, wheels[1] * share), "slow")

    def _braking_time(self, fastest: float) -> float:
        """Return how long (s) the body moves on, in time at the commanded speed, until it rests."""
        return self._config.reaction + fastest / (2.0 * self._drive.deceleration_m_s2)

    def _share(self, fastest: float, contact: float) -> float:
        """Return the largest share k of the speed that rests before a contact `contact` s away at full speed.

        At k times the speed the body needs k reaction + k^2 braking, both in s at full speed.
        """
        reaction, braking = self._config.reaction, fastest / (2.0 * self._drive.deceleration_m_s2)
        return 2.0 * contact / (reaction + math.sqrt(reaction * reaction + 4.0 * braking * contact))


def _side(point: NDArray[np.float64]) -> str:
    """Return the side of the robot on which a point in `base` is."""
    bearing = math.degrees(math.atan2(point[1], point[0]))
    return ("behind", "to the right", "ahead", "to the left", "behind")[round((bearing + 180.0) / 90.0)]


_EXPECTED_MIN: Final = 4
"""With fewer sectors in which a return is expected, their share says nothing."""
_LEAD_MAX_RAD: Final = math.radians(45.0)
_LEAD_S: Final = 0.5
"""A turning robot travels into the direction in which it will head after half of this."""

_Sight = Literal["clear", "poor", "blind"]


def sector_of(angles: NDArray[np.float64]) -> NDArray[np.int64]:
    """Return the sector of each direction (n; rad in `base`)."""
    turns = np.asarray(angles) / math.tau + 0.5
    sectors: NDArray[np.int64] = np.floor((turns - np.floor(turns)) * SECTORS).astype(np.int64) % SECTORS
    return sectors


SECTOR_ANGLES: Final = np.array([(sector + 0.5) * math.tau / SECTORS - math.pi for sector in range(SECTORS)])
"""The middle (rad, in `base`) of each sector."""
SECTOR_ANGLES.setflags(write=False)


def _running_counts(sectors: NDArray[np.bool_]) -> list[int]:
    """Return how many of the first n sectors are True, for n from 0 to twice their number: the circle, twice around."""
    return [0, *np.cumsum(np.concatenate((sectors, sectors))).tolist()]


class Visibility:
    """Which sectors the newest scans cover, and how fast the robot may travel into them."""

    def __init__(self, config: VisibilityConfig) -> None:
        self._config = config
        self._blind = self._missing = self._expected = _running_counts(np.zeros(SECTORS, np.bool_))
        self._returned_before = np.ones(SECTORS, np.bool_)
        self._measured_before = np.ones(SECTORS, np.bool_)
        self._sight: _Sight = "clear"

    def update(self, angles: NDArray[np.float64], returned: NDArray[np.bool_], expected: NDArray[np.bool_]) -> None:
        """Handle a whole scan: directions of its samples (n; rad in `base`), and which of them have a return.

        expected: (SECTORS,) whether the map has a wall near in a sector. A sector is covered if it was in this scan or
        in the one before it: single scans have gaps.
        """
        sectors = sector_of(angles)
        measured = np.bincount(sectors, minlength=SECTORS)
        returns = np.bincount(sectors[returned], minlength=SECTORS)
        has_returns = (measured > 0) & (2 * returns >= measured)
        seen = (measured > 0) | self._measured_before
        expected = expected & seen
        # The direction of travel is asked for at each command, many times for each scan.
        self._blind, self._expected = _running_counts(~seen), _running_counts(expected)
        self._missing = _running_counts(expected & ~(has_returns | self._returned_before))
        self._returned_before, self._measured_before = has_returns, measured > 0

    def limit(self, wheels: Wheels, twist: Twist) -> Limited:
        """Limit wheel speeds, whose twist is given, by what is seen in the direction of travel; the arc is kept.

        Turning in place is allowed, without the little advance that a command for it may have: it is how a robot looks
        elsewhere. Slowness alone allows nothing, since slow steps add up.
        """
        if twist.v == 0.0:
            return Limited(wheels)
        lead = min(max(0.5 * _LEAD_S * twist.w, -_LEAD_MAX_RAD), _LEAD_MAX_RAD)
        heading = lead if twist.v > 0.0 else math.pi - lead
        sight, turning = self._sight_towards(heading), turn_in_place(wheels)
        if turning is not None:
            return Limited(turning if sight == "blind" else wheels)
        self._sight = sight
        if sight == "blind":
            side = "ahead" if twist.v > 0.0 else "behind"
            reason = f"the lidar sees nothing {side}: it is blind there, or faces glass"
            return Limited((0.0, 0.0), "stop", Reason(ReasonCode.LIDAR_BLIND, reason))
        if sight == "poor" and abs(twist.v) > self._config.speed:
            share = self._config.speed / abs(twist.v)
            return Limited((wheels[0] * share, wheels[1] * share), "slow")
        return Limited(wheels)

    def _sight_towards(self, heading: float) -> _Sight:
        config = self._config
        # Sectors whose middle is within `half_width` of the heading: those from `first` up to `end`, without it.
        middle, half = (heading / math.tau + 0.5) * SECTORS - 0.5, config.half_width / math.tau * SECTORS
        first = math.ceil(middle - half)
        begin = first % SECTORS
        end = begin + math.floor(middle + half) + 1 - first
        blind = (self._blind[end] - self._blind[begin]) / (end - begin)
        expected = self._expected[end] - self._expected[begin]
        missing = (self._missing[end] - self._missing[begin]) / expected if expected >= _EXPECTED_MIN else 0.0
        # A limit that applies is lifted only well below the share at which it began.
        refuse = config.lift if self._sight == "blind" else 1.0
        slow = 1.0 if self._sight == "clear" else config.lift
        if blind >= refuse * config.blind_refused or missing >= refuse * config.missing_refused:
            return "blind"
        if blind >= slow * config.blind_slow or missing >= slow * config.missing_slow:
            return "poor"
        return "clear"
