"""Neutral values of bases and lidars, and the interfaces of their drivers.

A driver is a protocol without I/O (as in h11): bytes and arrival times in, events out, commands out as bytes. It knows
no port and no clock, so tests can feed it single bytes, damaged bytes and recordings.

Units are m, rad, s; `now` is the caller's monotonic clock.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Final, Generic, Literal, NamedTuple, Protocol, TypeVar, runtime_checkable

import msgspec
from msgspec import Meta

from fog_contracts.messages import Code, Finite, Power, Sentence, Strength

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from fog_contracts.messages import Reason
    from robot_agent.device_signature import SerialSettings, StopCommand

NO_FRESH_COMMAND: Final = "no fresh command from the agent"
"""Why the guardian keeps the wheels at zero when the agent is silent or late."""

ON_CHARGER: Final = "the base is on its charger, where it does not drive"
"""Why the guardian keeps the wheels at zero while a charger is connected."""

ASLEEP: Final = "the base is asleep to save power"
"""Why the guardian keeps the wheels at zero while the agent lets the base rest."""

Options = TypeVar("Options", bound=msgspec.Struct)
"""A driver's own options: a frozen struct whose fields name their units and that refuses unknown fields."""


# --- values -----------------------------------------------------------------------------------------------------------


class Twist(NamedTuple):
    """Motion of the robot's body: forward speed `v` in m/s, turning rate `w` in rad/s, counter-clockwise positive."""

    v: float
    w: float


class WheelOdometry(msgspec.Struct, frozen=True, kw_only=True):
    """Travel of each wheel by its encoder (m, forward positive), from an arbitrary origin.

    The counters wrap at the drive train's `travel_wrap_m` and start anywhere when the base restarts: only differences
    are meaningful, and `robot_agent.localization.odometry` rejects the implausible ones.
    """

    left_m: Finite
    right_m: Finite


class BaseStatus(msgspec.Struct, frozen=True, kw_only=True):
    """State that a base reports. A missing sensor is False, a missing number None.

    `overcurrent`: a wheel motor draws too much current. `battery`: charged fraction. `charging`: a charger is
    connected. `docked`: it is that of the dock, and no cable is plugged in. `power`: what it measures of battery and
    charger. `proximity`: strengths of its light sensors from the left to the right, in its own unit. `mode_problem`:
    why the base does not obey wheel commands (None: it is in its driving mode), `mode_code` its identifier, of the
    driver's own (`fog_contracts.messages.Described`).
    """

    bumper_left: bool = False
    bumper_right: bool = False
    cliff: bool = False
    wheel_drop: bool = False
    overcurrent: bool = False
    battery: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None
    charging: bool = False
    docked: bool = False
    power: Power | None = None
    proximity: tuple[Strength, ...] = ()
    mode_problem: Sentence | None = None
    mode_code: Code = ""

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
    """A differential drive: two driven wheels on one axle.

    `axle_m`: distance between the wheels. `wheel_speed_max_m_s`: top speed of a wheel. `travel_wrap_m`: the travel at
    which the encoders' counters wrap (infinite: never). `deceleration_m_s2`: how fast a wheel that is commanded to zero
    comes to rest, at least, with the heaviest load on the smoothest floor. `wheel_ratio`: how far the right wheel rolls
    where the left one rolls 1 by its counter.
    """

    axle_m: float
    wheel_speed_max_m_s: float
    travel_wrap_m: float = math.inf
    deceleration_m_s2: float = 1.0
    wheel_ratio: float = 1.0

    @property
    def shares(self) -> tuple[float, float]:
        """How far the left and the right wheel roll, as a share of what their counters and speeds say; 1 on average."""
        return 2.0 / (1.0 + self.wheel_ratio), 2.0 * self.wheel_ratio / (1.0 + self.wheel_ratio)

    def twist(self, left_m_s: float, right_m_s: float) -> Twist:
        """Return the body's motion at these wheel speeds."""
        return Twist((left_m_s + right_m_s) / 2, (right_m_s - left_m_s) / self.axle_m)


class WakeLine(NamedTuple):
    """A control line of the serial adapter that wakes the base while it is asserted: its name, and for how long (s)."""

    name: Literal["rts", "dtr"]
    seconds: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Awakening:
    """What may help a base that does not answer.

    bauds: rates of its serial line, the configured one first. line: the control line that wakes it, None without one.
    remedy: what a person can do, for the message after all was tried.
    """

    bauds: tuple[int, ...]
    line: WakeLine | None = None
    remedy: str = "check its cable and power"


