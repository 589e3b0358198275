"""Roomba 600 Open Interface: commands as bytes, the sensor stream as typed frames.

Nothing here touches a port or a clock: bytes and arrival times go in, values come out.
Source: iRobot Create 2 Open Interface specification based on the Roomba 600 (2018).

The robot is driven in Safe mode, so that its own cliff, wheel drop and charger protection stays on. Full mode is for
leaving the dock only, where Safe mode does not move the wheels. The module is as long as the interface: one document
describes it, so that both are read side by side.
"""

from __future__ import annotations

import math
import struct
from collections import deque
from dataclasses import dataclass
from enum import IntEnum
from typing import TYPE_CHECKING, Final, NamedTuple, TypeVar

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

_Enum = TypeVar("_Enum", bound=IntEnum)

STREAM_PERIOD_S: Final = 0.015
STREAM_HEADER: Final = 19
# 15 ms at 115200 baud, ten bits to a byte; a longer stream frame comes out corrupted (specification, opcode 148).
STREAM_BYTES_MAX: Final = 172
WHEEL_SPEED_MAX_MM_S: Final = 500


class Mode(IntEnum):
    """OI mode as packet 35 reports it."""

    OFF = 0
    PASSIVE = 1
    SAFE = 2
    FULL = 3


class ChargingState(IntEnum):
    """Charging state as packet 21 reports it."""

    NOT_CHARGING = 0
    RECONDITIONING = 1
    FULL_CHARGING = 2
    TRICKLE = 3
    WAITING = 4
    FAULT = 5


class Packet(NamedTuple):
    """One sensor packet: its id, name, size on the wire (1 or 2 bytes, big-endian) and signedness."""

    packet_id: int
    name: str
    size: int
    signed: bool


PACKETS: Final[Mapping[int, Packet]] = {
    packet.packet_id: packet
    for packet in (
        Packet(7, "bumps_and_wheel_drops", 1, signed=False),
        Packet(8, "wall", 1, signed=False),
        Packet(9, "cliff_left", 1, signed=False),
        Packet(10, "cliff_front_left", 1, signed=False),
        Packet(11, "cliff_front_right", 1, signed=False),
        Packet(12, "cliff_right", 1, signed=False),
        Packet(13, "virtual_wall", 1, signed=False),
        Packet(14, "overcurrents", 1, signed=False),
        Packet(15, "dirt_detect", 1, signed=False),
        Packet(16, "unused_16", 1, signed=False),
        Packet(17, "ir_omni", 1, signed=False),
        Packet(18, "buttons", 1, signed=False),
        Packet(19, "distance_mm", 2, signed=True),
        Packet(20, "angle_deg", 2, signed=True),
        Packet(21, "charging_state", 1, signed=False),
        Packet(22, "voltage_mv", 2, signed=False),
        Packet(23, "current_ma", 2, signed=True),
        Packet(24, "temperature_c", 1, signed=True),
        Packet(25, "charge_mah", 2, signed=False),
        Packet(26, "capacity_mah", 2, signed=False),
        Packet(27, "wall_signal", 2, signed=False),
        Packet(28, "cliff_left_signal", 2, signed=False),
        Packet(29, "cliff_front_left_signal", 2, signed=False),
        Packet(30, "cliff_front_right_signal", 2, signed=False),
        Packet(31, "cliff_right_signal", 2, signed=False),
        Packet(32, "unused_32", 1, signed=False),
        Packet(33, "unused_33", 2, signed=False),
        Packet(34, "charging_sources", 1, signed=False),
        Packet(35, "oi_mode", 1, signed=False),
        Packet(36, "song_number", 1, signed=False),
        Packet(37, "song_playing", 1, signed=False),
        Packet(38, "stream_packets", 1, signed=False),
        Packet(39, "requested_velocity_mm_s", 2, signed=True),
        Packet(40, "requested_radius_mm", 2, signed=True),
        Packet(41, "requested_right_mm_s", 2, signed=True),
        Packet(42, "requested_left_mm_s", 2, signed=True),
        Packet(43, "left_encoder", 2, signed=False),
        Packet(44, "right_encoder", 2, signed=False),
        Packet(45, "light_bumper", 1, signed=False),
        Packet(46, "light_left_signal", 2, signed=False),
        Packet(47, "light_front_left_signal", 2, signed=False),
        Packet(48, "light_center_left_signal", 2, signed=False),
        Packet(49, "light_center_right_signal", 2, signed=False),
        Packet(50, "light_front_right_signal", 2, signed=False),
        Packet(51, "light_right_signal", 2, signed=False),
        Packet(52, "ir_left", 1, signed=False),
        Packet(53, "ir_right", 1, signed=False),
        Packet(54, "left_motor_current_ma", 2, signed=True),
        Packet(55, "right_motor_current_ma", 2, signed=True),
        Packet(56, "main_brush_current_ma", 2, signed=True),
        Packet(57, "side_brush_current_ma", 2, signed=True),
        Packet(58, "stasis", 1, signed=False),
    )
}
"""Every single packet. Libraries disagree here and there; these sizes add up to the 80 bytes of group 100."""

