"""The stop field: how fast the robot may go along its arc and still come to rest before what its lidar sees.

It knows neither map nor path nor who commands, so it holds whatever they say. Guided by the speed and separation rules
of ISO 13482 and ISO 3691-4, and Nav2's collision monitor ("approach"), without claiming conformity. Pure.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from fog_contracts.messages import Reason, ReasonCode
from fog_kernels.sweep import first_contact, half_planes

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from robot_agent.config import StopFieldConfig
    from robot_agent.footprint import Footprint
    from robot_agent.hardware import DriveTrain

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
