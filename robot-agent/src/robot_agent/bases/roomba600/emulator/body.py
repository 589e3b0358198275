"""The emulated robot's body: what its sensors touch, its battery, and its wheels with motors and encoders."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

TICKS_PER_TURN: Final = 508.8
WHEEL_DIAMETER_M: Final = 0.072
AXLE_MM: Final = 235.0
SPEED_MAX_MM_S: Final = 500
RADIUS_MAX_MM: Final = 2000
_PWM_MAX: Final = 255
_STRAIGHT: Final = frozenset((-32768, 32767, 0))
"""Radii of Drive that mean straight ahead."""
WHEEL_MA_PER_M_S: Final = 600.0
_IDLE_MA: Final = 180.0
_CHARGE_MA: Final = 1250.0
_TRICKLE_MA: Final = 60.0


@dataclass(slots=True)
class World:
    """State of the robot's sensors; the simulation sets it at any time."""

    bump_left: bool = False
    bump_right: bool = False
    wheel_drop_left: bool = False
    wheel_drop_right: bool = False
    cliff_left: bool = False
    cliff_front_left: bool = False
    cliff_front_right: bool = False
    cliff_right: bool = False
    virtual_wall: bool = False
    overcurrent_left: bool = False
    overcurrent_right: bool = False
    home_base: bool = False
    charger: bool = False
    temperature_c: int = 24
    light_signals: tuple[int, int, int, int, int, int] = (0, 0, 0, 0, 0, 0)

    @property
    def wheel_drop(self) -> bool:
        """Any wheel hangs."""
        return self.wheel_drop_left or self.wheel_drop_right

    @property
    def cliffs(self) -> tuple[bool, bool, bool, bool]:
        """No floor under each of the cliff sensors, from left to right."""
        return self.cliff_left, self.cliff_front_left, self.cliff_front_right, self.cliff_right

    @property
    def cliff(self) -> bool:
        """No floor under any of the four cliff sensors."""
        return any(self.cliffs)

    @property
    def powered(self) -> bool:
        """A charger, or the dock's contacts, give power."""
        return self.home_base or self.charger


@dataclass(slots=True)
class Battery:
    """A NiMH pack of twelve cells: an open-circuit voltage over the charge, minus the drop over the inner resistance.

    The constants are round figures for a 14.4 V pack; they bring a robot from full to empty in three to six hours.
    """

    capacity_mah: float = 2600.0
    charge_mah: float = 2400.0
    current_ma: float = 0.0
    resistance_ohm: float = 0.25

    def use(self, current_ma: float, dt: float) -> None:
        """Charge or discharge with a current (mA, positive into the pack) for dt seconds."""
        self.current_ma = current_ma
        self.charge_mah = min(self.capacity_mah, max(0.0, self.charge_mah + current_ma * dt / 3600.0))

    @property
    def voltage_mv(self) -> int:
        """Voltage at the contacts, mV: flat in the middle, steep where the pack is nearly empty."""
        level = self.charge_mah / self.capacity_mah
        open_circuit = 14.0 + 2.0 * level - 2.5 * math.exp(-20.0 * level)
        return round(1000.0 * open_circuit + self.resistance_ohm * self.current_ma)

    @property
    def full(self) -> bool:
        """The charger only keeps the charge."""
        return self.charge_mah >= 0.99 * self.capacity_mah

    def tick(self, dt: float, *, powered: bool, wheels_m_s: float) -> None:
        """Charge, or feed electronics and motors (sum of the wheels' speeds, m/s), for dt seconds."""
        if powered:
            self.use(_TRICKLE_MA if self.full else _CHARGE_MA, dt)
        else:
            self.use(-_IDLE_MA - WHEEL_MA_PER_M_S * wheels_m_s, dt)


class Wheels:
    """Two driven wheels. The motors keep their last speeds until they get others."""

    def __init__(self, left_encoder: int, right_encoder: int) -> None:
        """Stand still, with the encoders at these readings."""
        self.left_mm_s = self.right_mm_s = 0
        self.requested = (0, 0)
        """Velocity (mm/s) and radius (mm) of the last Drive; zeros after any other command."""
        self._ticks = [float(left_encoder), float(right_encoder)]
        self._distance_mm = 0.0
        self._angle_deg = 0.0

    def stop(self) -> None:
        """Stop both motors."""
        self.left_mm_s = self.right_mm_s = 0
        self.requested = (0, 0)

    def drive(self, speed: int, radius: int) -> None:
        """Drive (opcode 137): the robot's speed (mm/s) on a circle (radius in mm, positive to the left)."""
        speed_mm_s = clamp(speed, SPEED_MAX_MM_S)
        if radius in _STRAIGHT:
            left = right = speed_mm_s
        elif radius in {-1, 1}:
            left, right = -radius * speed_mm_s, radius * speed_mm_s
        else:
            half = AXLE_MM / 2.0 / clamp(radius, RADIUS_MAX_MM)
            left = clamp(round(speed_mm_s * (1.0 - half)), SPEED_MAX_MM_S)
            right = clamp(round(speed_mm_s * (1.0 + half)), SPEED_MAX_MM_S)
        self.left_mm_s, self.right_mm_s = left, right
        self.requested = (speed_mm_s, radius)

    def drive_direct(self, right: int, left: int) -> None:
        """Drive Direct (opcode 145): the speed (mm/s) of each wheel."""
        self.right_mm_s, self.left_mm_s = clamp(right, SPEED_MAX_MM_S), clamp(left, SPEED_MAX_MM_S)
        self.requested = (0, 0)

    def drive_pwm(self, right: int, left: int) -> None:
        """Drive PWM (opcode 146): the share of each motor's full power, -255 to 255."""
        right, left = (round(clamp(pwm, _PWM_MAX) / _PWM_MAX * SPEED_MAX_MM_S) for pwm in (right, left))
        self.drive_direct(right, left)

    def roll(self, left_m: float, right_m: float) -> None:
        """Roll the wheels this far (m); fractions of a tick accumulate."""
        per_metre = TICKS_PER_TURN / (math.pi * WHEEL_DIAMETER_M)
        self._ticks[0] += left_m * per_metre
        self._ticks[1] += right_m * per_metre
        self._distance_mm += 500.0 * (left_m + right_m)
        self._angle_deg += math.degrees((right_m - left_m) * 1000.0 / AXLE_MM)

    @property
    def encoders(self) -> tuple[int, int]:
        """(left, right) encoder readings, 16 bit."""
        return self.encoder(0), self.encoder(1)

    def encoder(self, wheel: int) -> int:
        """Return the reading (16 bit) of the left (0) or right (1) wheel's encoder."""
        ticks = self._ticks[wheel]
        return math.floor(ticks) & 0xFFFF

    def reset_encoders(self) -> None:
        """Count from zero."""
        self._ticks = [0.0, 0.0]

    def take_distance(self) -> int:
        """Return the distance (whole mm) travelled since the last call."""
        whole, self._distance_mm = _whole(self._distance_mm)
        return whole

    def take_angle(self) -> int:
        """Return the angle (whole degrees, counter-clockwise) turned since the last call."""
        whole, self._angle_deg = _whole(self._angle_deg)
        return whole


def clamp(value: int, most: int) -> int:
    """Limit a value to -most..most."""
    return max(-most, min(most, value))


def _whole(amount: float) -> tuple[int, float]:
    """Split an accumulated amount into whole units, which are reported once, and the rest."""
    whole = max(-0x8000, min(0x7FFF, math.trunc(amount)))
    return whole, amount - math.trunc(amount)
