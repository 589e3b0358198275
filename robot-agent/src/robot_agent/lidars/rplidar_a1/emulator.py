"""Emulator of an RPLidar A1 at its serial port: descriptors, device data, standard nodes and express capsules.

Pure: bytes and times go in, bytes come out; distances come from a function of the simulated world.
Source: Slamtec, RPLIDAR interface protocol and application notes, A1. Where it is silent: a request that has an answer
ends a running scan; a scan starts at any angle of the head.
Not emulated: the motor's start and the DTR line that switches it, because a pty has none: the head rotates whenever a
scan was requested.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_kernels.emulation import FULL_CIRCLE_Q6, encode_nodes, node_angles

if TYPE_CHECKING:
    from numpy.typing import NDArray

Measure = Callable[["NDArray[np.float64]", float], "NDArray[np.float64]"]
"""(angles in radians, counter-clockwise in the laser frame; time in seconds) -> ranges in metres, nan for no return."""

BAUD: Final = 115200
NODES_PER_S: Final = 2000.0
SCANS_PER_S: Final = 5.5
RANGE_MIN_M: Final = 0.15
RANGE_MAX_M: Final = 12.0
BOOT_TEXT: Final = b"RP LIDAR System.\r\nFirmware Ver 1.29 - RP, HW Ver 7\r\nModel: 18\r\n"
# Nodes per call of the measuring function: 16 ms of a standard scan.
_CHUNK: Final = 32
# After a pause of the simulation, missed nodes are not sent in a burst.
_CATCH_UP_S: Final = 0.5
_REVOLUTIONS_MAX: Final = 5


class RplidarEmulator:
    """The lidar's end of the serial line; implements `fognav_sim.emulators.LidarEmulator`.

    The port calls `receive` and `outgoing`; `now` is any monotonic clock, seconds. `health` and `error_code` answer a
    health request; `boot_text` follows a reset. Three faults can be set at any time: `stalled` sends nothing more,
    `frozen` repeats the bytes of the last whole revolutions (`frozen_revolutions`, 1 to 5), as a stuck serial bridge or
    a driver's ring buffer does. In `blind_sector_rad` (from, to; counter-clockwise) it measures nothing.
    """

    def __init__(
        self,
        measure: Measure,
        *,
        nodes_per_s: float = NODES_PER_S,
        scans_per_s: float = SCANS_PER_S,
        start_angle_rad: float = 1.0,
        serial_number: bytes = bytes(range(16)),
    ) -> None:
        """Store the measuring function; the first scan begins at `start_angle_rad`, clockwise.

        A whole number of nodes per scan would give identical scans at rest, which hosts take for a fault.
        """
        if not (0.0 < scans_per_s <= 20.0 and 10.0 * scans_per_s <= nodes_per_s <= 2304.0):
            raise ValueError(
                f"{nodes_per_s} nodes/s at {scans_per_s} scans/s: 115200 baud carry 2304 nodes/s, a scan needs 10"
            )
        self._measure = measure
        self._nodes_per_s = nodes_per_s
        self._scans_per_s = scans_per_s
        self._serial_number = serial_number[:16].ljust(16, b"\0")
        self.health = 0
        self.error_code = 0
        self.boot_text = BOOT_TEXT
        self.stalled = False
        self.frozen = False
        self.frozen_revolutions = 1
        self.blind_sector_rad: tuple[float, float] | None = None
        self._incoming = bytearray()
        self._outgoing = bytearray()
        self._scanning = False
        self._express = False
        self._due_since = 0.0
        self._position = start_angle_rad / math.tau
        self._fresh_scan = False
        self._revolution = bytearray()
        self._last_revolutions: deque[bytes] = deque(maxlen=_REVOLUTIONS_MAX)
        self._replayed = 0

    @property
    def baud(self) -> int:
        """Speed of the serial line."""
        return BAUD

    @property
    def scanning(self) -> bool:
        """A scan was requested and not stopped."""
        return self._scanning

    def receive(self, data: bytes, now: float) -> None:
        """Receive bytes from the host; whole requests take effect immediately, wrong ones are skipped byte by byte."""
        self._incoming += data
        while self._incoming:
            if self._incoming[0] != 0xA5:
                del self._incoming[0]
                continue
            if len(self._incoming) < 2:
                return
            command = self._incoming[1]
            size = 2
            if command & 0x80:
                if len(self._incoming) < 3:
                    return
                size = 4 + self._incoming[2]
                if len(self._incoming) < size:
                    return
                if np.bitwise_xor.reduce(np.frombuffer(bytes(self._incoming[:size]), np.uint8)):
                    del self._incoming[0]
                    continue
            payload = bytes(self._incoming[3 : size - 1])
            del self._incoming[:size]
            self._act(command, payload, now)

    def outgoing(self, now: float) -> bytes:
        """Return what the device has sent up to `now`, once; this measures the world."""
        if self._scanning:
            self._scan_until(now)
        sent = bytes(self._outgoing)
        self._outgoing.clear()
        return sent

    def _act(self, command: int, payload: bytes, now: float) -> None:
        if command == 0x25:
            self._scanning = False
        elif command == 0x40:
            self._scanning = False
            self._outgoing += self.boot_text
        elif command in {0x20, 0x21}:
            self._answer(5, 0x81, repeats=True)
            self._begin(now, express=False)
        elif command == 0x82 and payload[:1] == b"\0":
            self._answer(84, 0x82, repeats=True)
            self._begin(now, express=True)
        elif command == 0x50:
            self._answer(20, 0x04, bytes((24, 29, 1, 7)) + self._serial_number)
        elif command == 0x52:
            self._answer(3, 0x06, bytes((self.health,)) + self.error_code.to_bytes(2, "little"))
        elif command == 0x59:
            standard = round(1e6 / self._nodes_per_s)
            self._answer(4, 0x15, standard.to_bytes(2, "little") + (standard // 2).to_bytes(2, "little"))

    def _answer(self, size: int, kind: int, data: bytes = b"", *, repeats: bool = False) -> None:
        self._scanning = False
        self._outgoing += b"\xa5\x5a" + (size | (1 << 30 if repeats else 0)).to_bytes(4, "little") + bytes((kind,))
        self._outgoing += data

    def _begin(self, now: float, *, express: bool) -> None:
        # A device in error answers a scan request with its descriptor and nothing more.
        self._scanning = self.health != 2
        self._express = express
        self._due_since = now
        self._fresh_scan = True
        self._revolution.clear()
        self._last_revolutions.clear()

    def _scan_until(self, now: float) -> None:
        rate = self._nodes_per_s * (2 if self._express else 1)
        if now - self._due_since > _CATCH_UP_S:
            self._due_since = now - _CATCH_UP_S
        unit = 32 if self._express else 1
        units = math.floor((now - self._due_since) * rate / unit + 1e-9)
        if units <= 0:
            return
        if self.stalled:
            self._due_since += units * unit / rate
        elif self.frozen and self._last_revolutions and not self._express:
            self._replay(units * 5)
            self._due_since += units / rate
        elif self._express:
            for _ in range(units):
                self._due_since += unit / rate
                self._capsule(self._due_since, rate)
        else:
            while units:
                count = min(units, _CHUNK)
                units -= count
                self._due_since += count / rate
                self._nodes(count, self._due_since, rate)

    def _nodes(self, count: int, now: float, rate: float) -> None:
        self._position, angle, start = node_angles(self._position, self._scans_per_s / rate, count)
        ranges = np.ascontiguousarray(self._measure(_ANGLES[angle], now), np.float64)
        raw = encode_nodes(angle, start, ranges, RANGE_MIN_M, RANGE_MAX_M)
        if self.blind_sector_rad is not None:
            low, high = self.blind_sector_rad
            turned = (-np.radians(angle / 64.0) - low) % math.tau
            keep = (turned > (high - low) % math.tau) | start
            raw, start = raw[keep], start[keep]
        begin = 0
        for boundary in start.nonzero()[0].tolist():
            self._revolution += raw[begin:boundary].tobytes()
            if self._revolution:  # a scan that begins with its first node has none behind it
                self._last_revolutions.append(bytes(self._revolution))
            self._revolution.clear()
            self._replayed = 0
            begin = boundary
        self._revolution += raw[begin:].tobytes()
        self._outgoing += raw.tobytes()

    def _replay(self, size: int) -> None:
        buffer = b"".join(tuple(self._last_revolutions)[-self.frozen_revolutions :])
        for _ in range(size):
            self._outgoing.append(buffer[self._replayed % len(buffer)])
            self._replayed += 1

    def _capsule(self, now: float, rate: float) -> None:
        step = self._scans_per_s / rate
        begin = math.floor(self._position % 1.0 * FULL_CIRCLE_Q6) % FULL_CIRCLE_Q6
        # The host interpolates the nodes between this start angle and the next capsule's: measure at those angles.
        self._position += 32 * step
        following = math.floor(self._position % 1.0 * FULL_CIRCLE_Q6) % FULL_CIRCLE_Q6
        angles = begin + (following - begin) % FULL_CIRCLE_Q6 * np.arange(32) / 32.0
        distance = self._distances(angles % FULL_CIRCLE_Q6 / 64.0, now) & ~3
        cabins = np.zeros((16, 5), np.uint8)
        for place in (0, 1):
            cabins[:, 2 * place] = distance[place::2] & 0xFF
            cabins[:, 2 * place + 1] = distance[place::2] >> 8
        body = (begin | (0x8000 if self._fresh_scan else 0)).to_bytes(2, "little") + cabins.tobytes()
        self._fresh_scan = False
        checksum = int(np.bitwise_xor.reduce(np.frombuffer(body, np.uint8)))
        self._outgoing += bytes((0xA0 | checksum & 0xF, 0x50 | checksum >> 4)) + body

    def _distances(self, clockwise_deg: NDArray[np.float64], now: float) -> NDArray[np.int64]:
        """Return distances in quarters of a millimetre, 0 without a return within the rated range."""
        ranges = np.asarray(self._measure(_counter_clockwise(clockwise_deg), now), np.float64)
        returned = np.isfinite(ranges) & (ranges >= RANGE_MIN_M) & (ranges <= RANGE_MAX_M)
        return np.where(returned, np.rint(np.where(returned, ranges, 0.0) * 4000.0), 0.0).astype(np.int64)


def _counter_clockwise(clockwise_deg: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return angles in radians, -pi to pi."""
    angles: NDArray[np.float64] = (-np.deg2rad(clockwise_deg) + math.pi) % math.tau - math.pi
    return angles


_ANGLES: Final = _counter_clockwise(np.arange(FULL_CIRCLE_Q6) / 64.0)
"""The angles at which a standard node measures, by their 64ths of a degree."""
