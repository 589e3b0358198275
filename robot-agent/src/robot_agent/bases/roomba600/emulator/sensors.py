"""The emulated robot's sensor packets, and their stream."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Final

from robot_agent.bases.roomba600.emulator.body import WHEEL_MA_PER_M_S

if TYPE_CHECKING:
    from robot_agent.bases.roomba600.emulator.body import Battery, Wheels, World

STREAM_PERIOD_S: Final = 0.015
# After a pause of the host or the simulation, missed frames are not sent in a burst.
_CATCH_UP_FRAMES: Final = 20

# Two-byte packets among 7..58; all others have one byte.
_WIDE: Final = frozenset((19, 20, 22, 23, 25, 26, *range(27, 32), 33, *range(39, 45), *range(46, 52), *range(54, 58)))
_GROUPS: Final = {
    0: range(7, 27), 1: range(7, 17), 2: range(17, 21), 3: range(21, 27), 4: range(27, 35), 5: range(35, 43),
    6: range(7, 43), 100: range(7, 59), 101: range(43, 59), 106: range(46, 52), 107: range(54, 59),
}  # fmt: skip

Packet = Callable[[int], bytes]
"""Returns the bytes of a packet by its id."""


class Stream:
    """Packets that are sent every 15 ms until they are paused."""

    def __init__(self) -> None:
        self.ids: tuple[int, ...] = ()
        self._running = False
        self._next_frame = 0.0

    def begin(self, ids: bytes, now: float) -> None:
        """Stream these packets from now on; none ends the stream."""
        self.ids = tuple(ids)
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
        self.ids = ()

    def due(self, now: float, packet: Packet, line: Callable[[bytes, float], bytes]) -> bytes:
        """Return the frames up to `now`, each with its checksum, as `line` passes them on."""
        if not self._running:
            return b""
        if now - self._next_frame > _CATCH_UP_FRAMES * STREAM_PERIOD_S:
            self._next_frame = now
        frames = b""
        while self._next_frame <= now:
            self._next_frame += STREAM_PERIOD_S
            body = b"".join(bytes((packet_id,)) + packet(packet_id) for packet_id in self.ids)
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

    def packet(self, packet_id: int) -> bytes:
        """Return a packet or a group of packets; nothing for an unknown id."""
        if packet_id in _GROUPS:
            return b"".join(self.packet(single) for single in _GROUPS[packet_id])
        if not 7 <= packet_id <= 58:
            return b""
        value = self._value(packet_id)
        return (value & 0xFFFF).to_bytes(2, "big") if packet_id in _WIDE else bytes((value & 0xFF,))

    def _value(self, packet_id: int) -> int:  # noqa: C901, PLR0911, PLR0912  # one case per packet of the specification
        world = self._world
        left, right = self._wheels.left_mm_s, self._wheels.right_mm_s
        match packet_id:
            case 7:
                return _bits(world.bump_right, world.bump_left, world.wheel_drop_right, world.wheel_drop_left)
            case 9 | 10 | 11 | 12:
                return int(world.cliffs[packet_id - 9])
            case 13:
                return int(world.virtual_wall)
            case 14:
                return _bits(world.overcurrent_right, world.overcurrent_left) << 3
            case 19:
                return self._wheels.take_distance()
            case 20:
                return self._wheels.take_angle()
            case 21:
                return self._charging_state()
            case 22:
                return self._battery.voltage_mv
            case 23:
                return round(self._battery.current_ma)
            case 24:
                return world.temperature_c
            case 25:
                return round(self._battery.charge_mah)
            case 26:
                return round(self._battery.capacity_mah)
            case 28 | 29 | 30 | 31:
                return 4 if world.cliffs[packet_id - 28] else 2700
            case 34:
                return _bits(world.charger, world.home_base)
            case 35:
                return self._mode()
            case 38:
                return len(self._stream.ids)
            case 39 | 40:
                return self._wheels.requested[packet_id - 39]
            case 41:
                return right
            case 42:
                return left
            case 43 | 44:
                return self._wheels.encoders[packet_id - 43]
            case 45:
                return _bits(*(signal > 300 for signal in world.light_signals))
            case 46 | 47 | 48 | 49 | 50 | 51:
                return world.light_signals[packet_id - 46]
            case 54 | 55:
                speed = (left, right)[packet_id - 54]
                return round(WHEEL_MA_PER_M_S * abs(speed) / 1000.0)
            case 58:
                return int(left > 0 and right > 0)
            case _:
                return 0

    def _charging_state(self) -> int:
        if not self._world.powered:
            return 0
        return 3 if self._battery.full else 2


def _bits(*flags: bool) -> int:
    return sum(flag << place for place, flag in enumerate(flags))