GROUPS: Final[Mapping[int, tuple[int, int]]] = {
    0: (7, 26),
    1: (7, 16),
    2: (17, 20),
    3: (21, 26),
    4: (27, 34),
    5: (35, 42),
    6: (7, 42),
    100: (7, 58),
    101: (43, 58),
    106: (46, 51),
    107: (54, 58),
}
"""Group id -> first and last packet in it, both included."""

LIGHT_BUMPER: Final = (46, 47, 48, 49, 50, 51)
GUARDIAN_STREAM: Final = (7, 9, 10, 11, 12, 13, 14, *range(21, 27), 34, 35, 41, 42, 43, 44, *LIGHT_BUMPER)
"""Packets that the guardian streams: all safety sensors, the battery, the wheel speeds that the robot was last
commanded, the encoders and the light bumper. 67 bytes a frame, of 172 possible."""

SLOW_STREAM: Final = (7, 9, 10, 11, 12, 14, 34, 35, 43, 44)
"""What fits into 15 ms at 19200 baud, 25 bytes: the safety sensors and the encoders, without the battery."""
BAUD_CODES: Final = {19200: 7, 115200: 11}
"""Rates of the serial line by which the robot is spoken to, and what Baud (129) calls them."""


def expand(ids: Iterable[int]) -> tuple[int, ...]:
    """Return the single packet ids of a list of packet and group ids, in wire order.

    Raises:
        ValueError: for an id that the Open Interface does not have.

    """
    single: list[int] = []
    for packet_id in ids:
        if packet_id in PACKETS:
            single.append(packet_id)
        elif packet_id in GROUPS:
            first, last = GROUPS[packet_id]
            single.extend(range(first, last + 1))
        else:
            raise ValueError(f"the Open Interface has no packet {packet_id}: use 7..58 or a group of {sorted(GROUPS)}")
    return tuple(single)


def data_size(packet_id: int) -> int:
    """Return the size (bytes) of the data of a packet or group id. Raises ValueError for an unknown id."""
    return sum(PACKETS[single].size for single in expand((packet_id,)))


def stream_frame_size(ids: Sequence[int]) -> int:
    """Bytes on the wire of one stream frame with these ids: header, length, ids, data, checksum."""
    return 3 + sum(1 + data_size(packet_id) for packet_id in ids)


def decode_packets(ids: Iterable[int], data: bytes) -> dict[int, int]:
    """Decode the unframed answer to Sensors or Query List: packet id -> value.

    Raises:
        ValueError: if the number of bytes is not what the ids need, or an id is unknown.

    """
    single = expand(ids)
    layout = struct.Struct(">" + "".join(_format(PACKETS[packet_id]) for packet_id in single))
    if layout.size != len(data):
        raise ValueError(f"packets {single} need {layout.size} bytes of data, got {len(data)}: the answer is truncated")
    return dict(zip(single, layout.unpack(data), strict=True))


def _format(packet: Packet) -> str:
    code = "b" if packet.size == 1 else "h"
    return code if packet.signed else code.upper()


# --- commands ---------------------------------------------------------------------------------------------------------


def reset() -> bytes:
    """Reboot the robot (7); it prints text, forgets its mode and its encoders, and needs seconds."""
    return b"\x07"


def start() -> bytes:
    """Start the interface (128): Off -> Passive."""
    return b"\x80"


def baud(rate: int) -> bytes:
    """Change the rate of the serial line (129); at the new one the robot wants nothing for 0.1 s.

    It keeps that rate until it loses its battery, or is switched on with its button held (19200).
    """
    return bytes((129, BAUD_CODES[rate]))


def safe() -> bytes:
    """Take control with the robot's own protection on (131): -> Safe."""
    return b"\x83"


def full() -> bytes:
    """Take control without the robot's own protection (132): -> Full. It drives on its charger, and stops charging."""
    return b"\x84"


