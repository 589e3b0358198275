"""RPLidar A1: commands as bytes, the answer stream as typed events, nodes as whole scans.

Nothing here touches a port or a clock: bytes and arrival times go in, values come out. Nodes are decoded in bulk by
compiled code, so that thousands of them a second cost a small computer little.
Source: Slamtec, RPLIDAR interface protocol and application notes, A1 (protocol version 1.0, revision 2.x). The
module is as long as the protocol, with which it is read side by side.
"""

from __future__ import annotations

import re
from collections import deque
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

import numpy as np

from fog_kernels.lidar import FULL_CIRCLE_Q6, NODE_BYTES, decode_nodes, in_metres
from robot_agent.scan_builder import Samples, ScanBuilder

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from robot_agent.hardware import LaserScan, LidarSamples

RANGE_MIN_M: Final = 0.15
RANGE_MAX_M: Final = 12.0


# --- commands ---------------------------------------------------------------------------------------------------------


def stop() -> bytes:
    """Stop scanning (25); the device sends no answer and needs 1 ms before the next request."""
    return b"\xa5\x25"


def reset() -> bytes:
    """Reboot the device (40); it prints text and needs 2 ms before the next request."""
    return b"\xa5\x40"


def scan() -> bytes:
    """Start a standard scan (20): 5-byte nodes."""
    return b"\xa5\x20"


def express_scan() -> bytes:
    """Start an express scan in the legacy mode (82): 84-byte capsules, twice the nodes for the same bytes."""
    return _with_payload(0x82, bytes(5))


def get_info() -> bytes:
    """Request model, versions and serial number (50)."""
    return b"\xa5\x50"


def get_health() -> bytes:
    """Request the health (52)."""
    return b"\xa5\x52"


def get_sample_rate() -> bytes:
    """Request the duration of a sample (59)."""
    return b"\xa5\x59"


def _with_payload(command: int, payload: bytes) -> bytes:
    packet = bytes((0xA5, command, len(payload))) + payload
    checksum = 0
    for byte in packet:
        checksum ^= byte
    return packet + bytes((checksum,))


# --- events -----------------------------------------------------------------------------------------------------------


class Answer(IntEnum):
    """Type byte of the response descriptors that this driver understands."""

    INFO = 0x04
    HEALTH = 0x06
    SAMPLE_RATE = 0x15
    NODES = 0x81
    CAPSULES = 0x82


@dataclass(frozen=True, slots=True)
class Descriptor:
    """A response descriptor: the type and size of the data that follow."""

    answer: Answer
    length: int
    repeats: bool


@dataclass(frozen=True, slots=True)
class DeviceInfo:
    """Identity of the device: model id, (major, minor) firmware, hardware revision, serial number in hexadecimal."""

    model: int
    firmware: tuple[int, int]
    hardware: int
    serial_number: str


class HealthStatus(IntEnum):
    """Status of the device; ERROR calls for a reset."""

    GOOD = 0
    WARNING = 1
    ERROR = 2


@dataclass(frozen=True, slots=True)
class Health:
    """Health of the device; the status is a bare int if the protocol does not name it."""

    status: HealthStatus | int
    error_code: int


@dataclass(frozen=True, slots=True)
class SampleRate:
    """Microseconds that one sample takes in standard and in express scans."""

    standard_us: int
    express_us: int


class Nodes(NamedTuple):
    """A batch of n measurements in order of arrival; the boundaries between batches have no meaning.

    start: bool[n], first node of a scan. quality: uint8[n], 0..63 (express: 63 for a return, 0 for none).
    angle_q6: uint16[n], degrees / 64, clockwise seen from above, 0..23039.
    distance_q2: uint16[n], millimetres / 4, 0 for no return.
    """

    start: NDArray[np.bool_]
    quality: NDArray[np.uint8]
    angle_q6: NDArray[np.uint16]
    distance_q2: NDArray[np.uint16]


Event = Descriptor | DeviceInfo | Health | SampleRate | Nodes


# --- answers ----------------------------------------------------------------------------------------------------------

_DESCRIPTORS: Final = {
    b"\xa5\x5a\x14\x00\x00\x00\x04": Descriptor(Answer.INFO, 20, repeats=False),
    b"\xa5\x5a\x03\x00\x00\x00\x06": Descriptor(Answer.HEALTH, 3, repeats=False),
    b"\xa5\x5a\x04\x00\x00\x00\x15": Descriptor(Answer.SAMPLE_RATE, 4, repeats=False),
    b"\xa5\x5a\x05\x00\x00\x40\x81": Descriptor(Answer.NODES, 5, repeats=True),
    b"\xa5\x5a\x54\x00\x00\x40\x82": Descriptor(Answer.CAPSULES, 84, repeats=True),
}
_DESCRIPTOR_START: Final = b"\xa5\x5a"
_DESCRIPTOR_SIZE: Final = 7
_ANY_DESCRIPTOR: Final = re.compile(b"|".join(re.escape(pattern) for pattern in _DESCRIPTORS), re.DOTALL)


