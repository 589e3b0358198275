"""Driver of the Roomba 600: Open Interface in Safe mode, with its safety sensors streamed every 15 ms.

A Roomba keeps its last velocity while the host is silent. Safe mode falls back to Passive by itself on cliff, wheel
drop and charger, and stops the wheels then; the bumper is left to the host. Its own program drives it into its dock in
Passive mode; off the dock it drives in Full mode only.

Which mode it is in says its sensor stream (packet 35). Some robots of the 600 series report every mode one too high
there (Passive 2, Safe 3), so the offset is learned whenever the robot is woken: Start brings it into Passive mode, and
what it reports then is Passive. Others report a number that is no mode for some frames.
"""

from __future__ import annotations

import math
from operator import itemgetter
from typing import TYPE_CHECKING, Annotated, Final, Literal, NamedTuple

import msgspec
from msgspec import Meta

from fog_contracts.messages import Described, Power
from robot_agent.bases.roomba600 import open_interface as oi
from robot_agent.bases.roomba600.open_interface import Mode
from robot_agent.bases.roomba600.signature import STOP
from robot_agent.hardware import (
    Awakening,
    BaseFactory,
    BaseReading,
    BaseStatus,
    BaseTiming,
    DriveTrain,
    WakeLine,
    WheelOdometry,
)

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from fog_contracts.messages import Charging

SETTLE_S: Final = 0.1
"""After Start: frames of before may still arrive, and the robot needs some 20 ms to change its mode."""
SAME_FRAMES: Final = 3
"""The offset is learned from so many equal frames."""
NOISE_S: Final = 0.1
"""A number that is no mode is ignored for so long."""
_MODES: Final = {mode.value: mode for mode in Mode}


class RoombaFault(Described):
    """Why a Roomba does not obey: the mode that its Open Interface is in."""

    STARTING = "starting", "its Open Interface is being started"
    MODE_OFF = "mode_off", "mode Off"
    MODE_PASSIVE = "mode_passive", "mode Passive: a button, its charger or its own protection ended Safe"
    MODE_SAFE = "mode_safe", "mode Safe, while it leaves its dock"
    MODE_FULL = "mode_full", "mode Full, which nobody asked for"
    MODE_UNKNOWN = "mode_unknown", "a mode that does not exist"


class ModeMonitor:
    """Follows the mode through noise and offset; `None` while the offset is not known yet."""

    def __init__(self) -> None:
        self.mode: Mode | int | None = None
        self._offset: int | None = None
        self._started_at: float | None = None
        self._reported = -1
        self._repeats = 0
        self._noise_since: float | None = None

    def restart(self) -> None:
        """Learn the offset again, from now on: Start was sent."""
        self.mode = self._offset = self._started_at = self._noise_since = None
        self._repeats = 0

    @property
    def offset(self) -> int | None:
        """By how much the robot reports its mode too high; None while it is not known."""
        return self._offset

    def on_report(self, value: int, now: float) -> None:
        """Handle the mode that a frame reports."""
        if self._offset is None:
            self._learn(value, now)
        else:
            self._follow(value - self._offset, now)

    def _learn(self, value: int, now: float) -> None:
        if self._started_at is None:
            self._started_at = now
        if now - self._started_at < SETTLE_S:
            return
        self._repeats = self._repeats + 1 if value == self._reported else 1
        self._reported = value
        if self._repeats >= SAME_FRAMES and value in {Mode.PASSIVE, Mode.PASSIVE + 1}:
            self._offset = value - Mode.PASSIVE
            self.mode = Mode.PASSIVE

    def _follow(self, value: int, now: float) -> None:
        if (mode := _MODES.get(value)) is not None:
            self.mode, self._noise_since = mode, None
        elif self._noise_since is None:
            self._noise_since = now
        elif now - self._noise_since > NOISE_S:
            self.mode = value


