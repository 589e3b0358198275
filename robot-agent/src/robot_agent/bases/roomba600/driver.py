"""Driver of the Roomba 600: Open Interface in Safe mode, with its safety sensors streamed every 15 ms.

A Roomba keeps its last velocity while the host is silent. Safe mode falls back to Passive by itself on cliff, wheel
drop and charger, and stops the wheels then; the bumper is left to the host.
"""

from __future__ import annotations

import math
from operator import itemgetter
from typing import Annotated, Final

import msgspec
from msgspec import Meta

from robot_agent.bases.roomba600 import open_interface as oi
from robot_agent.bases.roomba600.stop import STOP
from robot_agent.hardware import BaseFactory, BaseReading, BaseStatus, BaseTiming, DriveTrain, WheelOdometry

_COUNTS: Final = 1 << 16
_status_packets = itemgetter(*(i for i in oi.GUARDIAN_STREAM if i not in {22, 23, 41, 42, 43, 44}))
"""The packets of a frame but for those that change all the time and tell nothing about the status."""


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


class Roomba600Driver:
    """One Roomba's protocol; see `robot_agent.hardware.BaseDriver`."""

    timing = BaseTiming(frame_timeout=0.3, wake_timeout=1.0, ignored_after_wake=0.1)

    def __init__(self, options: Roomba600Options) -> None:
        self._parser = oi.StreamParser(oi.GUARDIAN_STREAM)
        self._status_made_of: tuple[int, ...] = ()
        self._last_status = BaseStatus()
        self._metres_per_tick = math.pi * options.wheel_diameter_m / options.ticks_per_turn
        self.drive_train = DriveTrain(
            axle_m=options.axle_m,
            wheel_speed_max_m_s=oi.WHEEL_SPEED_MAX_MM_S / 1000.0,
            travel_wrap_m=_COUNTS * self._metres_per_tick,
        )

    @property
    def corrupted(self) -> int:
        """Number of damaged stream frames."""
        return self._parser.corrupted

    def receive_data(self, data: bytes, now: float) -> None:
        """Parse received bytes."""
        del now
        self._parser.receive_data(data)

    def next_event(self) -> BaseReading | None:
        """Return the oldest frame not yet returned."""
        frame = self._parser.next_event()
        return None if frame is None else BaseReading(self._status(frame), self._odometry(frame))

    def wake(self) -> bytes:
        """Return Start, Safe, zero speed and the request for the stream."""
        # Start puts the OI into Passive mode, which stops the wheels by itself. The zeros after Safe are for a base
        # whose receiver was in the middle of a command: it takes Start, Safe and the beginning of the first zero speed
        # as the missing bytes, and the second zero speed ends whatever speed they make.
        return oi.start() + oi.safe() + 2 * oi.drive_direct(0, 0) + oi.stream(oi.GUARDIAN_STREAM)

    def drive(self, left_m_s: float, right_m_s: float) -> bytes:
        """Return Drive Direct; speeds beyond the top speed are scaled, which keeps the curve."""
        return oi.drive_wheels(left_m_s, right_m_s)

    def _status(self, frame: oi.Frame) -> BaseStatus:
        """Return the status; that of the last frame as long as no packet has changed that it is made of."""
        packets = _status_packets(frame.packets)
        if packets != self._status_made_of:
            self._status_made_of, self._last_status = packets, _status(frame)
        return self._last_status

    def _odometry(self, frame: oi.Frame) -> WheelOdometry:
        left, right = frame.encoders
        return WheelOdometry(left_m=left * self._metres_per_tick, right_m=right * self._metres_per_tick)


def _status(frame: oi.Frame) -> BaseStatus:
    charge = frame.charge_fraction
    return BaseStatus(
        bumper_left=frame.bump_left,
        bumper_right=frame.bump_right,
        cliff=frame.cliff,
        wheel_drop=frame.wheel_dropped,
        overcurrent=frame.wheel_overcurrent,
        battery=min(1.0, max(0.0, charge)) if math.isfinite(charge) else None,
        charging=frame.on_charger,
        mode_problem=_mode_problem(frame),
    )


def _mode_problem(frame: oi.Frame) -> str | None:
    if frame.mode == oi.Mode.SAFE:
        return None
    name = frame.mode.name.capitalize() if isinstance(frame.mode, oi.Mode) else f"number {frame.mode}"
    reason = ", because a charger is connected" if frame.on_charger else ""
    return f"its Open Interface is in mode {name} instead of Safe{reason}"


FACTORY: Final = BaseFactory(options=Roomba600Options, make=Roomba600Driver, stop=STOP)
