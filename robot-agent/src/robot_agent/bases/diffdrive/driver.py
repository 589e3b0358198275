"""Driver of a diffdrive board: it sends its status every 20 ms, and drives while its motors are on."""

from __future__ import annotations

import math
from typing import Annotated, Final

import msgspec
from msgspec import Meta

from fog_contracts.messages import Described, Power
from robot_agent.bases.diffdrive import protocol
from robot_agent.bases.diffdrive.protocol import Flag
from robot_agent.bases.diffdrive.stop import STOP
from robot_agent.hardware import Awakening, BaseFactory, BaseReading, BaseStatus, BaseTiming, DriveTrain, WheelOdometry


class DiffDriveFault(Described):
    """Why the board does not obey."""

    EMERGENCY_BUTTON = "emergency_button", "its emergency button is pressed"
    MOTORS_OFF = "motors_off", "its motors are switched off"


class DiffDriveOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Geometry and battery of the robot around the board; README.md beside this file lists the options."""

    counts_per_turn: Annotated[float, Meta(gt=0.0, le=1e6, description="encoder counts of one turn of a wheel")] = (
        1440.0
    )
    wheel_diameter_m: Annotated[float, Meta(ge=0.02, le=0.5, description="diameter of a driven wheel")] = 0.09
    axle_m: Annotated[float, Meta(ge=0.05, le=1.0, description="distance between the driven wheels")] = 0.28
    wheel_speed_max_m_s: Annotated[
        float, Meta(gt=0.0, le=protocol.SPEED_MAX_MM_S / 1000.0, description="top speed of a wheel")
    ] = 0.6
    deceleration_m_s2: Annotated[
        float,
        Meta(
            ge=0.2,
            le=5.0,
            description="how fast a wheel that is commanded to zero comes to rest, at least, with the heaviest load on "
            "the smoothest floor: the robot keeps its distance by it",
        ),
    ] = 1.0
    battery_empty_v: Annotated[float, Meta(ge=0.0, le=60.0, description="voltage of the empty battery")] = 10.5
    battery_full_v: Annotated[float, Meta(ge=0.0, le=60.0, description="voltage of the full battery")] = 12.6

    def __post_init__(self) -> None:
        if self.battery_full_v <= self.battery_empty_v:
            raise ValueError(
                f"battery_full_v ({self.battery_full_v}) must be above battery_empty_v ({self.battery_empty_v})"
            )


class DiffDriveDriver:
    """One board's protocol; see `robot_agent.hardware.BaseDriver`."""

    timing = BaseTiming(frame_timeout=0.3, wake_timeout=1.0, ignored_after_wake=0.1)
    awakening = Awakening(bauds=(protocol.BAUD,))

    def __init__(self, options: DiffDriveOptions) -> None:
        self._options = options
        self._parser = protocol.StatusParser()
        self._metres_per_count = math.pi * options.wheel_diameter_m / options.counts_per_turn
        self.drive_train = DriveTrain(
            axle_m=options.axle_m,
            wheel_speed_max_m_s=options.wheel_speed_max_m_s,
            travel_wrap_m=protocol.COUNTS * self._metres_per_count,
            deceleration_m_s2=options.deceleration_m_s2,
        )

    @property
    def corrupted(self) -> int:
        """Number of damaged or repeated status lines."""
        return self._parser.corrupted

    def receive_data(self, data: bytes, now: float) -> None:
        """Parse received bytes."""
        del now
        self._parser.receive_data(data)

    def next_event(self) -> BaseReading | None:
        """Return the oldest status not yet returned."""
        status = self._parser.next_event()
        if status is None:
            return None
        travel = WheelOdometry(
            left_m=status.left * self._metres_per_count, right_m=status.right * self._metres_per_count
        )
        return BaseReading(self._base_status(status), travel)

    def wake(self) -> bytes:
        """Return a line feed that ends a truncated line, zero speeds, and the command that switches the motors on."""
        return b"\n" + protocol.velocity(0, 0) + protocol.enable()

    def respond(self) -> bytes:
        """Return nothing: `wake` is all that it takes."""
        return b""

    def use_baud(self, baud: int) -> None:
        """Keep the only rate that there is."""

    def drive(self, left_m_s: float, right_m_s: float) -> bytes:
        """Return the command for these wheel speeds; beyond the top speed both are scaled, which keeps the curve."""
        return protocol.wheels(left_m_s, right_m_s, self._options.wheel_speed_max_m_s)

    def _base_status(self, status: protocol.Status) -> BaseStatus:
        flags = status.flags
        fault = _fault(flags)
        return BaseStatus(
            bumper_left=Flag.BUMPER_LEFT in flags,
            bumper_right=Flag.BUMPER_RIGHT in flags,
            cliff=Flag.CLIFF in flags,
            wheel_drop=Flag.WHEEL_DROP in flags,
            overcurrent=Flag.OVERCURRENT in flags,
            battery=self._charge(status.battery_mv),
            charging=Flag.CHARGER in flags,
            power=Power(voltage_v=status.battery_mv / 1000.0) if status.battery_mv else None,
            mode_problem=None if fault is None else fault.says,
            mode_code=fault or "",
        )

    def _charge(self, battery_mv: int) -> float | None:
        if battery_mv == 0:
            return None
        empty, full = self._options.battery_empty_v, self._options.battery_full_v
        return min(1.0, max(0.0, (battery_mv / 1000.0 - empty) / (full - empty)))


def _fault(flags: Flag) -> DiffDriveFault | None:
    if Flag.EMERGENCY_STOP in flags:
        return DiffDriveFault.EMERGENCY_BUTTON
    return None if Flag.ENABLED in flags else DiffDriveFault.MOTORS_OFF


FACTORY: Final = BaseFactory(options=DiffDriveOptions, make=DiffDriveDriver, stop=STOP)
