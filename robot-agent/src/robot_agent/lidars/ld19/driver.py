"""Driver of the LD19: it rotates and sends packets from power-on without a request, and takes no commands.

Nothing here touches a port or a clock. Packets are decoded in bulk by numpy: 375 of them come every second.
Packet, 47 bytes, little-endian: 0x54, 0x2C (12 samples), speed u16 (degrees/s), start angle u16 (degrees / 100,
clockwise), 12 x (distance u16 in mm, intensity u8), end angle u16, timestamp u16 (ms), CRC-8 of the 46 bytes before.
Source: LDROBOT, LD19 development manual, and the header file of its SDK.
"""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, Annotated, Final, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta

from fog_contracts.messages import Described, Reason
from robot_agent.device_signature import SerialSettings
from robot_agent.hardware import LaserScan, LidarEvents, LidarFactory, LidarTraits
from robot_agent.scan_builder import Samples, ScanBuilder

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robot_agent.hardware import LaserScan, LidarSamples

PACKET_BYTES: Final = 47
SAMPLES: Final = 12
SAMPLES_PER_S: Final = 4500
RANGE_MIN_M: Final = 0.02
RANGE_MAX_M: Final = 12.0
_HEADER: Final = b"\x54\x2c"
_FULL_CIRCLE: Final = 36_000
# Twelve samples can't span more than 1.5 times the angle by which the head rotates in their time.
_SPAN_MARGIN: Final = 1.5


class Packets(NamedTuple):
    """n valid packets in order of arrival, 12 n samples.

    angle: float64[12 n], degrees / 100, clockwise seen from above, 0 <= angle < 36000.
    distance_mm: uint16[12 n], 0 for no return. intensity: uint8[12 n].
    """

    angle: NDArray[np.float64]
    distance_mm: NDArray[np.uint16]
    intensity: NDArray[np.uint8]


def _crc_table() -> NDArray[np.uint8]:
    """CRC-8 of each single byte: polynomial 0x4D, initial value 0, not reflected."""
    table = np.zeros(256, np.uint8)
    for value in range(256):
        crc = value
        for _ in range(8):
            crc = (crc << 1) ^ 0x4D if crc & 0x80 else crc << 1
        table[value] = crc & 0xFF
    return table


_CRC: Final = _crc_table()


class Parser:
    """Bytes of the lidar -> packets. Never raises, whatever the bytes are; resynchronizes after damage.

    `corrupted` counts damaged packets: once per loss of the packet boundary, and every packet with a wrong checksum
    or impossible angles; `skipped_bytes` counts every byte that belonged to no valid packet.
    """

    def __init__(self) -> None:
        self._buffer = b""
        self._events: deque[Packets] = deque()
        self._synced = False
        self.corrupted = 0
        self.skipped_bytes = 0

    def receive_data(self, data: bytes) -> None:
        """Parse received bytes, in pieces of any size."""
        buffer = self._buffer + data
        position = 0
        while position < len(buffer):
            if not _HEADER.startswith(buffer[position : position + 2]):
                position = self._skip(buffer, position, damaged=self._synced)
                continue
            count = (len(buffer) - position) // PACKET_BYTES
            if not count:
                break
            raw = np.frombuffer(buffer, np.uint8, count * PACKET_BYTES, position).reshape(count, PACKET_BYTES)
            packets, good = _decode(raw)
            if good:
                self._synced = True
                self._events.append(packets)
                position += good * PACKET_BYTES
            else:
                position = self._skip(buffer, position, damaged=True)
        self._buffer = buffer[position:]

    def next_event(self) -> Packets | None:
        """Return the oldest packets not yet returned; None until more bytes are received."""
        return self._events.popleft() if self._events else None

    def reset(self) -> None:
        """Discard an incomplete packet, after the port was reopened; counters are kept."""
        self._buffer = b""
        self._events.clear()
        self._synced = False

    def _skip(self, buffer: bytes, position: int, *, damaged: bool) -> int:
        self.corrupted += damaged
        self._synced = False
        found = buffer.find(_HEADER[:1], position + 1)
        following = len(buffer) if found < 0 else found
        self.skipped_bytes += following - position
        return following


