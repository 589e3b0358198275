"""What bases and lidars are to the rest of the robot, whatever their make: neutral values and the protocols of drivers.

A driver is a protocol without I/O (as in h11): bytes and arrival times in, events out, commands out as bytes. It knows
no port and no clock, so it can be fed one byte at a time, damaged, recorded and replayed.

Units are m, rad, s; `now` is the caller's monotonic clock.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Generic, NamedTuple, Protocol, TypeVar

import msgspec
from msgspec import Meta

from fog_contracts.messages import Finite, Sentence

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from robot_agent.stop_command import StopCommand

Options = TypeVar("Options", bound=msgspec.Struct)
"""A driver's own options: a frozen struct whose fields name their units and that refuses unknown fields."""


# --- values -----------------------------------------------------------------------------------------------------------


class Twist(NamedTuple):
    """Motion of the robot's body: forward speed `v` in m/s, turning rate `w` in rad/s, counter-clockwise positive."""

    v: float
    w: float


class WheelOdometry(msgspec.Struct, frozen=True, kw_only=True):
    """How far each wheel has rolled forward by its encoder (m), counted from anywhere.

    The counters wrap at the drive train's `travel_wrap_m` and start anywhere when the base restarts: only differences
    mean anything, and `robot_agent.odometry` tells the plausible ones from the others.
    """

    left_m: Finite
    right_m: Finite


class BaseStatus(msgspec.Struct, frozen=True, kw_only=True):
    """What a base says of itself. A sensor that it does not have is False, or None where there is a number.

    `overcurrent`: a wheel motor draws more than it should. `battery`: charged fraction. `charging`: it has contact to a
    charger. `mode_problem`: why the base does not obey wheel commands (None: it is in its driving mode).
    """

    bumper_left: bool = False
    bumper_right: bool = False
    cliff: bool = False
    wheel_drop: bool = False
    overcurrent: bool = False
    battery: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None
    charging: bool = False
    mode_problem: Sentence | None = None

    @property
    def bumper(self) -> bool:
        """Any side of the bumper is pressed."""
        return self.bumper_left or self.bumper_right


class BaseReading(NamedTuple):
    """One valid sensor frame of a base."""

    status: BaseStatus
    odometry: WheelOdometry


@dataclass(frozen=True, slots=True, kw_only=True)
class DriveTrain:
    """Two driven wheels on one axle: what turns wheel speeds and travels into motion of the body.

    `wheel_speed_max_m_s`: the fastest that a wheel can be told to turn. `travel_wrap_m`: the travel after which the
    encoders' counters begin anew (infinite: never).
    """

    axle_m: float = 0.235
    wheel_speed_max_m_s: float = 0.5
    travel_wrap_m: float = math.inf

    def twist(self, left_m_s: float, right_m_s: float) -> Twist:
        """Return the body's motion at these wheel speeds."""
        return Twist((left_m_s + right_m_s) / 2, (right_m_s - left_m_s) / self.axle_m)


@dataclass(frozen=True, slots=True, kw_only=True)
class BaseTiming:
    """What the guardian waits for, s.

    `silence`: no valid frame for this long is a fault. `wake`: the base may take this long to report its driving mode
    before it is woken again. `settle`: frames that come sooner after waking may stem from before it.
    """

    silence: float = 0.3
    wake: float = 1.0
    settle: float = 0.1


@dataclass(frozen=True, slots=True, eq=False)
class LaserScan:
    """One whole revolution of a lidar: n samples in order of arrival.

    angles_rad: float64[n], counter-clockwise in the lidar's frame, 0 straight ahead, in (-pi, pi].
    ranges_m: float64[n], nan where nothing came back; not clipped to the rated range, because a too-near obstacle is an
    obstacle. quality: uint8[n], strength of the return on the device's own scale, 0 for none.
    started_at, ended_at: arrival of the first and last sample (s of the caller's clock), interpolated in a batch.
    repeats: how many scans in a row were identical in every decoded bit, this one included; a live lidar never gives
    two equal ones, a stuck link does.
    """

    angles_rad: NDArray[np.float64]
    ranges_m: NDArray[np.float64]
    quality: NDArray[np.uint8]
    started_at: float
    ended_at: float
    repeats: int


