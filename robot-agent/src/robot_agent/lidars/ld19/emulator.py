"""Emulator of an LD19 at its serial port: packets of twelve samples from power-on, and no input. Pure.

A function of the simulated world gives the distances. The head rotates not exactly 10 times a second, so no two
revolutions have their samples at the same angles.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

Measure = Callable[["NDArray[np.float64]", float], "NDArray[np.float64]"]
"""(angles in rad, counter-clockwise in the lidar's frame; time in s) -> ranges in m, nan for no return."""

BAUD: Final = 230_400
SAMPLES_PER_S: Final = 4500.0
SCANS_PER_S: Final = 10.03
RANGE_MIN_M: Final = 0.02
RANGE_MAX_M: Final = 12.0
_SAMPLES: Final = 12
_PACKET_S: Final = _SAMPLES / SAMPLES_PER_S
# After a pause of the simulation, missed packets are not sent in a burst.
_CATCH_UP_S: Final = 0.5
_REVOLUTIONS_MAX: Final = 5
_BODY: Final = struct.Struct("<BBHH" + _SAMPLES * "HB" + "HH")
# Packets per call of the measuring function: 11 ms.
_CHUNK: Final = 4


class Ld19Emulator:
    """The lidar's end of the serial line; implements `fognav_sim.emulators.LidarEmulator`.

    Two faults can be set at any time: `stalled` sends nothing more, `frozen` repeats the last whole revolutions
    (`frozen_revolutions`, 1 to 5), as a stuck serial bridge or a driver's ring buffer does.
    """

    def __init__(self, measure: Measure) -> None:
        """Store the measuring function of the simulated world."""
        self._measure = measure
        self._sent_until: float | None = None
        self._position = 0.25
        self._milliseconds = 0.0
        self._revolution: list[bytes] = []
        self._last_revolutions: deque[list[bytes]] = deque(maxlen=_REVOLUTIONS_MAX)
        self._replayed = 0
        self.stalled = False
        self.frozen = False
        self.frozen_revolutions = 1

    @property
    def baud(self) -> int:
        """Speed of the serial line."""
        return BAUD

    def receive(self, data: bytes, now: float) -> None:
        """Ignore bytes of the host: the LD19 has no input."""

    def outgoing(self, now: float) -> bytes:
        """Return what the lidar has sent up to `now`, once; this measures the world."""
        if self._sent_until is None or now - self._sent_until > _CATCH_UP_S:
            self._sent_until = now
        due = math.floor((now - self._sent_until) / _PACKET_S + 1e-9)
        sent: list[bytes] = []
        while due > 0:
            count = min(due, _CHUNK)
            due -= count
            self._sent_until += count * _PACKET_S
            if self.frozen and self._last_revolutions:
                sent += self._replay(count)
            elif not self.stalled:
                sent += self._packets(count, self._sent_until)
        return b"".join(sent)

    def _replay(self, count: int) -> list[bytes]:
        recent = tuple(self._last_revolutions)[-self.frozen_revolutions :]
        buffer = [packet for revolution in recent for packet in revolution]
        chosen = [buffer[(self._replayed + i) % len(buffer)] for i in range(count)]
        self._replayed += count
        return chosen

    def _packets(self, count: int, now: float) -> list[bytes]:
        step = SCANS_PER_S / SAMPLES_PER_S
        # Angles on the wire have hundredths of a degree; the host interpolates a packet's samples between them.
        starts = np.floor((self._position + np.arange(count) * _SAMPLES * step) % 1.0 * 36_000.0)
        span = round((_SAMPLES - 1) * step * 36_000.0)
        angles = (starts[:, None] + span * np.arange(_SAMPLES) / (_SAMPLES - 1)) % 36_000.0
        counter_clockwise = np.deg2rad(-angles.reshape(-1) / 100.0)
        ranges = np.asarray(self._measure((counter_clockwise + math.pi) % math.tau - math.pi, now), np.float64)
        returned = (ranges >= RANGE_MIN_M) & (ranges <= RANGE_MAX_M)
        known = np.where(returned, ranges, 0.0)
        strength = np.where(returned, 240.0 - 12.0 * known, 0.0)
        samples = np.column_stack((np.rint(known * 1000.0), strength)).astype(int).reshape(count, -1).tolist()
        return [
            self._packet(start, (start + span) % 36_000, part)
            for start, part in zip(starts.astype(int).tolist(), samples, strict=True)
        ]

    def _packet(self, start: int, end: int, samples: list[int]) -> bytes:
        speed, milliseconds = round(SCANS_PER_S * 360.0), int(self._milliseconds) % 30_000
        body = _BODY.pack(0x54, 0x2C, speed, start, *samples, end, milliseconds)
        body += bytes((crc8(body),))
        before = self._position
        self._position = (before + _SAMPLES * SCANS_PER_S / SAMPLES_PER_S) % 1.0
        self._milliseconds += 1000.0 * _PACKET_S
        if self._position < before:
            self._last_revolutions.append(self._revolution)
            self._revolution, self._replayed = [], 0
        self._revolution.append(body)
        return body


def crc8(data: bytes) -> int:
    """CRC-8, polynomial 0x4D, initial value 0."""
    crc = 0
    for byte in data:
        crc = _CRC8[crc ^ byte]
    return crc


def _crc8_of_byte(byte: int) -> int:
    for _ in range(8):
        byte = ((byte << 1) ^ 0x4D if byte & 0x80 else byte << 1) & 0xFF
    return byte


_CRC8: Final = bytes(map(_crc8_of_byte, range(256)))
