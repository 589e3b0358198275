"""Emulator of a Roomba 600 at its serial port: the Open Interface's modes, commands, sensors and stream.

Pure: bytes, times and the state of the world go in, bytes and wheel speeds come out.
Source: iRobot Create 2 Open Interface specification based on the Roomba 600 (2018). Where it is silent:
a byte that is no opcode is ignored; speeds and radii out of range are clamped; Spot, Clean and Max, the button CLEAN
(`press_clean`) and the schedule (`clean`) let it drive off in Passive mode; Seek Dock drives it to the
dock that the simulation describes by `set_dock`;
Power puts the robot to sleep in Passive mode with its stream off; the encoders survive everything but Reset.
What owners report of single robots is in `Quirks`. Not emulated: the five minutes after which Passive mode sleeps (set
`asleep`), songs, LEDs, brushes, the command for another baud rate (they are accepted and have no effect).
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from robot_agent.bases.roomba600.emulator.body import (
    AXLE_MM,
    Battery,
    Field,
    LineNoise,
    Quirks,
    Sensors,
    Stream,
    Wheels,
    World,
    as_bytes,
)

if TYPE_CHECKING:
    from collections.abc import Iterator

__all__ = ["BOOT_TEXT", "FULL", "OFF", "PASSIVE", "SAFE", "Battery", "Quirks", "RoombaEmulator"]


_DRIVE_MM_S: Final = 300
_LEAVE_DOCK_MM_S: Final = -100


class Cleaning:
    """A cleaning, since its button, its schedule or its command began it."""

    def wheels(self, *, on_dock: bool) -> tuple[int, int]:
        """Return the speeds (mm/s) of left and right wheel: off the dock, then straight ahead."""
        speed = _LEAVE_DOCK_MM_S if on_dock else _DRIVE_MM_S
        return speed, speed


BEAM_M: Final = 1.5
"""The beams reach this far."""
_BEAM_HALF_RAD: Final = math.radians(45.0)
_GIVE_UP_S: Final = 20.0
_FAST_MM_S: Final = 150.0
_SLOW_MM_S: Final = 70.0
_SLOW_WITHIN_M: Final = 0.4
_LOOKAHEAD_M: Final = 0.25
_TURN_FROM_RAD: Final = 0.5
_TURN_MM_S: Final = 60.0
_CONTACT_M: Final = 0.012
_CONTACT_RAD: Final = 0.3
_CONTACT_ASIDE_M: Final = 0.05
_STOP_M: Final = 0.005


class Dock(NamedTuple):
    """Where the robot is, seen from where it stands on its dock.

    ahead: m that it has still to go along the dock's middle line. aside: m to the left of that line. heading: rad
    counter-clockwise from that line's direction.
    """

    ahead: float
    aside: float
    heading: float

    @property
    def has_contact(self) -> bool:
        """Whether the robot touches the dock's contacts."""
        near = abs(self.ahead) <= _CONTACT_M and abs(self.aside) <= _CONTACT_ASIDE_M
        return near and abs(self.heading) <= _CONTACT_RAD

    @property
    def is_seen(self) -> bool:
        """Whether the robot is in the dock's beams."""
        away = math.hypot(self.ahead, self.aside)
        return 0.0 < away <= BEAM_M and abs(math.atan2(self.aside, self.ahead)) <= _BEAM_HALF_RAD


class Search:
    """One search for the dock, since it was commanded."""

    def __init__(self) -> None:
        self._unseen_s = 0.0

    def wheels(self, dock: Dock | None, dt: float) -> tuple[int, int] | None:
        """Return the speeds (mm/s) of left and right wheel after `dt` more seconds; None once the search has ended."""
        if dock is not None and dock.has_contact and abs(dock.ahead) <= _STOP_M:
            return None
        if dock is None or not dock.is_seen:
            self._unseen_s += dt
            return None if self._unseen_s > _GIVE_UP_S else (round(-_TURN_MM_S), round(_TURN_MM_S))
        error = math.remainder(math.atan2(-dock.aside, _LOOKAHEAD_M) - dock.heading, math.tau)
        turn = max(-1.0, min(1.0, 3.0 * error)) * _TURN_MM_S
        forward = _FAST_MM_S if dock.ahead > _SLOW_WITHIN_M else _SLOW_MM_S
        if abs(error) > _TURN_FROM_RAD:
            forward = 0.0
        return round(forward - turn), round(forward + turn)