class RepeatCounter:
    """Counts how many scans in a row were identical, from the raw fields that a driver decoded."""

    def __init__(self) -> None:
        self._digest = b""
        self._repeats = 0

    def count(self, *fields: NDArray[np.generic]) -> int:
        """Return how many scans in a row had exactly these fields, this one included."""
        digest = hashlib.blake2b(digest_size=16)
        for field in fields:
            digest.update(field.tobytes())
        self._repeats = self._repeats + 1 if digest.digest() == self._digest else 1
        self._digest = digest.digest()
        return self._repeats


# --- drivers ----------------------------------------------------------------------------------------------------------


class BaseDriver(Protocol):
    """The conversation with one base. The guardian owns it and decides; the driver only translates."""

    @property
    def drive_train(self) -> DriveTrain:
        """The base's geometry, by its options."""

    @property
    def timing(self) -> BaseTiming:
        """What the guardian waits for with this base."""

    @property
    def corrupted(self) -> int:
        """How many frames came damaged, since the driver was made."""

    def receive_data(self, data: bytes, now: float) -> None:
        """Take what the port gave at `now`, in pieces of any size; never raises on what it is fed."""

    def next_event(self) -> BaseReading | None:
        """Return the oldest valid frame not yet taken, or None: feed more bytes."""

    def wake(self) -> bytes:
        """Return what brings the base into its driving mode with its wheels at rest, and makes it send frames.

        It works whatever the base was doing, also when its receiver stands in the middle of a command.
        """

    def drive(self, left_m_s: float, right_m_s: float) -> bytes:
        """Return the command that turns the wheels at these speeds until the next one; zeros stop them at once."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BaseFactory(Generic[Options]):
    """What a base registers under its name in the entry points `fognav.bases`."""

    options: type[Options]
    make: Callable[[Options], BaseDriver]
    stop: StopCommand


class SerialSettings(NamedTuple):
    """A serial line, always 8N1. `dtr`: the state of the DTR line in which the device runs; None: it does not care."""

    baud: int
    dtr: bool | None = None


@dataclass(frozen=True, slots=True, kw_only=True)
class LidarTraits:
    """Rated ranges (m) and the time of one revolution (s)."""

    range_min_m: float
    range_max_m: float
    scan_period_s: float


class LidarEvents(NamedTuple):
    """What came of some bytes: whether there were samples at all, the whole scans, and what to send."""

    samples: bool = False
    scans: tuple[LaserScan, ...] = ()
    data: bytes = b""


class LidarDriver(Protocol):
    """The conversation with one lidar: talks it into scanning, and begins again after silence or a bad answer."""

    @property
    def serial(self) -> SerialSettings:
        """How its port is set up."""

    @property
    def traits(self) -> LidarTraits:
        """What this lidar can do."""

    @property
    def problem(self) -> str:
        """Why there is no scan, in words; empty while there is one."""

    @property
    def stop_command(self) -> bytes:
        """What ends the scan; empty for a lidar that takes no commands."""

    def begin(self, now: float) -> bytes:
        """Begin (again), after the port was opened; return what to send."""

    def receive(self, data: bytes, now: float) -> LidarEvents:
        """Take what the port gave at `now`, in pieces of any size; never raises on what it is fed."""

    def tick(self, now: float) -> bytes:
        """Let time pass (20 Hz or more); return what to send."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LidarFactory(Generic[Options]):
    """What a lidar registers under its name in the entry points `fognav.lidars`."""

    options: type[Options]
    make: Callable[[Options], LidarDriver]