_COUNTS: Final = 1 << 16
BRC_PULSE_S: Final = 1.2
"""The robot wakes by one low pulse of a second; three shorter ones would change its baud rate."""
SAFE_AGAIN_S: Final = 0.25
"""Period of asking for a Safe mode that does not hold yet; until it does, the robot's CLEAN button lets it drive."""
_STREAMS: Final = {115200: oi.GUARDIAN_STREAM, 19200: oi.SLOW_STREAM}
_REMEDY: Final = (
    "it may be asleep, and its BRC pin is not wired (`brc` in [base.options]): press its CLEAN button, then check "
    "cable and battery"
)
_REMEDY_BRC: Final = "it was pulsed awake without success: check the cable, its BRC wire, and the battery"
_CHANGING: Final = frozenset((*range(21, 27), 35, 41, 42, 43, 44, *oi.LIGHT_BUMPER))
"""Packets that change all the time, and the mode, which the monitor follows."""
_DRIVING: Final = frozenset({oi.Mode.SAFE})
_SEEKING: Final = frozenset({oi.Mode.PASSIVE, oi.Mode.SAFE})
"""Frames of before Seek Dock may still arrive."""
_LEAVING: Final = frozenset({oi.Mode.PASSIVE, oi.Mode.FULL})
MEASURE_S: Final = 0.5
"""Period of looking at battery and light bumper: they hurry nobody."""
_CHARGING: Final[dict[int, Charging]] = {
    0: "no", 1: "reconditioning", 2: "bulk", 3: "trickle", 4: "waiting", 5: "fault",
}  # fmt: skip