def power() -> bytes:
    """Switch the robot off (133)."""
    return b"\x85"


def stop() -> bytes:
    """Leave the interface (173): streams and wheels stop, -> Off."""
    return b"\xad"


def seek_dock() -> bytes:
    """Let the firmware drive to its dock (143): -> Passive."""
    return b"\x8f"


RESYNC: Final = bytes(4)
"""Before a command: completes one of fixed length in whose middle the receiver is, for a byte of it was lost. No byte
of it is an opcode, so a receiver between two commands ignores it."""
RESYNC_ANY: Final = bytes(2 + 2 * 255)
"""Completes any command: Song (140), Stream (148) and Query List (149) say themselves how long they are."""
_SEVERING: Final = frozenset({129, 140, 148, 149})
"""Baud, after which the robot hears nothing more, and those that may swallow the next 255 bytes or more."""


def drive_direct(right_mm_s: int, left_mm_s: int) -> bytes:
    """Drive each wheel at its own speed (145), right wheel first as on the wire, mm/s.

    Raises:
        ValueError: outside +-500 mm/s; `drive_wheels` scales instead.

    """
    for side, speed in (("right", right_mm_s), ("left", left_mm_s)):
        if not -WHEEL_SPEED_MAX_MM_S <= speed <= WHEEL_SPEED_MAX_MM_S:
            raise ValueError(f"{side} wheel: {speed} mm/s is outside +-{WHEEL_SPEED_MAX_MM_S}")
    return struct.pack(">Bhh", 145, right_mm_s, left_mm_s)


def drive_wheels(left_m_s: float, right_m_s: float) -> bytes:
    """Drive Direct from speeds in m/s; beyond 0.5 both wheels are scaled alike, which keeps the curvature.

    A speed may be 2 mm/s less, so that none holds one of the `_SEVERING` opcodes: should the byte before be lost, the
    robot would obey it.

    Raises:
        ValueError: if a speed is not finite.

    """
    if not (math.isfinite(left_m_s) and math.isfinite(right_m_s)):
        raise ValueError(f"wheel speeds must be finite: left {left_m_s}, right {right_m_s} m/s")
    fastest = max(abs(left_m_s), abs(right_m_s)) * 1000.0
    scale = 1000.0 * min(1.0, WHEEL_SPEED_MAX_MM_S / fastest) if fastest else 0.0
    return drive_direct(_harmless(right_m_s * scale), _harmless(left_m_s * scale))


def _harmless(speed_mm_s: float) -> int:
    """Round to a speed whose bytes do not sever the connection if the robot takes them for an opcode."""
    speed = round(speed_mm_s)
    while speed & 0xFF in _SEVERING:
        speed += 1 if speed < 0 else -1
    return speed


def sensors(packet_id: int) -> bytes:
    """Ask once for one packet or group (142). Raises ValueError for an unknown id."""
    expand((packet_id,))
    return bytes((142, packet_id))


def query_list(ids: Sequence[int]) -> bytes:
    """Ask once for several packets (149). Raises ValueError for an unknown id."""
    expand(ids)
    return bytes((149, len(ids), *ids))


def stream(ids: Sequence[int]) -> bytes:
    """Ask for a frame of these packets every 15 ms (148).

    Raises:
        ValueError: for an unknown id, or if the frames would not fit into 15 ms at 115200 baud.

    """
    size = stream_frame_size(ids)
    if size > STREAM_BYTES_MAX:
        raise ValueError(f"a stream frame of {size} bytes does not fit into 15 ms: at most {STREAM_BYTES_MAX}")
    return bytes((148, len(ids), *ids))


def pause_stream() -> bytes:
    """Pause the stream, keeping its list of packets (150 0)."""
    return b"\x96\x00"


def resume_stream() -> bytes:
    """Resume the stream with the list that was requested last (150 1)."""
    return b"\x96\x01"


# --- the sensor stream ------------------------------------------------------------------------------------------------


class MissingPacketError(LookupError):
    """The packet is not in this frame: the stream does not contain it."""

    def __init__(self, packet_id: int, present: Iterable[int]) -> None:
        """Name the missing packet and those present."""
        super().__init__(
            f"packet {packet_id} ({PACKETS[packet_id].name}) is not in this frame: it has {sorted(present)}; "
            "add it to the ids given to stream()"
        )
        self.packet_id = packet_id