class _Decoder(Protocol):
    """Decodes the data after one descriptor. `last`: another descriptor ends the data here."""

    def feed(self, data: bytes, *, last: bool) -> list[Event]: ...


class Parser:
    """Bytes from the device -> events. Never raises, whatever the bytes are; resynchronizes after damage.

    A known descriptor has priority at any position: a new answer ends the one before, even in mid-node. Bytes that
    can't begin a descriptor go to the decoder of the current answer; before the first descriptor (the tail of an old
    scan, boot text) they are skipped.

    `skipped_bytes` counts bytes outside of any answer, `resyncs` lost boundaries of nodes or capsules, `corrupted`
    capsules with a wrong checksum.
    """

    def __init__(self) -> None:
        self._held = b""
        self._events: deque[Event] = deque()
        self._decoder: _Decoder | None = None
        self.skipped_bytes = 0
        self.resyncs = 0
        self.corrupted = 0

    def receive_data(self, data: bytes) -> None:
        """Parse received bytes, in pieces of any size."""
        buffer = self._held + data
        begin = 0
        # Nearly all that a lidar ever sends is measurements: a descriptor is looked for where one may begin.
        for match in _ANY_DESCRIPTOR.finditer(buffer) if _DESCRIPTOR_START in buffer else ():
            self._pass_on(buffer[begin : match.start()], last=True)
            begin = match.end()
            descriptor = _DESCRIPTORS[match.group()]
            self._events.append(descriptor)
            self._decoder = self._decoder_for(descriptor)
        end = len(buffer) - _partial_descriptor_size(buffer, begin)
        self._pass_on(buffer[begin:end], last=False)
        self._held = buffer[end:]

    def next_event(self) -> Event | None:
        """Return the oldest event not yet returned; None until more bytes are received."""
        return self._events.popleft() if self._events else None

    def reset(self) -> None:
        """Discard the current answer, after the port was reopened; counters are kept."""
        self._held = b""
        self._events.clear()
        self._decoder = None

    def _pass_on(self, data: bytes, *, last: bool) -> None:
        if self._decoder is None:
            self.skipped_bytes += len(data)
        elif data or last:
            self._events.extend(self._decoder.feed(data, last=last))

    def _decoder_for(self, descriptor: Descriptor) -> _Decoder:
        if descriptor.answer is Answer.NODES:
            return _NodeDecoder(self)
        if descriptor.answer is Answer.CAPSULES:
            return _CapsuleDecoder(self)
        return _SingleDecoder(self, descriptor)


def _partial_descriptor_size(buffer: bytes, begin: int) -> int:
    """Return how many bytes at the end of the buffer could begin a descriptor."""
    if buffer.find(_DESCRIPTOR_START[:1], max(begin, len(buffer) - _DESCRIPTOR_SIZE + 1)) < 0:
        return 0
    for size in range(min(_DESCRIPTOR_SIZE - 1, len(buffer) - begin), 0, -1):
        tail = buffer[-size:]
        if any(pattern.startswith(tail) for pattern in _DESCRIPTORS):
            return size
    return 0


class _SingleDecoder:
    """One answer of a fixed size."""

    def __init__(self, parser: Parser, descriptor: Descriptor) -> None:
        self._parser = parser
        self._descriptor = descriptor
        self._buffer = b""
        self._done = False

    def feed(self, data: bytes, *, last: bool) -> list[Event]:
        self._buffer += data
        events: list[Event] = []
        if not self._done and len(self._buffer) >= self._descriptor.length:
            events.append(self._decode(self._buffer[: self._descriptor.length]))
            self._buffer = self._buffer[self._descriptor.length :]
            self._done = True
        if self._done or last:
            self._parser.skipped_bytes += len(self._buffer)
            self._buffer = b""
        return events

    def _decode(self, data: bytes) -> Event:
        if self._descriptor.answer is Answer.INFO:
            return DeviceInfo(data[0], (data[2], data[1]), data[3], data[4:20].hex().upper())
        if self._descriptor.answer is Answer.HEALTH:
            return Health(_health_status(data[0]), int.from_bytes(data[1:3], "little"))
        return SampleRate(int.from_bytes(data[0:2], "little"), int.from_bytes(data[2:4], "little"))