class Roomba600Options(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Geometry that converts encoder ticks to motion. Defaults: Open Interface specification, packets 43 and 44.

    Calibrate them: out of the box a turn may be off by a tenth, because the wheels are soft and the axle's effective
    length depends on the floor.
    """

    ticks_per_turn: Annotated[float, Meta(ge=100.0, le=2000.0, description="encoder ticks of one turn of a wheel")] = (
        508.8
    )
    wheel_diameter_m: Annotated[
        float, Meta(ge=0.05, le=0.1, description="diameter of a driven wheel; measure it by a drive of some metres")
    ] = 0.072
    axle_m: Annotated[
        float,
        Meta(ge=0.15, le=0.35, description="distance between the driven wheels; measure it by some turns on the spot"),
    ] = 0.235
    baud: Annotated[
        Literal[115200, 19200],
        Meta(
            description="rate of the serial line; a robot that is silent at it is looked for at the other one, "
            "and told to speak at this one"
        ),
    ] = 115200
    brc: Annotated[
        Literal["none", "rts", "dtr"],
        Meta(description="control line of the adapter that is wired to the BRC pin, which wakes a sleeping robot"),
    ] = "none"


class Roomba600Driver:
    """One Roomba's protocol; see `robot_agent.hardware.BaseDriver`."""

    timing = BaseTiming(frame_timeout=0.3, wake_timeout=1.0, ignored_after_wake=0.1, frame_s=0.015)

    def __init__(self, options: Roomba600Options) -> None:
        self._configured = options.baud
        self._baud: int = options.baud
        self._stream = _STREAMS[options.baud]
        self._parser = oi.StreamParser(self._stream)
        self._corrupted_before = 0
        self._mode = ModeMonitor()
        self._safe_sent_at = -math.inf
        self._modes = _DRIVING
        self._on_charger = False
        self._incomplete = False
        """Whether a command since may have led the robot into the middle of one that nothing has completed yet."""
        self._complete_at = -math.inf
        """When what completes it may be sent again: it keeps the line busy."""
        self._received_at = 0.0
        other = 19200 if options.baud == 115200 else 115200
        line = None if options.brc == "none" else WakeLine(options.brc, BRC_PULSE_S)
        self.awakening = Awakening(
            bauds=(options.baud, other), line=line, remedy=_REMEDY if line is None else _REMEDY_BRC
        )
        self._measured = _Measured()
        self._measured_at = -math.inf
        self._status_made_of: tuple[object, ...] = ()
        self._last_status = BaseStatus()
        self._status_packets = _status_packets(self._stream)
        self._metres_per_tick = math.pi * options.wheel_diameter_m / options.ticks_per_turn
        self.drive_train = DriveTrain(
            axle_m=options.axle_m,
            wheel_speed_max_m_s=oi.WHEEL_SPEED_MAX_MM_S / 1000.0,
            travel_wrap_m=_COUNTS * self._metres_per_tick,
        )

    @property
    def corrupted(self) -> int:
        """Number of damaged stream frames."""
        return self._corrupted_before + self._parser.corrupted

    def receive_data(self, data: bytes, now: float) -> None:
        """Parse received bytes."""
        self._received_at = now
        self._parser.receive_data(data)

    def next_event(self) -> BaseReading | None:
        """Return the oldest frame not yet returned."""
        frame = self._parser.next_event()
        if frame is None:
            return None
        self._mode.on_report(frame[35], self._received_at)
        self._on_charger = frame.on_charger
        return BaseReading(self._status(frame), self._odometry(frame))

    def wake(self) -> bytes:
        """Return Start and the request for the stream; Safe follows when the robot reports its Passive mode.

        One that is found at another rate than the configured one is told to speak at that: watchdog and service manager
        stop it at no other. It then falls silent here, and is heard when the configured rate is tried again.
        """
        # Start puts the OI into Passive mode, which stops the wheels by itself. A base whose receiver was in the middle
        # of a wheel command takes up to four bytes as the missing ones.
        self._mode.restart()
        self._safe_sent_at = -math.inf
        self._modes = _DRIVING
        told = oi.baud(self._configured) if self._baud != self._configured else b""
        return 5 * oi.start() + oi.stream(self._stream) + told

    def respond(self) -> bytes:
        """Return Safe and zero speed, once the offset of the mode is known; on its charger Start, unless it is Passive.

        While a wheel hangs or a cliff is seen, Safe mode ends at once: it is sent again until it holds.
        """
        sent_lately = self._received_at - self._safe_sent_at < SAFE_AGAIN_S
        charging = self._on_charger and self._mode.mode not in {oi.Mode.SAFE, oi.Mode.FULL}
        if self._mode.offset is None or sent_lately or charging:
            return b""
        self._safe_sent_at = self._received_at
        if self._on_charger:
            return oi.start()  # it would not charge
        return oi.safe() + 2 * oi.drive_direct(0, 0)

    def seek_dock(self) -> bytes:
        """Return Seek Dock; it leads into Passive mode."""
        self._modes = _SEEKING
        return oi.seek_dock()

    def leave_dock(self) -> bytes:
        """Return Full, which moves the wheels on the dock; empty while the offset of the mode is not known."""
        if self._mode.offset is None:
            return b""
        self._modes = _LEAVING
        return oi.full()

    def take_control(self, *, charging: bool) -> bytes:
        """Return Start, which stops the wheels; and without a charger Safe and zero speed; each twice."""
        self._modes = _DRIVING
        self._safe_sent_at = -math.inf if charging else self._received_at
        return 2 * oi.start() if charging else 2 * (oi.start() + oi.safe() + oi.drive_direct(0, 0))

    def sleep(self) -> bytes:
        """Return Power: the robot switches itself off, until its BRC pin is pulsed."""
        return oi.drive_direct(0, 0) + oi.power()

    def use_baud(self, baud: int) -> None:
        """Ask for the stream that fits into this rate."""
        self._baud = baud
        self._stream = _STREAMS[baud]
        self._corrupted_before += self._parser.corrupted
        self._parser = oi.StreamParser(self._stream)
        self._status_packets = _status_packets(self._stream)

    def drive(self, left_m_s: float, right_m_s: float) -> bytes:
        """Return Drive Direct; speeds beyond the top speed are scaled, which keeps the curve.

        The first zeros after other speeds come twice: between them is what completes any command into whose middle a
        lost or wrong byte may have led the robot (docs/safety.md). It takes 45 ms of the line, 0.27 s of a slow one,
        and half of its time at most: the stops of a robot that stops and goes must not wait for one another.
        """
        command = oi.RESYNC + oi.drive_wheels(left_m_s, right_m_s)
        if left_m_s != 0.0 or right_m_s != 0.0:
            self._incomplete = True
        elif self._incomplete and self._received_at >= self._complete_at:
            self._incomplete = False
            self._complete_at = self._received_at + 2.0 * 10.0 * len(oi.RESYNC_ANY) / self._baud
            return command + oi.RESYNC_ANY + command
        return command

    def _status(self, frame: oi.Frame) -> BaseStatus:
        """Return the status; that of the last frame as long as no packet has changed that it is made of."""
        if self._received_at - self._measured_at >= MEASURE_S:
            self._measured, self._measured_at = _measure(frame), self._received_at
        made_of = (self._mode.mode, self._modes, self._measured, self._status_packets(frame.packets))
        if made_of != self._status_made_of:
            self._status_made_of = made_of
            self._last_status = _status(frame, self._mode.mode, self._modes, self._measured)
        return self._last_status

    def _odometry(self, frame: oi.Frame) -> WheelOdometry:
        left, right = frame.encoders
        return WheelOdometry(left_m=left * self._metres_per_tick, right_m=right * self._metres_per_tick)


def _status_packets(stream: Sequence[int]) -> Callable[[Mapping[int, int]], object]:
    return itemgetter(*(packet for packet in stream if packet not in _CHANGING))


class _Measured(NamedTuple):
    """What changes slowly: the charged fraction, the battery, and the light bumper's strengths."""

    battery: float | None = None
    power: Power | None = None
    proximity: tuple[int, ...] = ()


def _measure(frame: oi.Frame) -> _Measured:
    if 26 not in frame:
        return _Measured()
    charge = frame.charge_fraction
    power = Power(
        voltage_v=frame.voltage_v,
        current_a=frame.current_a,
        charge_ah=frame[25] / 1000.0,
        capacity_ah=frame[26] / 1000.0,
        temperature_c=float(frame[24]),
        charging=_CHARGING.get(frame[21]),
    )
    proximity = tuple(min(frame[packet], 4095) for packet in oi.LIGHT_BUMPER)
    return _Measured(min(1.0, max(0.0, charge)) if math.isfinite(charge) else None, power, proximity)


def _status(frame: oi.Frame, mode: oi.Mode | int | None, modes: frozenset[oi.Mode], measured: _Measured) -> BaseStatus:
    return BaseStatus(
        bumper_left=frame.bump_left,
        bumper_right=frame.bump_right,
        cliff=frame.cliff,
        wheel_drop=frame.wheel_dropped,
        overcurrent=frame.wheel_overcurrent,
        battery=measured.battery,
        charging=frame.on_charger,
        docked=frame.docked,
        power=measured.power,
        proximity=measured.proximity,
        mode_problem=None if mode in modes else _mode_problem(frame, mode),
        mode_code="" if mode in modes else _MODE_FAULTS.get(mode, RoombaFault.MODE_UNKNOWN),
    )


def _mode_problem(frame: oi.Frame, mode: oi.Mode | int | None) -> str:
    if mode is None:
        return "its Open Interface is being started"
    name = mode.name.capitalize() if isinstance(mode, oi.Mode) else f"number {mode}"
    reason = ", because a charger is connected" if frame.on_charger else ""
    return f"its Open Interface is in mode {name} instead of Safe{reason}"


_MODE_FAULTS: Final[Mapping[int | None, RoombaFault]] = {
    None: RoombaFault.STARTING,
    oi.Mode.OFF: RoombaFault.MODE_OFF,
    oi.Mode.PASSIVE: RoombaFault.MODE_PASSIVE,
    oi.Mode.SAFE: RoombaFault.MODE_SAFE,
    oi.Mode.FULL: RoombaFault.MODE_FULL,
}


FACTORY: Final = BaseFactory(options=Roomba600Options, make=Roomba600Driver, stop=STOP)
