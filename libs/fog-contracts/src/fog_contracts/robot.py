"""What is mounted on a robot and how it may move, as its `robot.toml` describes it.

Lengths in m, angles in rad, times in s; x forward, y to the left of the point between the driven wheels (frame `base`).
Every field has a description: the commented file of `fognav robot new` and `docs/robot-settings.md` are made of them.
"""

from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta, field

from fog_contracts.costs import DEGRADED_SPEED

SPEED_MAX_M_S: Final = 0.3
"""No robot drives faster: the ages and distances after which it slows down or stops are made for this speed."""

_Name = Annotated[str, Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$(?!\n)")]
_Offset = Annotated[float, Meta(ge=-1.0, le=1.0)]
_Bearing = Annotated[float, Meta(ge=-6.284, le=6.284)]
_Sector = tuple[_Bearing, _Bearing]
_Vertex = tuple[Annotated[float, Meta(ge=-2.0, le=2.0)], Annotated[float, Meta(ge=-2.0, le=2.0)]]
_Alpha = Annotated[float, Meta(ge=0.0, le=2.0)]
Alphas = tuple[_Alpha, _Alpha, _Alpha, _Alpha]

_PORT: Final = (
    "its serial port by a name that stays: /dev/serial/by-id/... or, where two adapters have the same serial number "
    "(CP2102), /dev/serial/by-path/... (list them: ls -l /dev/serial/by-id /dev/serial/by-path)"
)


class _Table(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """One table of `robot.toml`: a misspelt setting is an error, not a default."""


class BaseSettings(_Table, frozen=True, kw_only=True):
    """The base: its driver, its serial port, and the driver's own options."""

    driver: Annotated[_Name, Meta(description="name of the driver")]
    port: Annotated[str, Meta(description=_PORT)] = ""
    options: Annotated[dict[str, Any], Meta(description="the driver's own options")] = field(default_factory=dict)


class LidarSettings(_Table, frozen=True, kw_only=True):
    """The lidar: its driver, its serial port, and how it is mounted."""

    driver: Annotated[_Name, Meta(description="name of the driver")]
    port: Annotated[str, Meta(description=_PORT)] = ""
    x_m: Annotated[_Offset, Meta(description="the head's axis, ahead of the point between the driven wheels")] = 0.0
    y_m: Annotated[_Offset, Meta(description="the head's axis, to the left of that point")] = 0.0
    yaw_rad: Annotated[
        _Bearing, Meta(description="direction in the robot's frame in which the lidar's zero points, left positive")
    ] = 0.0
    mirrored: Annotated[bool, Meta(description="the lidar hangs upside down")] = False
    latency_s: Annotated[
        Annotated[float, Meta(ge=0.0, le=0.5)],
        Meta(description="time between a measurement and its arrival, beyond that of the line itself"),
    ] = 0.0
    masks: Annotated[
        Annotated[list[_Sector], Meta(max_length=16)],
        Meta(
            description="sectors in which the lidar sees only the robot itself, as [from, to] counter-clockwise in the "
            "robot's frame (0 ahead); what it measures there is dropped"
        ),
    ] = field(default_factory=list)
    options: Annotated[dict[str, Any], Meta(description="the driver's own options")] = field(default_factory=dict)


class CameraSettings(_Table, frozen=True, kw_only=True):
    """The camera that sees markers on the walls, if the robot has one: level sideways, and how its lens maps them."""

    source: Annotated[
        str,
        Meta(
            description="where its pictures come from: a V4L2 device by a name that stays (/dev/v4l/by-id/...), or a "
            "named pipe with grey pictures (PGM, one after another); none: there is no camera"
        ),
    ] = ""
    width_px: Annotated[Annotated[int, Meta(ge=160, le=4096)], Meta(description="width of its pictures")] = 640
    height_px: Annotated[Annotated[int, Meta(ge=120, le=4096)], Meta(description="height of its pictures")] = 480
    focal_px: Annotated[
        Annotated[float, Meta(ge=0.0, le=20_000.0)],
        Meta(description="focal length: how many pixels wide a thing of 1 m is from 1 m away; a camera needs it"),
    ] = 0.0
    centre_px: Annotated[
        Annotated[list[Annotated[float, Meta(ge=0.0, le=4096.0)]], Meta(max_length=2)],
        Meta(description="where the lens's axis meets the picture, as [right, down]; none: its middle"),
    ] = field(default_factory=list)
    distortion: Annotated[
        tuple[Annotated[float, Meta(ge=-2.0, le=2.0)], Annotated[float, Meta(ge=-2.0, le=2.0)]],
        Meta(description="the lens's radial distortion, k1 and k2 of a calibration by OpenCV or ROS"),
    ] = (0.0, 0.0)
    x_m: Annotated[_Offset, Meta(description="the lens, ahead of the point between the driven wheels")] = 0.0
    y_m: Annotated[_Offset, Meta(description="the lens, to the left of that point")] = 0.0
    yaw_rad: Annotated[
        _Bearing, Meta(description="direction in which it looks in the robot's frame, left positive")
    ] = 0.0
    pitch_rad: Annotated[
        Annotated[float, Meta(ge=-1.2, le=1.2)], Meta(description="how far it looks up from the horizontal")
    ] = 0.0
    latency_s: Annotated[
        Annotated[float, Meta(ge=0.0, le=1.0)], Meta(description="time between a picture and its arrival")
    ] = 0.05
    rate_hz: Annotated[
        Annotated[float, Meta(ge=0.2, le=10.0)], Meta(description="pictures a second in which markers are looked for")
    ] = 2.0


class BodySettings(_Table, frozen=True, kw_only=True):
    """The robot's body."""

    footprint: Annotated[
        Annotated[list[_Vertex], Meta(max_length=64)],
        Meta(
            description="corners of the body's outline on the floor, as [x, y], counter-clockwise, convex; none: the "
            "circle of `radius_m`"
        ),
    ] = field(default_factory=list)
    radius_m: Annotated[
        Annotated[float, Meta(ge=0.0, le=2.0)],
        Meta(
            description="how far the body reaches from the point between its driven wheels; 0: the site's `radius`. A "
            "robot without a fog, and so without a site, needs it or `footprint`"
        ),
    ] = 0.0


class OdometrySettings(_Table, frozen=True, kw_only=True):
    """How far the wheels' odometry is trusted."""

    alphas: Annotated[
        Alphas,
        Meta(
            description="noise of the odometry (Thrun, Burgard, Fox 2005, table 5.6): of rotation by rotation, of "
            "rotation by translation, of translation by translation, of translation by rotation"
        ),
    ] = (0.05, 0.05, 0.01, 0.05)
    wheel_ratio: Annotated[
        Annotated[float, Meta(ge=0.8, le=1.25)],
        Meta(description="how far the right wheel rolls where the left one rolls 1 by its counter (fognav calibrate)"),
    ] = 1.0


class MotionSettings(_Table, frozen=True, kw_only=True):
    """How fast the robot may move; the guardian enforces speed and acceleration on its own."""

    speed_m_s: Annotated[
        Annotated[float, Meta(ge=0.05, le=SPEED_MAX_M_S)], Meta(description="top speed while all is well")
    ] = SPEED_MAX_M_S
    degraded_speed_m_s: Annotated[
        Annotated[float, Meta(ge=0.02, le=DEGRADED_SPEED / 100)],
        Meta(description="top speed while the map, the link or the pose is doubtful"),
    ] = DEGRADED_SPEED / 100
    turn_rad_s: Annotated[Annotated[float, Meta(ge=0.2, le=2.75)], Meta(description="top turning rate")] = 2.75
    acceleration_m_s2: Annotated[
        Annotated[float, Meta(ge=0.1, le=2.5)],
        Meta(description="acceleration, at which no wheel slips on the smoothest floor"),
    ] = 1.0
    turn_acceleration_rad_s2: Annotated[
        Annotated[float, Meta(ge=0.2, le=3.2)], Meta(description="angular acceleration")
    ] = 3.2
    jerk_m_s3: Annotated[
        Annotated[float, Meta(ge=0.5, le=50.0)], Meta(description="how fast the acceleration may change")
    ] = 5.0
    turn_jerk_rad_s3: Annotated[
        Annotated[float, Meta(ge=1.0, le=100.0)], Meta(description="how fast the angular acceleration may change")
    ] = 20.0

    def __post_init__(self) -> None:
        if self.degraded_speed_m_s > self.speed_m_s:
            raise ValueError(
                f"degraded_speed_m_s ({self.degraded_speed_m_s}) must not exceed speed_m_s ({self.speed_m_s})"
            )


class PowerSettings(_Table, frozen=True, kw_only=True):
    """When the robot announces that its battery is low, and when it rests."""

    low_fraction: Annotated[
        Annotated[float, Meta(ge=0.0, le=0.9)],
        Meta(description="charge, of 1, below which its state says so; 0: never"),
    ] = 0.2
    dock_below: Annotated[
        Annotated[float, Meta(ge=0.0, le=0.9)],
        Meta(
            description="charge, of 1, below which an enabled robot without a mission drives to its dock by itself; "
            "0: never"
        ),
    ] = 0.0
    rest_after_s: Annotated[
        Annotated[float, Meta(ge=0.0, le=86_400.0)],
        Meta(
            description="idle time after which the robot rests: its lidar, if its motor can be switched, stands still "
            "until a goal or an operator's command wakes it; 0: never"
        ),
    ] = 600.0
    rest_base: Annotated[
        bool,
        Meta(
            description="while the robot rests its base sleeps, too, if a line of the adapter wakes it (a Roomba's "
            "BRC): try it first, single robots do not wake"
        ),
    ] = False


class RobotSettings(_Table, frozen=True, kw_only=True):
    """All of a `robot.toml`."""

    base: BaseSettings
    lidar: LidarSettings
    camera: CameraSettings = CameraSettings()
    body: BodySettings = BodySettings()
    odometry: OdometrySettings = OdometrySettings()
    motion: MotionSettings = MotionSettings()
    power: PowerSettings = PowerSettings()