def _health_status(value: int) -> HealthStatus | int:
    try:
        return HealthStatus(value)
    except ValueError:
        return value


# To find the node boundary again, this many nodes in a row must have right check bits and angles that advance like a
# rotating head's. Check bits alone are not enough: without returns, the zeros and the even steps of the angle look like
# nodes two bytes aside for whole seconds.
_RESYNC_NODES: Final = 6
_RESYNC_BACK_Q6: Final = 15 * 64
_RESYNC_FORWARD_Q6: Final = 30 * 64
_RESYNC_TOTAL_Q6: Final = (32, 90 * 64)


class _NodeDecoder:
    """5-byte nodes: start bit and its inverse, quality, check bit, angle, distance."""

    def __init__(self, parser: Parser) -> None:
        self._parser = parser
        self._buffer = b""
        self._synced = True

    def feed(self, data: bytes, *, last: bool) -> list[Event]:
        self._buffer += data
        events: list[Event] = []
        while self._decode_nodes(events) if self._synced else self._find_boundary():
            pass
        if last:
            self._parser.skipped_bytes += len(self._buffer)
            self._buffer = b""
        return events

    def _decode_nodes(self, events: list[Event]) -> bool:
        """Decode all whole nodes up to the first invalid one. True if there is one."""
        count = len(self._buffer) // NODE_BYTES
        if not count:
            return False
        nodes = decode_nodes(self._buffer)
        good = nodes.start.size
        if good:
            events.append(Nodes(*nodes))
        self._buffer = self._buffer[good * NODE_BYTES :]
        if good == count:
            return False
        self._parser.resyncs += 1
        self._synced = False
        return True

    def _find_boundary(self) -> bool:
        """Drop bytes up to the next place where nodes begin. True if it was found."""
        span = (_RESYNC_NODES - 1) * NODE_BYTES
        raw = np.frombuffer(self._buffer, np.uint8)
        places = raw.size - span - NODE_BYTES + 1
        if places <= 0:
            return False
        angle = _angles_q6(raw[1:-3], raw[2:-2])
        single = _is_node(raw[:-4], raw[1:-3], angle)
        run = np.ones(places, np.bool_)
        for node in range(_RESYNC_NODES):
            run &= single[node * NODE_BYTES : node * NODE_BYTES + places]
        drop = places
        for place in np.flatnonzero(run):
            if _is_rotating(angle[place : place + span + 1 : NODE_BYTES]):
                drop = int(place)
                self._synced = True
                break
        self._parser.skipped_bytes += drop
        self._buffer = self._buffer[drop:]
        return self._synced


def _angles_q6(low: NDArray[np.uint8], high: NDArray[np.uint8]) -> NDArray[np.uint16]:
    return (_u16(low) >> np.uint16(1)) | _u16(high) << np.uint16(7)


def _u16(values: NDArray[np.uint8]) -> NDArray[np.uint16]:
    return values.astype(np.uint16)


def _is_node(first: NDArray[np.uint8], second: NDArray[np.uint8], angle: NDArray[np.uint16]) -> NDArray[np.bool_]:
    one = np.uint8(1)
    bits = (first ^ (first >> one)) & second & one
    return bits.astype(np.bool_) & (angle < FULL_CIRCLE_Q6)