@dataclass(frozen=True, slots=True)
class Frame:
    """One valid stream frame. Every property raises MissingPacketError if its packet was not streamed."""

    packets: Mapping[int, int]

    def __contains__(self, packet_id: int) -> bool:
        return packet_id in self.packets

    def __getitem__(self, packet_id: int) -> int:
        try:
            return self.packets[packet_id]
        except KeyError:
            raise MissingPacketError(packet_id, self.packets) from None

    @property
    def bump_right(self) -> bool:
        """Right half of the bumper is pressed (packet 7, bit 0)."""
        return bool(self[7] & 1)

    @property
    def bump_left(self) -> bool:
        """Left half of the bumper is pressed (packet 7, bit 1)."""
        return bool(self[7] & 2)

    @property
    def bumped(self) -> bool:
        """Any half of the bumper is pressed."""
        return bool(self[7] & 3)

    @property
    def wheel_drop_right(self) -> bool:
        """Right wheel hangs (packet 7, bit 2)."""
        return bool(self[7] & 4)

    @property
    def wheel_drop_left(self) -> bool:
        """Left wheel hangs (packet 7, bit 3)."""
        return bool(self[7] & 8)

    @property
    def wheel_dropped(self) -> bool:
        """Any wheel hangs."""
        return bool(self[7] & 12)

    @property
    def cliff_left(self) -> bool:
        """No floor at the far left (packet 9)."""
        return bool(self[9])

    @property
    def cliff_front_left(self) -> bool:
        """No floor at the front left (packet 10)."""
        return bool(self[10])

    @property
    def cliff_front_right(self) -> bool:
        """No floor at the front right (packet 11)."""
        return bool(self[11])

    @property
    def cliff_right(self) -> bool:
        """No floor at the far right (packet 12)."""
        return bool(self[12])

    @property
    def cliff(self) -> bool:
        """No floor under any of the four cliff sensors."""
        return self.cliff_left or self.cliff_front_left or self.cliff_front_right or self.cliff_right

    @property
    def virtual_wall(self) -> bool:
        """A virtual wall is seen (packet 13)."""
        return bool(self[13])

    @property
    def wheel_overcurrent(self) -> bool:
        """A wheel motor draws too much: it is blocked (packet 14, bits 3 and 4)."""
        return bool(self[14] & 0b11000)

    @property
    def charging_state(self) -> ChargingState | int:
        """State of the charger (packet 21); a bare int for a value that the specification does not name."""
        return _named(ChargingState, self[21])

    @property
    def voltage_v(self) -> float:
        """Battery voltage, volts (packet 22)."""
        return self[22] / 1000.0

    @property
    def current_a(self) -> float:
        """Battery current, amperes, positive while charging (packet 23)."""
        return self[23] / 1000.0

    @property
    def charge_fraction(self) -> float:
        """Charge over capacity, 0..1 (packets 25 and 26); nan while the robot does not know its capacity."""
        capacity = self[26]
        return min(1.0, self[25] / capacity) if capacity else math.nan

    @property
    def on_charger(self) -> bool:
        """Home Base or charger has contact (packet 34)."""
        return bool(self[34] & 3)

    @property
    def docked(self) -> bool:
        """Home Base has contact, and no charger is plugged in (packet 34)."""
        return self[34] & 3 == 2

    @property
    def mode(self) -> Mode | int:
        """OI mode (packet 35); a bare int for a value that the specification does not name."""
        return _named(Mode, self[35])

    @property
    def requested_wheels_m_s(self) -> tuple[float, float]:
        """(left, right) speeds that the robot was last commanded, m/s (packets 42 and 41)."""
        return self[42] / 1000.0, self[41] / 1000.0

    @property
    def encoders(self) -> tuple[int, int]:
        """(left, right) wheel encoders, ticks, 16 bit, wrapping (packets 43 and 44)."""
        return self[43], self[44]


def _named(kind: type[_Enum], value: int) -> _Enum | int:
    try:
        return kind(value)
    except ValueError:
        return value


class _FrameCheck(IntEnum):
    INCOMPLETE = 0
    VALID = 1
    NO_FRAME = 2
    BAD_CHECKSUM = 3


_SIZES: Final = {packet_id: data_size(packet_id) for packet_id in (*PACKETS, *GROUPS)}


