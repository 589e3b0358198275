"""Emulator of a Roomba 600 at its serial port: the Open Interface's modes, commands, sensors and stream.

Pure: bytes, times and the state of the world go in, bytes and wheel speeds come out.
Source: iRobot Create 2 Open Interface specification based on the Roomba 600 (2018). Where it is silent:
a byte that is no opcode is ignored; speeds and radii out of range are clamped; Spot, Clean, Max and Seek Dock end in
Passive mode with the wheels at rest (the simulation may drive it to the dock, see `seeking_dock`);
Power puts the robot to sleep in Passive mode with its stream off; the encoders survive everything but Reset.
Not emulated: the five minutes after which Passive mode sleeps, songs, LEDs, brushes, schedules, other baud rates (their
commands are accepted and have no effect).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

OFF, PASSIVE, SAFE, FULL = range(4)

BAUD: Final = 115200
TICKS_PER_TURN: Final = 508.8
WHEEL_DIAMETER_M: Final = 0.072
AXLE_MM: Final = 235.0
SPEED_MAX_MM_S: Final = 500
RADIUS_MAX_MM: Final = 2000
STREAM_PERIOD_S: Final = 0.015
# After a pause of the host or the simulation, missed frames are not sent in a burst.
_CATCH_UP_FRAMES: Final = 20

# Bytes of data after each opcode. The data of 140, 148 and 149 begin with the number of bytes that follow.
_ARGUMENTS: Final = {
    7: 0, 128: 0, 129: 1, 130: 0, 131: 0, 132: 0, 133: 0, 134: 0, 135: 0, 136: 0, 137: 4, 138: 1, 139: 3, 140: 2,
    141: 1, 142: 1, 143: 0, 144: 3, 145: 4, 146: 4, 148: 1, 149: 1, 150: 1, 162: 2, 163: 4, 164: 4, 165: 1, 167: 15,
    168: 3, 173: 0,
}  # fmt: skip
# Two-byte packets among 7..58; all others have one byte.
_WIDE: Final = frozenset((19, 20, 22, 23, 25, 26, *range(27, 32), 33, *range(39, 45), *range(46, 52), *range(54, 58)))
_GROUPS: Final = {
    0: range(7, 27), 1: range(7, 17), 2: range(17, 21), 3: range(21, 27), 4: range(27, 35), 5: range(35, 43),
    6: range(7, 43), 100: range(7, 59), 101: range(43, 59), 106: range(46, 52), 107: range(54, 59),
}  # fmt: skip

BOOT_TEXT: Final = b"bl-start\r\nSTR730\r\nbootloader id: #x47186549 82ECCFFF\r\nbootloader info rev: #xF000\r\n"
"""Text that a robot of the 600 series prints when it resets."""


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
    def cliff(self) -> bool:
        """No floor under any of the four cliff sensors."""
        return self.cliff_left or self.cliff_front_left or self.cliff_front_right or self.cliff_right

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


_IDLE_MA: Final = -180.0
_WHEEL_MA_PER_M_S: Final = -600.0
_CHARGE_MA: Final = 1250.0
_TRICKLE_MA: Final = 60.0


class RoombaEmulator:
    """The robot's end of the serial line; implements `fognav_sim.emulators.BaseEmulator`.

    The simulation calls `tick(now, dt)`, reads `wheel_speeds_m_s`, moves its robot, reports the true travel of the
    wheels by `add_wheel_travel`, and sets `world`. The port calls `receive` and `outgoing`. `now` is any monotonic
    clock (s). Like the real robot, it keeps its last speeds for ever while the host is silent.
    """

    def __init__(self, *, left_encoder: int = 0, right_encoder: int = 0, battery: Battery | None = None) -> None:
        """Wake up in mode Off, with the encoders at these readings."""
        self.world = World()
        self.battery = battery or Battery()
        self.mode = OFF
        self.seeking_dock = False
        self._ticks = [float(left_encoder), float(right_encoder)]
        self._wheels_mm_s = (0, 0)
        self._requested = (0, 0)
        self._incoming = bytearray()
        self._outgoing = bytearray()
        self._stream: tuple[int, ...] = ()
        self._streaming = False
        self._next_frame = 0.0
        self._distance_mm = 0.0
        self._angle_deg = 0.0

    @property
    def baud(self) -> int:
        """Speed of the serial line."""
        return BAUD

    @property
    def axle_m(self) -> float:
        """Distance between the wheels, m."""
        return AXLE_MM / 1000.0

    def set_sensors(self, *, bump_left: bool, bump_right: bool, cliff: bool) -> None:
        """Set bumper and cliff sensors at once; everything else is in `world`."""
        self.world.bump_left, self.world.bump_right = bump_left, bump_right
        self.world.cliff_left = self.world.cliff_right = cliff
        self.world.cliff_front_left = self.world.cliff_front_right = cliff

    @property
    def wheel_speeds_m_s(self) -> tuple[float, float]:
        """(left, right) speeds at which the motors are driven now, m/s."""
        left, right = self._wheels_mm_s
        return left / 1000.0, right / 1000.0

    @property
    def encoders(self) -> tuple[int, int]:
        """(left, right) encoder readings, 16 bit."""
        left, right = (math.floor(ticks) & 0xFFFF for ticks in self._ticks)
        return left, right

    def add_wheel_travel(self, left_m: float, right_m: float) -> None:
        """Roll the wheels this far (m); fractions of a tick accumulate."""
        per_metre = TICKS_PER_TURN / (math.pi * WHEEL_DIAMETER_M)
        self._ticks[0] += left_m * per_metre
        self._ticks[1] += right_m * per_metre
        self._distance_mm += 500.0 * (left_m + right_m)
        self._angle_deg += math.degrees((right_m - left_m) * 1000.0 / AXLE_MM)

    def tick(self, now: float, dt: float) -> None:
        """Advance time by dt (s) to `now`: protection, battery and the stream."""
        self._protect()
        moving = sum(abs(speed) for speed in self.wheel_speeds_m_s)
        if self.world.powered:
            full = self.battery.charge_mah >= 0.99 * self.battery.capacity_mah
            self.battery.use(_TRICKLE_MA if full else _CHARGE_MA, dt)
        else:
            self.battery.use(_IDLE_MA + _WHEEL_MA_PER_M_S * moving, dt)
        if self.battery.charge_mah <= 0.0:
            self._leave(OFF)
        self._stream_until(now)

    def receive(self, data: bytes, now: float) -> None:
        """Receive bytes from the host; whole commands take effect immediately."""
        self._incoming += data
        while self._incoming:
            opcode = self._incoming[0]
            size = _ARGUMENTS.get(opcode)
            if size is None:
                del self._incoming[0]
                continue
            if opcode in {140, 148, 149} and len(self._incoming) > size:
                size += self._incoming[size] * (2 if opcode == 140 else 1)
            if len(self._incoming) < 1 + size:
                return
            arguments = bytes(self._incoming[1 : 1 + size])
            del self._incoming[: 1 + size]
            self._act(opcode, arguments, now)

    def outgoing(self, now: float) -> bytes:
        """Return what the robot has sent up to `now`, once."""
        self._stream_until(now)
        sent = bytes(self._outgoing)
        self._outgoing.clear()
        return sent

    # --- commands ---

    def _act(self, opcode: int, arguments: bytes, now: float) -> None:  # noqa: C901  # one branch per command of the specification
        if opcode == 7:
            self._leave(OFF)
            self._ticks = [0.0, 0.0]
            self._stream = ()
            self._outgoing += BOOT_TEXT
        elif opcode == 128:
            self._leave(PASSIVE, keep_stream=True)
        elif self.mode == OFF:
            return
        elif opcode == 173:
            self._leave(OFF)
        elif opcode == 133:
            self._leave(PASSIVE)
        elif opcode in {130, 131, 132}:
            self.seeking_dock = False
            self.mode = FULL if opcode == 132 else SAFE
            self._protect()
        elif opcode in {134, 135, 136, 143}:
            self._leave(PASSIVE, keep_stream=True)
            self.seeking_dock = opcode == 143
        elif opcode in {142, 149}:
            ids = arguments if opcode == 142 else arguments[1:]
            self._outgoing += b"".join(self._packet(packet_id) for packet_id in ids)
        elif opcode == 148:
            self._stream = tuple(arguments[1:])
            self._streaming = bool(self._stream)
            self._next_frame = now + STREAM_PERIOD_S
        elif opcode == 150:
            resumes = bool(arguments[0]) and bool(self._stream)
            if resumes and not self._streaming:
                self._next_frame = now + STREAM_PERIOD_S
            self._streaming = resumes
        elif opcode in {137, 145, 146} and self.mode in {SAFE, FULL}:
            self._drive(opcode, _signed(arguments[:2]), _signed(arguments[2:]))
            self._protect()

    def _drive(self, opcode: int, first: int, second: int) -> None:
        self._requested = (0, 0)
        if opcode == 145:
            right, left = _clamp(first, SPEED_MAX_MM_S), _clamp(second, SPEED_MAX_MM_S)
        elif opcode == 146:
            right, left = (round(_clamp(pwm, 255) / 255 * SPEED_MAX_MM_S) for pwm in (first, second))
        else:
            speed = _clamp(first, SPEED_MAX_MM_S)
            if second in {-32768, 32767} or second == 0:
                left = right = speed
            elif second in {-1, 1}:
                left, right = -second * speed, second * speed
            else:
                half = AXLE_MM / 2.0 / _clamp(second, RADIUS_MAX_MM)
                left = _clamp(round(speed * (1.0 - half)), SPEED_MAX_MM_S)
                right = _clamp(round(speed * (1.0 + half)), SPEED_MAX_MM_S)
            self._requested = (speed, second)
        self._wheels_mm_s = (left, right)

    def _leave(self, mode: int, *, keep_stream: bool = False) -> None:
        """Stop the motors and enter a mode in which the host does not drive."""
        self.mode = mode
        self._wheels_mm_s = (0, 0)
        self._requested = (0, 0)
        self.seeking_dock = False
        self._streaming = self._streaming and keep_stream

    def _protect(self) -> None:
        """Safe mode's own protection: cliff while moving forward, wheel drop, charger; not bumper."""
        if self.mode != SAFE:
            return
        # Backwards the specification ignores a cliff, unless the robot turns within its own radius.
        left, right = self._wheels_mm_s
        forward_or_turning = left > 0 or right > 0 or left == right == 0
        if self.world.wheel_drop or self.world.powered or (self.world.cliff and forward_or_turning):
            self._leave(PASSIVE, keep_stream=True)

    # --- sensors ---

    def _stream_until(self, now: float) -> None:
        if not self._streaming:
            return
        if now - self._next_frame > _CATCH_UP_FRAMES * STREAM_PERIOD_S:
            self._next_frame = now
        while self._next_frame <= now:
            self._next_frame += STREAM_PERIOD_S
            body = b"".join(bytes((packet_id,)) + self._packet(packet_id) for packet_id in self._stream)
            if len(body) <= 0xFF:
                frame = bytes((19, len(body))) + body
                self._outgoing += frame + bytes((-sum(frame) & 0xFF,))

    def _packet(self, packet_id: int) -> bytes:
        if packet_id in _GROUPS:
            return b"".join(self._packet(single) for single in _GROUPS[packet_id])
        if not 7 <= packet_id <= 58:
            return b""
        return (
            (self._value(packet_id) & 0xFFFF).to_bytes(2, "big")
            if packet_id in _WIDE
            else bytes((self._value(packet_id) & 0xFF,))
        )

    def _value(self, packet_id: int) -> int:  # noqa: C901, PLR0911, PLR0912  # one case per packet of the specification
        world = self.world
        left, right = self._wheels_mm_s
        match packet_id:
            case 7:
                return _bits(world.bump_right, world.bump_left, world.wheel_drop_right, world.wheel_drop_left)
            case 9 | 10 | 11 | 12:
                return int(self._cliffs()[packet_id - 9])
            case 13:
                return int(world.virtual_wall)
            case 14:
                return _bits(world.overcurrent_right, world.overcurrent_left) << 3
            case 19:
                whole, self._distance_mm = _whole(self._distance_mm)
                return whole
            case 20:
                whole, self._angle_deg = _whole(self._angle_deg)
                return whole
            case 21:
                return self._charging_state()
            case 22:
                return self.battery.voltage_mv
            case 23:
                return round(self.battery.current_ma)
            case 24:
                return world.temperature_c
            case 25:
                return round(self.battery.charge_mah)
            case 26:
                return round(self.battery.capacity_mah)
            case 28 | 29 | 30 | 31:
                return 4 if self._cliffs()[packet_id - 28] else 2700
            case 34:
                return _bits(world.charger, world.home_base)
            case 35:
                return self.mode
            case 38:
                return len(self._stream)
            case 39 | 40:
                return self._requested[packet_id - 39]
            case 41:
                return right
            case 42:
                return left
            case 43 | 44:
                return self.encoders[packet_id - 43]
            case 45:
                return _bits(*(signal > 300 for signal in world.light_signals))
            case 46 | 47 | 48 | 49 | 50 | 51:
                return world.light_signals[packet_id - 46]
            case 54 | 55:
                speed = (left, right)[packet_id - 54]
                return round(-_WHEEL_MA_PER_M_S * abs(speed) / 1000.0)
            case 58:
                return int(left > 0 and right > 0)
            case _:
                return 0

    def _cliffs(self) -> tuple[bool, bool, bool, bool]:
        world = self.world
        return world.cliff_left, world.cliff_front_left, world.cliff_front_right, world.cliff_right

    def _charging_state(self) -> int:
        if not self.world.powered:
            return 0
        return 3 if self.battery.charge_mah >= 0.99 * self.battery.capacity_mah else 2


def _signed(two: bytes) -> int:
    return int.from_bytes(two, "big", signed=True)


def _clamp(value: int, most: int) -> int:
    return max(-most, min(most, value))


def _bits(*flags: bool) -> int:
    return sum(flag << place for place, flag in enumerate(flags))


def _whole(amount: float) -> tuple[int, float]:
    """Split an accumulated amount into whole units, which are reported once, and the rest."""
    whole = max(-0x8000, min(0x7FFF, math.trunc(amount)))
    return whole, amount - math.trunc(amount)
