"""The emulated robot's sensor packets, their stream, and how single robots deviate from the specification."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

from robot_agent.bases.roomba600.emulator.body import WHEEL_MA_PER_M_S

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from robot_agent.bases.roomba600.emulator.body import Battery, Wheels, World

FLASH_TEXT: Final = b"Flash CRC successful: 0x0 (0x0)\r\n"


@dataclass(frozen=True, kw_only=True)
class Quirks:
    """What this robot does otherwise.

    mode_offset: added to the mode in the stream. mode_noise: every so many frames the stream's mode is 32 (0: never).
    text_period_s: it prints a text into the stream so often (0: never). damaged: every so many frames one has a wrong
    byte (0: never). bytes_wake: what it receives wakes it. stays_safe_on_dock: Safe mode holds on the dock, but the
    wheels do not move there. mode_change_s: each change of its mode takes so long, and what follows waits. baud: its
    rate. keeps_baud: it stays at its rate, whatever it is told.
    """

    mode_offset: int = 0
    mode_noise: int = 0
    text_period_s: float = 0.0
    damaged: int = 0
    bytes_wake: bool = False
    stays_safe_on_dock: bool = False
    mode_change_s: float = 0.0
    baud: int = 115200
    keeps_baud: bool = False


class LineNoise:
    """Applies the quirks of the stream to its frames."""

    def __init__(self, quirks: Quirks) -> None:
        self._quirks = quirks
        self._frames = 0
        self._text_at = quirks.text_period_s

    def mode(self, mode: int) -> int:
        """Return the mode that the next frame reports."""
        if self._quirks.mode_noise and self._frames % self._quirks.mode_noise == 0:
            return 32
        return mode + self._quirks.mode_offset

    def frame(self, frame: bytes, now: float) -> bytes:
        """Return what is sent for a frame: itself, damaged, or with a text before it."""
        self._frames += 1
        if self._quirks.damaged and self._frames % self._quirks.damaged == 0:
            place = self._frames % len(frame)
            frame = frame[:place] + bytes((frame[place] ^ 0x10,)) + frame[place + 1 :]
        if self._quirks.text_period_s and now >= self._text_at:
            self._text_at = now + self._quirks.text_period_s
            # The robot prints without regard to the frame that it is sending.
            return frame[:7] + FLASH_TEXT + frame[7:]
        return frame


STREAM_PERIOD_S: Final = 0.015
# After a pause of the host or the simulation, missed frames are not sent in a burst.
_CATCH_UP_FRAMES: Final = 20

# Two-byte packets among 7..58; all others have one byte.
_WIDE: Final = frozenset((19, 20, 22, 23, 25, 26, *range(27, 32), 33, *range(39, 45), *range(46, 52), *range(54, 58)))
_GROUPS: Final = {
    0: range(7, 27), 1: range(7, 17), 2: range(17, 21), 3: range(21, 27), 4: range(27, 35), 5: range(35, 43),
    6: range(7, 43), 100: range(7, 59), 101: range(43, 59), 106: range(46, 52), 107: range(54, 59),
}  # fmt: skip
_MASKS: Final = (0, 0xFF, 0xFFFF)
"""Of numbers by their sizes in bytes."""


class Field(NamedTuple):
    """A number in a packet: how it is read, and its size in bytes; `before` it are these bytes."""

    read: Callable[[], int]
    size: int
    before: bytes = b""


def as_bytes(fields: Iterable[Field]) -> bytes:
    """Return the numbers as they are sent now."""
    return b"".join([before + (read() & _MASKS[size]).to_bytes(size, "big") for read, size, before in fields])


def _led_by(before: bytes, fields: list[Field]) -> list[Field]:
    """Return the fields with these bytes before the first one."""
    return [Field(*fields[0][:2], before), *fields[1:]] if fields else [Field(int, 0, before)]


class Stream:
    """Packets that are sent every 15 ms until they are paused."""

    def __init__(self) -> None:
        self.ids: tuple[int, ...] = ()
        self._fields: list[Field] = []
        self._running = False
        self._next_frame = 0.0

    def begin(self, ids: bytes, fields: Callable[[int], list[Field]], now: float) -> None:
        """Stream these packets from now on, which have these fields by their ids; none ends the stream."""
        self.ids = tuple(ids)
        self._fields = []
        for packet_id in ids:
            self._fields += _led_by(bytes((packet_id,)), fields(packet_id))
        self._running = bool(ids)
        self._next_frame = now + STREAM_PERIOD_S

    def resume(self, now: float) -> None:
        """Continue a paused stream."""
        if self.ids and not self._running:
            self._next_frame = now + STREAM_PERIOD_S
            self._running = True

    def pause(self) -> None:
        """Send no frames, but remember the packets."""
        self._running = False

    def forget(self) -> None:
        """Forget the packets."""
        self.ids, self._fields = (), []

    def due(self, now: float, line: Callable[[bytes, float], bytes]) -> bytes:
        """Return the frames up to `now`, each with its checksum, as `line` passes them on."""
        if not self._running:
            return b""
        if now - self._next_frame > _CATCH_UP_FRAMES * STREAM_PERIOD_S:
            self._next_frame = now
        frames = b""
        while self._next_frame <= now:
            self._next_frame += STREAM_PERIOD_S
            body = as_bytes(self._fields)
            if len(body) <= 0xFF:
                frame = bytes((19, len(body))) + body
                frames += line(frame + bytes((-sum(frame) & 0xFF,)), now)
        return frames


class Sensors:
    """What the robot reports of its body."""

    def __init__(self, world: World, battery: Battery, wheels: Wheels, stream: Stream, mode: Callable[[], int]) -> None:
        """Report of these parts; `mode` returns the Open Interface's current mode."""
        self._world = world
        self._battery = battery
        self._wheels = wheels
        self._stream = stream
        self._mode = mode
        self._readers = self._values()

    def fields(self, packet_id: int) -> list[Field]:
        """Return the fields of a packet or a group of packets; none for an unknown id."""
        if packet_id in _GROUPS:
            return [field for single in _GROUPS[packet_id] for field in self.fields(single)]
        if not 7 <= packet_id <= 58:
            return []
        return [Field(self._readers.get(packet_id, int), 2 if packet_id in _WIDE else 1)]

    def _values(self) -> dict[int, Callable[[], int]]:
        """Return how each packet's value is read; all others are zero."""
        world, battery, wheels = self._world, self._battery, self._wheels

        def floor_signal(place: int) -> Callable[[], int]:
            return lambda: 4 if world.cliffs[place] else 2700

        def light(place: int) -> Callable[[], int]:
            return lambda: world.light_signals[place]

        return {
            7: lambda: (
                world.bump_right | world.bump_left << 1 | world.wheel_drop_right << 2 | world.wheel_drop_left << 3
            ),
            9: lambda: world.cliff_left,
            10: lambda: world.cliff_front_left,
            11: lambda: world.cliff_front_right,
            12: lambda: world.cliff_right,
            13: lambda: world.virtual_wall,
            14: lambda: world.overcurrent_right << 3 | world.overcurrent_left << 4,
            19: wheels.take_distance,
            20: wheels.take_angle,
            21: self._charging_state,
            22: lambda: battery.voltage_mv,
            23: lambda: round(battery.current_ma),
            24: lambda: world.temperature_c,
            25: lambda: round(battery.charge_mah),
            26: lambda: round(battery.capacity_mah),
            **{28 + place: floor_signal(place) for place in range(4)},
            34: lambda: world.charger | world.home_base << 1,
            35: self._mode,
            38: lambda: len(self._stream.ids),
            39: lambda: wheels.requested[0],
            40: lambda: wheels.requested[1],
            41: lambda: wheels.right_mm_s,
            42: lambda: wheels.left_mm_s,
            43: lambda: wheels.encoder(0),
            44: lambda: wheels.encoder(1),
            45: lambda: sum((signal > 300) << place for place, signal in enumerate(world.light_signals)),
            **{46 + place: light(place) for place in range(6)},
            54: lambda: _motor_ma(wheels.left_mm_s),
            55: lambda: _motor_ma(wheels.right_mm_s),
            58: lambda: wheels.left_mm_s > 0 and wheels.right_mm_s > 0,
        }

    def _charging_state(self) -> int:
        if not self._world.powered:
            return 0
        return 3 if self._battery.full else 2


def _motor_ma(speed_mm_s: int) -> int:
    return round(WHEEL_MA_PER_M_S * abs(speed_mm_s) / 1000.0)