class _FrameLayout:
    """A stream frame of given single packets, compiled once: a whole frame is checked and decoded by a few calls."""

    def __init__(self, ids: Sequence[int]) -> None:
        self._ids = tuple(ids)
        self._body = struct.Struct(">" + "".join(f"B{_format(PACKETS[packet_id])}" for packet_id in ids))
        self._start = bytes((STREAM_HEADER, self._body.size))
        self._size = self._body.size + 3

    def decode(self, buffer: bytearray, begin: int) -> dict[int, int] | None:
        """Return the packets of the frame that begins here; None if it is incomplete, damaged or of other packets."""
        frame = buffer[begin : begin + self._size]
        if len(frame) != self._size or not frame.startswith(self._start) or sum(frame) & 0xFF:
            return None
        fields = self._body.unpack_from(frame, 2)
        return dict(zip(self._ids, fields[1::2], strict=True)) if fields[::2] == self._ids else None


class StreamParser:
    """Bytes of the sensor stream -> frames. Never raises, whatever the bytes are; resynchronizes after garbage.

    With `ids`, only frames with exactly these packets are accepted: the eight-bit checksum alone would accept one
    in 256 damaged frames, and the ids are further bytes to check.

    `corrupted` counts damaged frames (once per loss of the frame boundary, and every frame whose checksum is wrong);
    `skipped_bytes` counts every byte that belonged to no valid frame.
    """

    def __init__(self, ids: Sequence[int] | None = None) -> None:
        if ids is not None:
            expand(ids)
        self._ids = None if ids is None else tuple(ids)
        self._length = None if ids is None else stream_frame_size(ids) - 3
        self._layout = _FrameLayout(ids) if ids is not None and PACKETS.keys() >= set(ids) else None
        self._buffer = bytearray()
        self._events: deque[Frame] = deque()
        self._synced = False
        self.frames = 0
        self.corrupted = 0
        self.skipped_bytes = 0

    def receive_data(self, data: bytes) -> None:
        """Parse received bytes, in pieces of any size."""
        self._buffer += data
        position = 0
        while position < len(self._buffer):
            if self._layout is not None and (packets := self._layout.decode(self._buffer, position)) is not None:
                self._accept(packets)
                position += 3 + self._buffer[position + 1]
                continue
            check = self._check_frame(position)
            if check is _FrameCheck.INCOMPLETE:
                break
            if check is _FrameCheck.VALID:
                end = position + 2 + self._buffer[position + 1]
                self._accept(self._decode(position + 2, end))
                position = end + 1
                continue
            if self._synced or check is _FrameCheck.BAD_CHECKSUM:
                self.corrupted += 1
            self._synced = False
            found = self._buffer.find(STREAM_HEADER, position + 1)
            following = len(self._buffer) if found < 0 else found
            self.skipped_bytes += following - position
            position = following
        del self._buffer[:position]

    def next_event(self) -> Frame | None:
        """Return the oldest frame not yet returned; None until more bytes are received."""
        return self._events.popleft() if self._events else None

    def reset(self) -> None:
        """Discard an incomplete frame, after the port was reopened; counters are kept."""
        self._buffer.clear()
        self._events.clear()
        self._synced = False

    def _accept(self, packets: dict[int, int]) -> None:
        self._events.append(Frame(packets))
        self.frames += 1
        self._synced = True

    def _check_frame(self, begin: int) -> _FrameCheck:  # noqa: PLR0911  # each way in which bytes are no frame ends it at once
        buffer = self._buffer
        if buffer[begin] != STREAM_HEADER:
            return _FrameCheck.NO_FRAME
        if begin + 1 == len(buffer):
            return _FrameCheck.INCOMPLETE
        length = buffer[begin + 1]
        if not length or (self._length is not None and length != self._length):
            return _FrameCheck.NO_FRAME
        # The ids must lead exactly to the checksum; otherwise this was no header.
        cursor, end, index = begin + 2, begin + 2 + length, 0
        while cursor < end:
            if cursor >= len(buffer):
                return _FrameCheck.INCOMPLETE
            size = _SIZES.get(buffer[cursor])
            if size is None or (self._ids is not None and buffer[cursor] != self._ids[index]):
                return _FrameCheck.NO_FRAME
            cursor += 1 + size
            index += 1
        if cursor != end:
            return _FrameCheck.NO_FRAME
        if end >= len(buffer):
            return _FrameCheck.INCOMPLETE
        return _FrameCheck.BAD_CHECKSUM if sum(buffer[begin : end + 1]) & 0xFF else _FrameCheck.VALID

    def _decode(self, cursor: int, end: int) -> dict[int, int]:
        packets: dict[int, int] = {}
        while cursor < end:
            packet_id = self._buffer[cursor]
            following = cursor + 1 + _SIZES[packet_id]
            packets.update(decode_packets((packet_id,), bytes(self._buffer[cursor + 1 : following])))
            cursor = following
        return packets
