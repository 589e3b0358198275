"""Driver of a board with the diffdrive text protocol: commands as bytes, status lines as typed values, and the base.

README.md beside this file is the specification. Nothing here touches a port or a clock.
"""

from __future__ import annotations

import math
import re
from binascii import crc_hqx
from collections import deque
from dataclasses import dataclass
from enum import IntFlag
from typing import Annotated, Final

import msgspec
from msgspec import Meta

from fog_contracts.messages import Described, Power
from robot_agent.bases.diffdrive.signature import STOP
from robot_agent.hardware import Awakening, BaseFactory, BaseReading, BaseStatus, BaseTiming, DriveTrain, WheelOdometry

BAUD: Final = 115_200
LINE_BYTES_MAX: Final = 64
SPEED_MAX_MM_S: Final = 2000
COUNTS: Final = 1 << 32
"""The encoder counters wrap after so many counts."""

_LINE: Final = re.compile(rb"\$([ -#%-)+-~]*)\*([0-9A-F]{4})")
_STATUS: Final = re.compile(rb"S,(\d{1,3}),(-?\d{1,10}),(-?\d{1,10}),([0-9A-F]{4}),(\d{1,5})")


class Flag(IntFlag):
    """Bits of a status line's flags."""

    ENABLED = 1 << 0
    BUMPER_LEFT = 1 << 1
    BUMPER_RIGHT = 1 << 2
    CLIFF = 1 << 3
    WHEEL_DROP = 1 << 4
    OVERCURRENT = 1 << 5
    TIMEOUT = 1 << 6
    CHARGER = 1 << 7
    EMERGENCY_STOP = 1 << 8


@dataclass(frozen=True, slots=True)
class Status:
    """One status line: its number, encoder counts (32 bits, wrapping), flags, and battery in mV (0: not measured)."""

    number: int
    left: int
    right: int
    flags: Flag
    battery_mv: int


def line(body: bytes) -> bytes:
    """Frame a body: `$BODY*CRC` and a line feed."""
    return b"$%b*%04X\n" % (body, _crc(body))


def _crc(body: bytes) -> int:
    return crc_hqx(body, 0xFFFF)


def enable() -> bytes:
    """Switch the motors on, wheels at rest."""
    return line(b"E")


def velocity(left_mm_s: int, right_mm_s: int) -> bytes:
    """Turn the wheels at these speeds. Raises ValueError beyond +-2000 mm/s."""
    for side, speed in (("left", left_mm_s), ("right", right_mm_s)):
        if not -SPEED_MAX_MM_S <= speed <= SPEED_MAX_MM_S:
            raise ValueError(f"{side} wheel: {speed} mm/s is outside +-{SPEED_MAX_MM_S}")
    return line(b"V,%d,%d" % (left_mm_s, right_mm_s))


def wheels(left_m_s: float, right_m_s: float, speed_max_m_s: float) -> bytes:
    """Build `velocity` from m/s; beyond `speed_max_m_s` both wheels are scaled alike, which keeps the curve.

    Raises:
        ValueError: if a speed is not finite.

    """
    if not (math.isfinite(left_m_s) and math.isfinite(right_m_s)):
        raise ValueError(f"wheel speeds must be finite: left {left_m_s}, right {right_m_s} m/s")
    fastest = max(abs(left_m_s), abs(right_m_s))
    scale = 1000.0 * min(1.0, speed_max_m_s / fastest) if fastest else 0.0
    return velocity(round(left_m_s * scale), round(right_m_s * scale))


class StatusParser:
    """Bytes of the board -> status lines. Never raises, whatever the bytes are; damage affects single lines only.

    `corrupted` counts lines that were not exactly one whole, correct and new status line, except before the first good
    one: reception may start in the middle of a line.
    """

    def __init__(self) -> None:
        self._buffer = b""
        self._events: deque[Status] = deque()
        self._number: int | None = None
        self.corrupted = 0

    def receive_data(self, data: bytes) -> None:
        """Parse received bytes, in pieces of any size."""
        *lines, rest = (self._buffer + data).split(b"\n")
        # No line is longer; one byte more shows that something precedes it.
        self._buffer = rest[-LINE_BYTES_MAX:]
        for piece in lines:
            # A dollar sign begins a line, even after the rest of a line whose end got lost.
            begin = max(0, piece.rfind(b"$"))
            status = _decode(piece[begin:])
            fresh = status is not None and status.number != self._number
            if self._number is not None and (begin > 0 or not fresh):
                self.corrupted += 1
            if status is not None and fresh:
                self._number = status.number
                self._events.append(status)

    def next_event(self) -> Status | None:
        """Return the oldest status not yet returned; None until more bytes are received."""
        return self._events.popleft() if self._events else None


