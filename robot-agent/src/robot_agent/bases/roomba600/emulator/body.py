"""The emulated robot's body, its sensor packets with their stream, and what single robots do otherwise.

The body: what its sensors touch, its battery, and its wheels with motors and encoders.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

TICKS_PER_TURN: Final = 508.8
WHEEL_DIAMETER_M: Final = 0.072
AXLE_MM: Final = 235.0
SPEED_MAX_MM_S: Final = 500
RADIUS_MAX_MM: Final = 2000
_PWM_MAX: Final = 255
_STRAIGHT: Final = frozenset((-32768, 32767, 0))
"""Radii of Drive that mean straight ahead."""
WHEEL_MA_PER_M_S: Final = 600.0
_IDLE_MA: Final = 180.0
_CHARGE_MA: Final = 1250.0
_TRICKLE_MA: Final = 60.0


@dataclass(slots=True)
class World:
    """State of the robot's sensors; the simulation sets it at any time."""

    bump_left: bool = False
    bump_right: bool = False
    wheel_drop_left: bool = False
    wheel_drop_right: bool = False
    cliff_left: bool = False
    cliff_front_left: bool = False
    cliff_front_right: bool = False
    cliff_right: bool = False
    virtual_wall: bool = False
    overcurrent_left: bool = False
    overcurrent_right: bool = False
    home_base: bool = False
    charger: bool = False
    temperature_c: int = 24
    light_signals: tuple[int, int, int, int, int, int] = (0, 0, 0, 0, 0, 0)

    @property
    def wheel_drop(self) -> bool:
        """Any wheel hangs."""
        return self.wheel_drop_left or self.wheel_drop_right

    @property
    def cliffs(self) -> tuple[bool, bool, bool, bool]:
        """No floor under each of the cliff sensors, from left to right."""
        return self.cliff_left, self.cliff_front_left, self.cliff_front_right, self.cliff_right

    @property
    def cliff(self) -> bool:
        """No floor under any of the four cliff sensors."""
        return any(self.cliffs)

    @property
    def powered(self) -> bool:
        """A charger, or the dock's contacts, give power."""
        return self.home_base or self.charger


@dataclass(slots=True)
class Battery:
    """A NiMH pack of twelve cells: an open-circuit voltage over the charge, minus the drop over the inner resistance.

    The constants are round figures for a 14.4 V pack; they bring a robot from full to empty in three to six hours.
    """

    capacity_mah: float = 2600.0
    charge_mah: float = 2400.0
    current_ma: float = 0.0
    resistance_ohm: float = 0.25

    def use(self, current_ma: float, dt: float) -> None:
        """Charge or discharge with a current (mA, positive into the pack) for dt seconds."""
        self.current_ma = current_ma
        self.charge_mah = min(self.capacity_mah, max(0.0, self.charge_mah + current_ma * dt / 3600.0))

    @property
    def voltage_mv(self) -> int:
        """Voltage at the contacts, mV: flat in the middle, steep where the pack is nearly empty."""
        level = self.charge_mah / self.capacity_mah
        open_circuit = 14.0 + 2.0 * level - 2.5 * math.exp(-20.0 * level)
        return round(1000.0 * open_circuit + self.resistance_ohm * self.current_ma)

    @property
    def full(self) -> bool:
        """The charger only keeps the charge."""
        return self.charge_mah >= 0.99 * self.capacity_mah

    def tick(self, dt: float, *, powered: bool, wheels_m_s: float) -> None:
        """Charge, or feed electronics and motors (sum of the wheels' speeds, m/s), for dt seconds."""
        if powered:
            self.use(_TRICKLE_MA if self.full else _CHARGE_MA, dt)
        else:
            self.use(-_IDLE_MA - WHEEL_MA_PER_M_S * wheels_m_s, dt)


class Wheels:
    """Two driven wheels. The motors keep their last speeds until they get others."""

    def __init__(self, left_encoder: int, right_encoder: int) -> None:
        """Stand still, with the encoders at these readings."""
        self.left_mm_s = self.right_mm_s = 0
        self.requested = (0, 0)
        """Velocity (mm/s) and radius (mm) of the last Drive; zeros after any other command."""
        self._ticks = [float(left_encoder), float(right_encoder)]
        self._distance_mm = 0.0
        self._angle_deg = 0.0

    def stop(self) -> None:
        """Stop both motors."""
        self.left_mm_s = self.right_mm_s = 0
        self.requested = (0, 0)

    def drive(self, speed: int, radius: int) -> None:
        """Drive (opcode 137): the robot's speed (mm/s) on a circle (radius in mm, positive to the left)."""
        speed_mm_s = clamp(speed, SPEED_MAX_MM_S)
        if radius in _STRAIGHT:
            left = right = speed_mm_s
        elif radius in {-1, 1}:
            left, right = -radius * speed_mm_s, radius * speed_mm_s
        else:
            half = AXLE_MM / 2.0 / clamp(radius, RADIUS_MAX_MM)
            left = clamp(round(speed_mm_s * (1.0 - half)), SPEED_MAX_MM_S)
            right = clamp(round(speed_mm_s * (1.0 + half)), SPEED_MAX_MM_S)
        self.left_mm_s, self.right_mm_s = left, right
        self.requested = (speed_mm_s, radius)

    def drive_direct(self, right: int, left: int) -> None:
        """Drive Direct (opcode 145): the speed (mm/s) of each wheel."""
        self.right_mm_s, self.left_mm_s = clamp(right, SPEED_MAX_MM_S), clamp(left, SPEED_MAX_MM_S)
        self.requested = (0, 0)

    def drive_pwm(self, right: int, left: int) -> None:
        """Drive PWM (opcode 146): the share of each motor's full power, -255 to 255."""
        right, left = (round(clamp(pwm, _PWM_MAX) / _PWM_MAX * SPEED_MAX_MM_S) for pwm in (right, left))
        self.drive_direct(right, left)

    def roll(self, left_m: float, right_m: float) -> None:
        """Roll the wheels this far (m); fractions of a tick accumulate."""
        per_metre = TICKS_PER_TURN / (math.pi * WHEEL_DIAMETER_M)
        self._ticks[0] += left_m * per_metre
        self._ticks[1] += right_m * per_metre
        self._distance_mm += 500.0 * (left_m + right_m)
        self._angle_deg += math.degrees((right_m - left_m) * 1000.0 / AXLE_MM)

    @property
    def encoders(self) -> tuple[int, int]:
        """(left, right) encoder readings, 16 bit."""
        return self.encoder(0), self.encoder(1)

    def encoder(self, wheel: int) -> int:
        """Return the reading (16 bit) of the left (0) or right (1) wheel's encoder."""
        ticks = self._ticks[wheel]
        return math.floor(ticks) & 0xFFFF

    def reset_encoders(self) -> None:
        """Count from zero."""
        self._ticks = [0.0, 0.0]

    def take_distance(self) -> int:
        """Return the distance (whole mm) travelled since the last call."""
        whole, self._distance_mm = _whole(self._distance_mm)
        return whole

    def take_angle(self) -> int:
        """Return the angle (whole degrees, counter-clockwise) turned since the last call."""
        whole, self._angle_deg = _whole(self._angle_deg)
        return whole


def clamp(value: int, most: int) -> int:
    """Limit a value to -most..most."""
    return max(-most, min(most, value))


def _whole(amount: float) -> tuple[int, float]:
    """Split an accumulated amount into whole units, which are reported once, and the rest."""
    whole = max(-0x8000, min(0x7FFF, math.trunc(amount)))
    return whole, amount - math.trunc(amount)


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
