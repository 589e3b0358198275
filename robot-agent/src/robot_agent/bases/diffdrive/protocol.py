"""The diffdrive text protocol: commands as bytes, status lines as typed values.

README.md beside this file is the specification. Nothing here touches a port or a clock.
"""

from __future__ import annotations

import math
import re
from binascii import crc_hqx
from collections import deque
from dataclasses import dataclass
from enum import IntFlag
from typing import Final

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