OFF, PASSIVE, SAFE, FULL = range(4)
_MODE_COMMANDS: Final = frozenset({128, 130, 131, 132, 143, 173})

BOOT_TEXT: Final = b"bl-start\r\nSTR730\r\nbootloader id: #x47186549 82ECCFFF\r\nbootloader info rev: #xF000\r\n"
"""Text that a robot of the 600 series prints when it resets."""

# Bytes of data after each opcode. The data of 140, 148 and 149 begin with the number of bytes that follow.
_ARGUMENTS: Final = {
    7: 0, 128: 0, 129: 1, 130: 0, 131: 0, 132: 0, 133: 0, 134: 0, 135: 0, 136: 0, 137: 4, 138: 1, 139: 3, 140: 2,
    141: 1, 142: 1, 143: 0, 144: 3, 145: 4, 146: 4, 148: 1, 149: 1, 150: 1, 162: 2, 163: 4, 164: 4, 165: 1, 167: 15,
    168: 3, 173: 0,
}  # fmt: skip


_BAUDS: Final = {7: 19200, 8: 28800, 9: 38400, 10: 57600, 11: 115200}
"""Rates by the codes of Baud (129), without those that no host uses."""


class CommandParser:
    """Splits received bytes into commands."""

    def __init__(self) -> None:
        self._incoming = bytearray()

    def forget(self) -> None:
        """Discard what is not parsed yet."""
        self._incoming.clear()

    def parse(self, data: bytes) -> Iterator[tuple[int, bytes]]:
        """Add bytes; yield the opcode and the data bytes of each whole command."""
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
            yield opcode, arguments