def _is_rotating(angles: NDArray[np.uint16]) -> bool:
    rotation = angles.astype(np.int32)
    steps = (rotation[1:] - rotation[:-1] + FULL_CIRCLE_Q6 // 2) % FULL_CIRCLE_Q6 - FULL_CIRCLE_Q6 // 2
    least, most = _RESYNC_TOTAL_Q6
    return bool(
        (steps >= -_RESYNC_BACK_Q6).all() and (steps <= _RESYNC_FORWARD_Q6).all() and least <= int(steps.sum()) <= most
    )


_CAPSULE_SIZE: Final = 84
_CAPSULE_NODES: Final = 32
_NEW_SCAN: Final = 0x8000
_RETURN_QUALITY: Final = 63


class _CapsuleDecoder:
    """84-byte express capsules: two sync nibbles, XOR of bytes 2..83, start angle, 16 cabins of two nodes each.

    The angles of a capsule's nodes lie between its start angle and that of the next capsule, so nodes come out one
    capsule late, and a damaged capsule takes the nodes of the one before with it.
    """

    def __init__(self, parser: Parser) -> None:
        self._parser = parser
        self._buffer = b""
        self._synced = True
        self._previous: bytes | None = None

    def feed(self, data: bytes, *, last: bool) -> list[Event]:
        self._buffer += data
        events: list[Event] = []
        position = 0
        while position < len(self._buffer):
            header = self._buffer[position : position + 2]
            plausible = header[0] >> 4 == 0xA and (len(header) < 2 or header[1] >> 4 == 0x5)
            if plausible and len(self._buffer) - position < _CAPSULE_SIZE:
                break
            if plausible:
                capsule = self._buffer[position : position + _CAPSULE_SIZE]
                if _xor(capsule[2:]) == (capsule[0] & 0xF) | (capsule[1] & 0xF) << 4:
                    self._synced = True
                    self._add(capsule, events)
                    position += _CAPSULE_SIZE
                    continue
                self._parser.corrupted += 1
            if self._synced:
                self._parser.resyncs += 1
                self._synced = False
            self._previous = None
            self._parser.skipped_bytes += 1
            position += 1
        self._buffer = self._buffer[position:]
        if last:
            self._parser.skipped_bytes += len(self._buffer)
            self._buffer = b""
        return events

    def _add(self, capsule: bytes, events: list[Event]) -> None:
        # The flag marks the first capsule after a scan request, not of a revolution: nothing before it belongs to it.
        if self._previous is not None and not _start_angle(capsule) & _NEW_SCAN:
            events.append(decode_capsule(self._previous, _start_angle(capsule)))
        self._previous = capsule


def _xor(data: bytes) -> int:
    return int(np.bitwise_xor.reduce(np.frombuffer(data, np.uint8)))


def _start_angle(capsule: bytes) -> int:
    return int.from_bytes(capsule[2:4], "little")


def decode_capsule(capsule: bytes, next_start: int) -> Nodes:
    """Nodes of one legacy express capsule (84 bytes), given the start angle field of the next one.

    Node k is at start + k (next - start) / 32 minus its own correction (6 bits, degrees / 8); a scan begins where
    that line passes 360 degrees. Source: Slamtec interface protocol, express scan, legacy capsules.
    """
    begin = _start_angle(capsule) & ~_NEW_SCAN
    span_q6 = ((next_start & ~_NEW_SCAN) - begin) % FULL_CIRCLE_Q6
    cabins = np.frombuffer(capsule, np.uint8, offset=4).reshape(16, 5).astype(np.int32)
    fields = np.empty((16, 2), np.int32)
    fields[:, 0] = cabins[:, 0] | cabins[:, 1] << 8
    fields[:, 1] = cabins[:, 2] | cabins[:, 3] << 8
    correction_q3 = (fields & 3) << 4
    correction_q3[:, 0] |= cabins[:, 4] & 0xF
    correction_q3[:, 1] |= cabins[:, 4] >> 4
    distance = (fields & 0xFFFC).reshape(-1).astype(np.uint16)
    # In degrees / 2048, so that the thirty-seconds of the span stay whole.
    line = begin * 32 + span_q6 * np.arange(_CAPSULE_NODES)
    angle = ((line - (correction_q3.reshape(-1) << 8)) >> 5) % FULL_CIRCLE_Q6
    start = (line + span_q6) % (FULL_CIRCLE_Q6 * 32) < span_q6
    quality = np.where(distance > 0, _RETURN_QUALITY, 0).astype(np.uint8)
    return Nodes(start, quality, angle.astype(np.uint16), distance)


# --- scans ------------------------------------------------------------------------------------------------------------


# Recorded heads start their scans between 350 and 360 degrees; a start flag far from zero is a damaged node.
_START_WINDOW_Q6: Final = 45 * 64


def _is_near_zero(angle_q6: int) -> bool:
    return angle_q6 < _START_WINDOW_Q6 or angle_q6 >= FULL_CIRCLE_Q6 - _START_WINDOW_Q6


class ScanAssembler:
    """Nodes -> whole scans, each from one start flag to the next."""

    def __init__(self) -> None:
        self._builder = ScanBuilder()

    @property
    def incomplete(self) -> int:
        """Number of scans that were discarded because nodes were missing."""
        return self._builder.incomplete

    def feed(self, nodes: Nodes, now: float) -> list[LaserScan]:
        """Add a batch that arrived at `now` (s, monotonic); return the scans that it completes."""
        angle = nodes.angle_q6
        boundaries = [index for index in nodes.start.nonzero()[0].tolist() if _is_near_zero(int(angle[index]))]
        clockwise, ranges = in_metres(angle, nodes.distance_q2)
        return self._builder.feed(Samples(clockwise, ranges, nodes.quality), boundaries, now)

    def take_samples(self) -> LidarSamples | None:
        """Return all samples since the last call, be their scan whole or not; None without any."""
        return self._builder.take_samples()

    def reset(self) -> None:
        """Discard the incomplete scan, after the device was restarted."""
        self._builder.reset()