@dataclass(frozen=True, slots=True, kw_only=True)
class BaseTiming:
    """Timeouts of the guardian for this base, s.

    `frame_timeout`: no valid frame for this long is a fault. `wake_timeout`: the base may take this long to report its
    driving mode before it is woken again. `ignored_after_wake`: frames that arrive sooner after waking may be older.
    `frame_s`: the time between two frames; 0: not known, or not constant.
    """

    frame_timeout: float = 0.3
    wake_timeout: float = 1.0
    ignored_after_wake: float = 0.1
    frame_s: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class LaserScan:
    """One whole revolution of a lidar: n samples in order of arrival.

    angles_rad: float64[n], counter-clockwise in the lidar's frame, 0 straight ahead, in (-pi, pi].
    ranges_m: float64[n], nan without a return; not clipped to the rated range, because a too-near obstacle is an
    obstacle. quality: uint8[n], strength of the return on the device's own scale, 0 for none.
    started_at, ended_at: arrival of the first and last sample (s of the caller's clock), interpolated in a batch.
    repeats: 1, and 1 more for each scan in a row that is identical, in every decoded bit, to one of the 64 before it,
    this one included. A working lidar never gives two equal ones; a stuck link or a driver that replays a buffer does.
    masked: bool[n], the samples that look at the robot itself, nan whatever they met; None: there are none. They stay
    in their places, because the times of the others follow from their order.
    """

    angles_rad: NDArray[np.float64]
    ranges_m: NDArray[np.float64]
    quality: NDArray[np.uint8]
    started_at: float
    ended_at: float
    repeats: int
    masked: NDArray[np.bool_] | None = None

    def unmasked(self) -> LaserScan:
        """Return the scan without its masked samples, which say nothing of what is there: not for times of samples."""
        if self.masked is None:
            return self
        seen = ~self.masked
        return replace(
            self, angles_rad=self.angles_rad[seen], ranges_m=self.ranges_m[seen], quality=self.quality[seen],
            masked=None,
        )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class LidarSamples:
    """The newest n samples of a lidar, before their scan is whole, in order of arrival.

    angles_rad, ranges_m: float32[n] as in `LaserScan`. started_at, ended_at: arrival of the first and last sample (s of
    the caller's clock); those between arrive evenly.
    """

    angles_rad: NDArray[np.float32]
    ranges_m: NDArray[np.float32]
    started_at: float
    ended_at: float


# --- drivers ----------------------------------------------------------------------------------------------------------


class BaseDriver(Protocol):
    """Protocol of one base: bytes to readings, commands to bytes. The guardian owns it and makes the decisions."""

    @property
    def drive_train(self) -> DriveTrain:
        """The base's geometry, by its options."""

    @property
    def timing(self) -> BaseTiming:
        """Timeouts of the guardian for this base."""

    @property
    def awakening(self) -> Awakening:
        """What may help when this base does not answer."""

    @property
    def corrupted(self) -> int:
        """Number of damaged frames since the driver was made."""

    def receive_data(self, data: bytes, now: float) -> None:
        """Parse bytes received at `now`, in pieces of any size; never raises, whatever the bytes are."""

    def next_event(self) -> BaseReading | None:
        """Return the oldest valid frame not yet returned; None until more bytes are received."""

    def wake(self) -> bytes:
        """Return the bytes that bring the base into its driving mode, wheels at rest, and make it send frames.

        They work in any state of the base, also when its receiver is in the middle of a command.
        """

    def respond(self) -> bytes:
        """Return the next bytes of waking, once what was received calls for them; empty otherwise."""

    def use_baud(self, baud: int) -> None:
        """Speak at another of the `awakening`'s rates from the next `wake` on."""

    def drive(self, left_m_s: float, right_m_s: float) -> bytes:
        """Return the command that turns the wheels at these speeds until the next one; zeros stop them at once."""


@runtime_checkable
class SleepingDriver(Protocol):
    """What the driver of a base adds that can be put to sleep, and woken by its `awakening`'s line."""

    def sleep(self) -> bytes:
        """Return the bytes that put it to sleep: it neither moves nor hears anything then."""


@runtime_checkable
class DockingDriver(Protocol):
    """What the driver of a base adds if the base finds and enters its dock by itself.

    Between `seek_dock` or `leave_dock` and `take_control` the modes that belong to it are no `mode_problem`.
    """

    def seek_dock(self) -> bytes:
        """Return the bytes that let the base's own program drive it into its dock."""

    def leave_dock(self) -> bytes:
        """Return the bytes after which it obeys wheel commands on its dock, too; empty while it is not ready."""

    def take_control(self, *, charging: bool) -> bytes:
        """Return the bytes that stop it at once, and bring it into its driving mode again; a charging one charges."""


@dataclass(frozen=True, slots=True, kw_only=True)
class BaseFactory(Generic[Options]):
    """The object that a base registers under its name in the entry points `fognav.bases`."""

    options: type[Options]
    make: Callable[[Options], BaseDriver]
    stop: StopCommand


@dataclass(frozen=True, slots=True, kw_only=True)
class LidarTraits:
    """Rated ranges (m), the time of one revolution (s), and whether it can stand still while the robot rests."""

    range_min_m: float
    range_max_m: float
    scan_period_s: float
    can_rest: bool = False


class LidarEvents(NamedTuple):
    """Result of received bytes: the samples in them (None without any), the whole scans, and bytes to send."""

    samples: LidarSamples | None = None
    scans: tuple[LaserScan, ...] = ()
    data: bytes = b""


class LidarDriver(Protocol):
    """Protocol of one lidar: starts its scan, and restarts it after silence or a bad answer."""

    @property
    def serial(self) -> SerialSettings:
        """Settings of its serial port."""

    @property
    def traits(self) -> LidarTraits:
        """Rated ranges and scan period of this lidar."""

    @property
    def problem(self) -> Reason | Literal[""]:
        """Why there is no scan, with an identifier of the driver's own; empty while scans arrive."""

    @property
    def corrupted(self) -> int:
        """Number of damaged packets so far, and of places where the boundary of packets was lost."""

    @property
    def stop_command(self) -> bytes:
        """Bytes that end the scan; empty for a lidar that takes no commands."""

    def begin(self, now: float) -> bytes:
        """Begin (again), after the port was opened; return the bytes to send."""

    def receive(self, data: bytes, now: float) -> LidarEvents:
        """Parse bytes received at `now`, in pieces of any size; never raises, whatever the bytes are."""

    def tick(self, now: float) -> bytes:
        """Advance time (20 Hz or more); return the bytes to send."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LidarFactory(Generic[Options]):
    """The object that a lidar registers under its name in the entry points `fognav.lidars`."""

    options: type[Options]
    make: Callable[[Options], LidarDriver]