class RoombaEmulator:
    """The robot; implements `fognav_sim.emulators.BaseEmulator`.

    The simulation calls `tick(now, dt)`, reads `wheel_speeds_m_s`, moves its robot, reports the true travel of the
    wheels by `add_wheel_travel`, and sets `world`. The port calls `receive` and `outgoing`. `now` is any monotonic
    clock (s). Like the real robot, it keeps its last speeds for ever while the host is silent.
    """

    def __init__(
        self,
        *,
        left_encoder: int = 0,
        right_encoder: int = 0,
        battery: Battery | None = None,
        quirks: Quirks | None = None,
    ) -> None:
        """Wake up in mode Off, with the encoders at these readings."""
        self.quirks = quirks or Quirks()
        self.baud = self.quirks.baud
        """Speed of the serial line."""
        self.asleep = False
        """It neither hears nor sends anything until it is woken."""
        self._noise = LineNoise(self.quirks)
        self.world = World()
        self.battery = battery or Battery()
        self.mode = OFF
        self._program: Search | Cleaning | None = None
        self._dock: Dock | None = None
        self._wheels = Wheels(left_encoder, right_encoder)
        self._commands = CommandParser()
        self._received: deque[tuple[int, bytes, float]] = deque()
        self._busy_until = -math.inf
        self._stream = Stream()
        self._sensors = Sensors(self.world, self.battery, self._wheels, self._stream, lambda: self.mode)
        self._outgoing = bytearray()

    def set_quirks(self, **quirks: Any) -> None:  # noqa: ANN401  # the fields of `Quirks`
        """Let it deviate from the specification from now on, in these fields of `Quirks`; its rate stays."""
        self.quirks = Quirks(baud=self.baud, **quirks)
        self._noise = LineNoise(self.quirks)

    @property
    def seeking_dock(self) -> bool:
        """Whether its firmware drives it to its dock."""
        return isinstance(self._program, Search)

    @property
    def cleaning(self) -> bool:
        """Whether its firmware drives it about to clean."""
        return isinstance(self._program, Cleaning)

    def pulse_wake_line(self, seconds: float) -> None:
        """Pull the BRC pin low for so long: a second wakes the robot."""
        if self.asleep and seconds >= 1.0:
            self.asleep = False
            self._leave(OFF)

    def press_clean(self) -> None:
        """Press CLEAN: it wakes a sleeping robot; else it begins or ends cleaning, unless the host has control."""
        if self.asleep:
            self.asleep = False
            self._leave(OFF)
        elif self.cleaning:
            self._stop_program()
        else:
            self.clean()

    def switch_on(self, *, held: bool) -> None:
        """Switch it off and on again by its button; one that is held meanwhile makes it speak at 19200 baud."""
        self.baud = 19200 if held else self.baud
        self.asleep = False
        self._commands.forget()
        self._received.clear()
        self._leave(OFF)

    def clean(self) -> None:
        """Begin to clean, as by its schedule, which wakes it; nothing while the host has control."""
        if self.mode not in {SAFE, FULL}:
            self.asleep = False
            self._program = Cleaning()

    @property
    def axle_m(self) -> float:
        """Distance between the wheels, m."""
        return AXLE_MM / 1000.0

    def set_sensors(self, *, bump_left: bool, bump_right: bool, cliff: bool) -> None:
        """Set bumper and cliff sensors at once; everything else is in `world`."""
        self.world.bump_left, self.world.bump_right = bump_left, bump_right
        self.world.cliff_left = self.world.cliff_right = cliff
        self.world.cliff_front_left = self.world.cliff_front_right = cliff

    def set_dock(self, ahead_m: float, aside_m: float, heading_rad: float) -> None:
        """Set where the robot is, seen from where it stands on its dock; see `docking.Dock`."""
        self._dock = Dock(ahead_m, aside_m, heading_rad)
        self.world.home_base = self._dock.has_contact

    @property
    def wheel_speeds_m_s(self) -> tuple[float, float]:
        """(left, right) speeds at which the motors are driven now, m/s."""
        if self.quirks.stays_safe_on_dock and self.world.powered and self.mode == SAFE:
            return 0.0, 0.0
        return self._wheels.left_mm_s / 1000.0, self._wheels.right_mm_s / 1000.0

    @property
    def encoders(self) -> tuple[int, int]:
        """(left, right) encoder readings, 16 bit."""
        return self._wheels.encoders

    def add_wheel_travel(self, left_m: float, right_m: float) -> None:
        """Roll the wheels this far (m); fractions of a tick accumulate."""
        self._wheels.roll(left_m, right_m)

    def tick(self, now: float, dt: float) -> None:
        """Advance time by dt (s) to `now`: protection, battery and the stream."""
        self._obey(now)
        self._protect()
        self._drive_by_itself(dt)
        left, right = self.wheel_speeds_m_s
        # Safe and Full mode end the charging.
        self.battery.tick(
            dt, powered=self.world.powered and self.mode in {OFF, PASSIVE}, wheels_m_s=abs(left) + abs(right)
        )
        if self.battery.charge_mah <= 0.0:
            self._leave(OFF)
        self._send_stream(now)

    def receive(self, data: bytes, now: float) -> None:
        """Receive bytes from the host; whole commands take effect immediately, unless modes take their time."""
        if self.asleep and self.quirks.bytes_wake and data:
            self.asleep = False
            self._leave(OFF)
        if self.asleep:
            return
        self._received.extend((opcode, arguments, now) for opcode, arguments in self._commands.parse(data))
        self._obey(now)

    def _obey(self, now: float) -> None:
        """Let the commands take effect that are due by now."""
        while self._received and not self.asleep:
            opcode, arguments, received_at = self._received[0]
            effective_at = max(received_at, self._busy_until)
            if opcode in _MODE_COMMANDS:
                effective_at += self.quirks.mode_change_s
            if effective_at > now:
                return
            self._busy_until = effective_at
            self._received.popleft()
            if opcode == 129:
                self._change_baud(arguments[0])
            else:
                self._act(opcode, arguments, now)

    def outgoing(self, now: float) -> bytes:
        """Return what the robot has sent up to `now`, once."""
        self._send_stream(now)
        sent = bytes(self._outgoing)
        self._outgoing.clear()
        return sent

    def _send_stream(self, now: float) -> None:
        if not self.asleep:
            self._outgoing += self._stream.due(now, self._noise.frame)

    def _fields_in_stream(self, packet_id: int) -> list[Field]:
        if packet_id == 35:
            return [Field(lambda: self._noise.mode(self.mode), 1)]
        return self._sensors.fields(packet_id)

    # --- commands ---

    def _act(self, opcode: int, arguments: bytes, now: float) -> None:
        if opcode == 7:
            self._leave(OFF)
            self._wheels.reset_encoders()
            self._stream.forget()
            self._outgoing += BOOT_TEXT
        elif opcode == 128:
            self._leave(PASSIVE, keep_stream=True)
        elif self.mode == OFF:
            return
        elif opcode == 173:
            self._leave(OFF)
        elif opcode == 133:
            self._leave(PASSIVE)
            self.asleep = True
            self._commands.forget()
            self._received.clear()
        elif opcode in {130, 131, 132}:
            self._stop_program()
            self.mode = FULL if opcode == 132 else SAFE
            self._protect()
        elif opcode in {134, 135, 136, 143}:
            self._leave(PASSIVE, keep_stream=True)
            self._program = Search() if opcode == 143 else Cleaning()
        elif opcode in {142, 148, 149, 150}:
            self._report(opcode, arguments, now)
        elif opcode in {137, 145, 146} and self.mode in {SAFE, FULL}:
            move = {137: self._wheels.drive, 145: self._wheels.drive_direct, 146: self._wheels.drive_pwm}[opcode]
            move(_signed(arguments[:2]), _signed(arguments[2:]))
            self._protect()

    def _change_baud(self, code: int) -> None:
        if self.mode != OFF and not self.quirks.keeps_baud:
            self.baud = _BAUDS.get(code, self.baud)

    def _report(self, opcode: int, arguments: bytes, now: float) -> None:
        """Send packets once (opcodes 142, 149), or begin, resume or pause their stream (148, 150)."""
        if opcode == 148:
            self._stream.begin(arguments[1:], self._fields_in_stream, now)
        elif opcode == 150:
            if arguments[0]:
                self._stream.resume(now)
            else:
                self._stream.pause()
        else:
            ids = arguments if opcode == 142 else arguments[1:]
            self._outgoing += b"".join(as_bytes(self._sensors.fields(packet_id)) for packet_id in ids)

    def _leave(self, mode: int, *, keep_stream: bool = False) -> None:
        """Stop the motors and enter a mode in which the host does not drive."""
        self.mode = mode
        self._wheels.stop()
        self._program = None
        if not keep_stream:
            self._stream.pause()

    def _drive_by_itself(self, dt: float) -> None:
        """Let the firmware drive: blind to everything but the dock's beams, wheel drop and cliff."""
        if self._program is None:
            return
        wheels = None if self.world.wheel_drop or self.world.cliff else self._next_wheels(self._program, dt)
        if wheels is None:
            self._stop_program()
        else:
            left, right = wheels
            self._wheels.drive_direct(right, left)

    def _next_wheels(self, program: Search | Cleaning, dt: float) -> tuple[int, int] | None:
        if isinstance(program, Search):
            return program.wheels(self._dock, dt)
        return program.wheels(on_dock=self.world.home_base)

    def _stop_program(self) -> None:
        if self._program is not None:
            self._program = None
            self._wheels.stop()

    def _protect(self) -> None:
        """Safe mode's own protection: cliff while moving forward, wheel drop, charger; not bumper."""
        if self.mode != SAFE:
            return
        # Backwards the specification ignores a cliff, unless the robot turns within its own radius.
        left, right = self._wheels.left_mm_s, self._wheels.right_mm_s
        forward_or_turning = left > 0 or right > 0 or left == right == 0
        powered = self.world.powered and not self.quirks.stays_safe_on_dock
        if self.world.wheel_drop or powered or (self.world.cliff and forward_or_turning):
            self._leave(PASSIVE, keep_stream=True)


def _signed(two: bytes) -> int:
    return int.from_bytes(two, "big", signed=True)