def _decode(text: bytes) -> Status | None:
    framed = _LINE.fullmatch(text)
    if framed is None or len(text) >= LINE_BYTES_MAX or int(framed[2], 16) != _crc(framed[1]):
        return None
    fields = _STATUS.fullmatch(framed[1])
    if fields is None:
        return None
    number, left, right, battery = (int(fields[i]) for i in (1, 2, 3, 5))
    counts_fit = all(-COUNTS // 2 <= count < COUNTS // 2 for count in (left, right))
    if number > 0xFF or battery > 0xFFFF or not counts_fit:
        return None
    return Status(number, left, right, Flag(int(fields[4], 16)), battery)


class DiffDriveFault(Described):
    """Why the board does not obey."""

    EMERGENCY_BUTTON = "emergency_button", "its emergency button is pressed"
    MOTORS_OFF = "motors_off", "its motors are switched off"


class DiffDriveOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Geometry and battery of the robot around the board; README.md beside this file lists the options."""

    counts_per_turn: Annotated[float, Meta(gt=0.0, le=1e6, description="encoder counts of one turn of a wheel")] = (
        1440.0
    )
    wheel_diameter_m: Annotated[float, Meta(ge=0.02, le=0.5, description="diameter of a driven wheel")] = 0.09
    axle_m: Annotated[float, Meta(ge=0.05, le=1.0, description="distance between the driven wheels")] = 0.28
    wheel_speed_max_m_s: Annotated[
        float, Meta(gt=0.0, le=SPEED_MAX_MM_S / 1000.0, description="top speed of a wheel")
    ] = 0.6
    deceleration_m_s2: Annotated[
        float,
        Meta(
            ge=0.2,
            le=5.0,
            description="how fast a wheel that is commanded to zero comes to rest, at least, with the heaviest load on "
            "the smoothest floor: the robot keeps its distance by it",
        ),
    ] = 1.0
    battery_empty_v: Annotated[float, Meta(ge=0.0, le=60.0, description="voltage of the empty battery")] = 10.5
    battery_full_v: Annotated[float, Meta(ge=0.0, le=60.0, description="voltage of the full battery")] = 12.6

    def __post_init__(self) -> None:
        if self.battery_full_v <= self.battery_empty_v:
            raise ValueError(
                f"battery_full_v ({self.battery_full_v}) must be above battery_empty_v ({self.battery_empty_v})"
            )


class DiffDriveDriver:
    """One board's protocol; see `robot_agent.hardware.BaseDriver`."""

    timing = BaseTiming(frame_timeout=0.3, wake_timeout=1.0, ignored_after_wake=0.1)
    awakening = Awakening(bauds=(BAUD,))

    def __init__(self, options: DiffDriveOptions) -> None:
        self._options = options
        self._parser = StatusParser()
        self._metres_per_count = math.pi * options.wheel_diameter_m / options.counts_per_turn
        self.drive_train = DriveTrain(
            axle_m=options.axle_m,
            wheel_speed_max_m_s=options.wheel_speed_max_m_s,
            travel_wrap_m=COUNTS * self._metres_per_count,
            deceleration_m_s2=options.deceleration_m_s2,
        )

    @property
    def corrupted(self) -> int:
        """Number of damaged or repeated status lines."""
        return self._parser.corrupted

    def receive_data(self, data: bytes, now: float) -> None:
        """Parse received bytes."""
        del now
        self._parser.receive_data(data)

    def next_event(self) -> BaseReading | None:
        """Return the oldest status not yet returned."""
        status = self._parser.next_event()
        if status is None:
            return None
        travel = WheelOdometry(
            left_m=status.left * self._metres_per_count, right_m=status.right * self._metres_per_count
        )
        return BaseReading(self._base_status(status), travel)

    def wake(self) -> bytes:
        """Return a line feed that ends a truncated line, zero speeds, and the command that switches the motors on."""
        return b"\n" + velocity(0, 0) + enable()

    def respond(self) -> bytes:
        """Return nothing: `wake` is all that it takes."""
        return b""

    def use_baud(self, baud: int) -> None:
        """Keep the only rate that there is."""

    def drive(self, left_m_s: float, right_m_s: float) -> bytes:
        """Return the command for these wheel speeds; beyond the top speed both are scaled, which keeps the curve."""
        return wheels(left_m_s, right_m_s, self._options.wheel_speed_max_m_s)

    def _base_status(self, status: Status) -> BaseStatus:
        flags = status.flags
        fault = _fault(flags)
        return BaseStatus(
            bumper_left=Flag.BUMPER_LEFT in flags,
            bumper_right=Flag.BUMPER_RIGHT in flags,
            cliff=Flag.CLIFF in flags,
            wheel_drop=Flag.WHEEL_DROP in flags,
            overcurrent=Flag.OVERCURRENT in flags,
            battery=self._charge(status.battery_mv),
            charging=Flag.CHARGER in flags,
            power=Power(voltage_v=status.battery_mv / 1000.0) if status.battery_mv else None,
            mode_problem=None if fault is None else fault.says,
            mode_code=fault or "",
        )

    def _charge(self, battery_mv: int) -> float | None:
        if battery_mv == 0:
            return None
        empty, full = self._options.battery_empty_v, self._options.battery_full_v
        return min(1.0, max(0.0, (battery_mv / 1000.0 - empty) / (full - empty)))


def _fault(flags: Flag) -> DiffDriveFault | None:
    if Flag.EMERGENCY_STOP in flags:
        return DiffDriveFault.EMERGENCY_BUTTON
    return None if Flag.ENABLED in flags else DiffDriveFault.MOTORS_OFF


FACTORY: Final = BaseFactory(options=DiffDriveOptions, make=DiffDriveDriver, stop=STOP)