def _decode(raw: NDArray[np.uint8]) -> tuple[Packets, int]:
    """Decode uint8[n, 47] up to the first damaged packet; return the packets and their number."""
    crc = np.zeros(len(raw), np.uint8)
    for column in range(PACKET_BYTES - 1):
        crc = _CRC[crc ^ raw[:, column]]
    speed, start, end = (_u16(raw, column) for column in (2, 4, 42))
    span = (end - start) % _FULL_CIRCLE
    possible = _SPAN_MARGIN * 100.0 * speed * (SAMPLES / SAMPLES_PER_S)
    valid = (raw[:, 0] == _HEADER[0]) & (raw[:, 1] == _HEADER[1]) & (crc == raw[:, -1])
    valid &= (start < _FULL_CIRCLE) & (end < _FULL_CIRCLE) & (span <= possible)
    good = len(raw) if valid.all() else int(np.argmin(valid))
    samples = raw[:good, 6:42].reshape(good * SAMPLES, 3)
    steps = np.arange(SAMPLES) / (SAMPLES - 1)
    angle = (start[:good, None] + span[:good, None] * steps).reshape(-1) % _FULL_CIRCLE
    distance = (samples[:, 0].astype(np.uint16)) | samples[:, 1].astype(np.uint16) << np.uint16(8)
    return Packets(angle, distance, samples[:, 2].copy()), good


def _u16(raw: NDArray[np.uint8], column: int) -> NDArray[np.int64]:
    return raw[:, column].astype(np.int64) | raw[:, column + 1].astype(np.int64) << 8


class ScanAssembler:
    """Packets -> whole scans, each from angle 0 to the next angle 0.

    `intensity_min`: a weaker return (0..255) is ignored.
    """

    def __init__(self, intensity_min: int = 0) -> None:
        self._intensity_min = intensity_min
        self._builder = ScanBuilder()
        self._angle: float | None = None

    @property
    def incomplete(self) -> int:
        """Number of scans that were discarded because packets were missing."""
        return self._builder.incomplete

    def feed(self, packets: Packets, now: float) -> list[LaserScan]:
        """Add packets that arrived at `now` (s, monotonic); return the scans that they complete."""
        before = packets.angle[:1] if self._angle is None else np.array([self._angle])
        self._angle = float(packets.angle[-1])
        # The head rotates in one direction only: a decreasing angle has passed 0.
        passes_zero = np.diff(packets.angle, prepend=before) < -_FULL_CIRCLE / 2
        returned = (packets.distance_mm > 0) & (packets.intensity >= self._intensity_min)
        ranges = np.where(returned, packets.distance_mm / 1000.0, np.nan)
        samples = Samples(packets.angle * (np.pi / 18_000.0), ranges, packets.intensity)
        return self._builder.feed(samples, (int(index) for index in np.flatnonzero(passes_zero)), now)

    def take_samples(self) -> LidarSamples | None:
        """Return all samples since the last call, be their scan whole or not; None without any."""
        return self._builder.take_samples()

    def reset(self) -> None:
        """Discard the incomplete scan, after the port was reopened."""
        self._builder.reset()
        self._angle = None


SAMPLES_TIMEOUT_S: Final = 1.0


class Ld19Problem(Described):
    """Why there is no scan."""

    NO_PACKETS = "no_packets", "no valid packet arrives"


class Ld19Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An LD19."""

    range_max_m: Annotated[float, Meta(ge=1.0, le=RANGE_MAX_M, description="returns beyond it are ignored")] = (
        RANGE_MAX_M
    )
    intensity_min: Annotated[int, Meta(ge=0, le=255, description="a weaker return is ignored")] = 0


class Ld19Driver:
    """Protocol of one lidar; see `robot_agent.hardware.LidarDriver`."""

    serial = SerialSettings(230400)
    stop_command = b""

    def __init__(self, options: Ld19Options | None = None) -> None:
        chosen = options or Ld19Options()
        self.traits = LidarTraits(range_min_m=RANGE_MIN_M, range_max_m=chosen.range_max_m, scan_period_s=0.1)
        self._parser = Parser()
        self._assembler = ScanAssembler(chosen.intensity_min)
        self._samples_at = 0.0
        self.problem: Reason | Literal[""] = ""

    @property
    def corrupted(self) -> int:
        """Number of damaged packets."""
        return self._parser.corrupted

    def begin(self, now: float) -> bytes:
        """Begin (again), after the port was opened; there is nothing to send."""
        self._parser.reset()
        self._assembler.reset()
        self._samples_at, self.problem = now, ""
        return b""

    def receive(self, data: bytes, now: float) -> LidarEvents:
        """Parse bytes received from the port."""
        self._parser.receive_data(data)
        scans: list[LaserScan] = []
        while (packets := self._parser.next_event()) is not None:
            self._samples_at, self.problem = now, ""
            scans.extend(self._assembler.feed(packets, now))
        return LidarEvents(self._assembler.take_samples(), tuple(scans))

    def tick(self, now: float) -> bytes:
        """Advance time; a silent lidar is a problem, but no command can restart it."""
        if now - self._samples_at > SAMPLES_TIMEOUT_S:
            sentence = f"the lidar has sent no valid packet for {SAMPLES_TIMEOUT_S:.0f} s; check its cable and power"
            self.problem = Reason(Ld19Problem.NO_PACKETS, sentence)
        return b""


FACTORY: Final = LidarFactory(options=Ld19Options, make=Ld19Driver)
