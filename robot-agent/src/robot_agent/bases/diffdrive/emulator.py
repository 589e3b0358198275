"""Emulator of a diffdrive board at its serial port.

Pure: bytes, times and the state of the world go in, bytes and wheel speeds come out. It is written from README.md
beside this file and shares no code with the driver.
"""

from __future__ import annotations

import math
from typing import Final

BAUD: Final = 115_200
COUNTS_PER_TURN: Final = 1440
WHEEL_DIAMETER_M: Final = 0.09
AXLE_M: Final = 0.28
SPEED_LIMIT_MM_S: Final = 2000
STATUS_S: Final = 0.02
TIMEOUT_S: Final = 0.3
_LINE_LIMIT: Final = 64
# After a pause of the host or the simulation, missed status lines are not sent in a burst.
_CATCH_UP_LINES: Final = 20
_IDLE_A: Final = 0.3
_WHEEL_A_PER_M_S: Final = 1.5


class DiffDriveEmulator:
    """The board's end of the serial line; implements `fognav_sim.emulators.BaseEmulator`.

    The simulation sets the public attributes at any time. `refused` counts lines that were no valid command.
    """

    def __init__(self) -> None:
        """Switch the board on, with its motors off and its counters at zero."""
        self.bump_left = self.bump_right = False
        self.cliff = self.wheel_drop = self.overcurrent = self.charger = False
        self.emergency_button = False
        self.timeout_s = TIMEOUT_S
        self.battery_mv = 12_300.0
        self.enabled = False
        self.timed_out = False
        self.refused = 0
        self._speeds_mm_s = (0, 0)
        self._counts = [0.0, 0.0]
        self._commanded_at = -math.inf
        self._incoming = b""
        self._outgoing = b""
        self._number = 0
        self._next_status: float | None = None

    @property
    def baud(self) -> int:
        """Speed of the serial line."""
        return BAUD

    @property
    def axle_m(self) -> float:
        """Distance between the wheels' tracks, m."""
        return AXLE_M

    @property
    def wheel_speeds_m_s(self) -> tuple[float, float]:
        """(left, right) speeds at which the motors are driven now, m/s."""
        left, right = self._speeds_mm_s
        return left / 1000.0, right / 1000.0

    @property
    def counts(self) -> tuple[int, int]:
        """(left, right) encoder counters, 32 bits with a sign."""
        left, right = ((math.floor(count) + 2**31) % 2**32 - 2**31 for count in self._counts)
        return left, right

    def add_wheel_travel(self, left_m: float, right_m: float) -> None:
        """Roll the wheels this far (m); fractions of a count accumulate."""
        per_metre = COUNTS_PER_TURN / (math.pi * WHEEL_DIAMETER_M)
        self._counts[0] += left_m * per_metre
        self._counts[1] += right_m * per_metre

    def set_sensors(self, *, bump_left: bool, bump_right: bool, cliff: bool) -> None:
        """Set bumper and cliff sensors."""
        self.bump_left, self.bump_right, self.cliff = bump_left, bump_right, cliff

    def tick(self, now: float, dt: float) -> None:
        """Advance time by dt (s) to `now`: emergency button, the board's own timeout, battery, status lines."""
        if self.emergency_button:
            self._switch_off()
        if self.enabled and now - self._commanded_at > self.timeout_s:
            self.timed_out = True
            self._speeds_mm_s = (0, 0)
        amperes = _IDLE_A + _WHEEL_A_PER_M_S * sum(abs(speed) for speed in self.wheel_speeds_m_s)
        # About 2 V less over the 5 Ah of the pack.
        self.battery_mv = max(0.0, self.battery_mv - amperes * dt / 3600.0 / 5.0 * 2000.0)
        self._report_until(now)

    def receive(self, data: bytes, now: float) -> None:
        """Receive bytes from the host; whole lines take effect immediately."""
        for byte in data:
            if byte == 0x0A:
                self._handle_line(self._incoming, now)
                self._incoming = b""
            elif byte == 0x24:
                self._incoming = b"$"
            elif len(self._incoming) < _LINE_LIMIT:
                self._incoming += bytes((byte,))

    def outgoing(self, now: float) -> bytes:
        """Return what the board has sent up to `now`, once."""
        self._report_until(now)
        sent, self._outgoing = self._outgoing, b""
        return sent

    def _handle_line(self, text: bytes, now: float) -> None:
        if not text:
            return
        body, star, check = text[1:].partition(b"*")
        if text[:1] != b"$" or not star or check != b"%04X" % crc16(body) or not self._act(body, now):
            self.refused += 1

    def _act(self, body: bytes, now: float) -> bool:
        name, *arguments = body.decode("ascii", "replace").split(",")
        if name == "V" and len(arguments) == 2:
            speeds = [_whole(text) for text in arguments]
            if any(speed is None or abs(speed) > SPEED_LIMIT_MM_S for speed in speeds):
                return False
            self._commanded_at, self.timed_out = now, False
            if self.enabled:
                self._speeds_mm_s = (speeds[0] or 0, speeds[1] or 0)
            return True
        if name == "E" and not arguments:
            self._commanded_at = now
            self._speeds_mm_s = (0, 0)
            self.enabled = not self.emergency_button
            return True
        if name == "X" and not arguments:
            self._switch_off()
            return True
        return False

    def _switch_off(self) -> None:
        self.enabled = False
        self._speeds_mm_s = (0, 0)

    def _report_until(self, now: float) -> None:
        if self._next_status is None or now - self._next_status > _CATCH_UP_LINES * STATUS_S:
            self._next_status = now
        while self._next_status <= now:
            self._next_status += STATUS_S
            left, right = self.counts
            body = b"S,%d,%d,%d,%04X,%d" % (self._number, left, right, self._flags(), min(65_535, self.battery_mv))
            self._outgoing += b"$%b*%04X\n" % (body, crc16(body))
            self._number = (self._number + 1) % 256

    def _flags(self) -> int:
        bits = (
            self.enabled, self.bump_left, self.bump_right, self.cliff, self.wheel_drop, self.overcurrent,
            self.timed_out, self.charger, self.emergency_button,
        )  # fmt: skip
        return sum(bit << place for place, bit in enumerate(bits))


def crc16(data: bytes) -> int:
    """CRC-16, polynomial 0x1021, initial value 0xFFFF."""
    crc = 0xFFFF
    for byte in data:
        crc = (crc << 8 & 0xFF00) ^ _CRC16[crc >> 8 ^ byte]
    return crc


def _crc16_of_byte(byte: int) -> int:
    crc = byte << 8
    for _ in range(8):
        crc = ((crc << 1) ^ 0x1021 if crc & 0x8000 else crc << 1) & 0xFFFF
    return crc


_CRC16: Final = tuple(map(_crc16_of_byte, range(256)))


def _whole(text: str) -> int | None:
    digits = text.removeprefix("-")
    return int(text) if digits.isascii() and digits.isdigit() and len(digits) <= 4 else None
