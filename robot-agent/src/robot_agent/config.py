"""Configuration of the robot's pure parts, as plain values; defaults are the thesis's where the base can do them.

Lengths in m, angles in rad, times in s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Final

from fog_contracts.channels import MAP_HEARTBEAT, ROBOT_RELEASE
from fog_contracts.costs import DEFAULT_INFLATION, DEGRADED_SPEED, ROBOT_RADIUS, Inflation
from fog_contracts.messages import Berth, Pose  # noqa: TC001  # read at run time, when a configuration is decoded
from fog_contracts.robot import MotionSettings
from fog_contracts.site import MarkerSite  # noqa: TC001  # read at run time, when a configuration is decoded
from fog_kernels.dwa import DwaLimits, DwaSettings
from robot_agent.footprint import BLIND_SHARE, TRAVEL_HALF_RAD, Footprint
from robot_agent.hardware import DriveTrain  # noqa: TC001  # read at run time, when a configuration is decoded

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.robot import RobotSettings
    from fog_contracts.site import RobotSite
    from robot_agent.hardware import LidarTraits

LOCAL_INFLATION: Final = Inflation(
    inscribed_radius=DEFAULT_INFLATION.inscribed_radius, inflation_radius=0.45, cost_scaling=8.0
)
"""Inflation of lidar points in the local window: narrower and steeper than the map's, because the robot sees where an
obstacle really is and may pass it closely, whereas the map's costs keep whole paths in the middle of corridors."""


_LOST_AFTER_REVOLUTIONS: Final = 2.4
"""Without a whole scan for so many revolutions the scan counts as lost."""
_REMEMBERED_REVOLUTIONS: Final = 2.5
"""For so many revolutions, at least, the stop field remembers what a lidar saw: half of one would be half of what is
there."""
_WHEEL_SPEED_MAX: Final = 0.5
"""No wheel turns faster (m/s), whatever the base can do."""
_TURNED_BACK_S: Final = 4.0
"""A robot whose turning rate is not limited has turned round so soon on its way out of a blocked area."""


@dataclass(frozen=True, slots=True, kw_only=True)
class SafetyConfig:
    """Limits of the safety gate: speeds in m/s, ages and durations in s."""

    speed_normal: float = 0.30
    speed_degraded: float = DEGRADED_SPEED / 100
    speed_egress: float = 0.10
    speed_back_off: float = 0.05
    speed_teleop: float = 0.15
    turn_teleop: float = 1.0
    """rad/s. Slower is better while a map is recorded."""
    hand_fresh: float = 0.15
    """A speed given by hand counts for this long: three of its messages."""
    hand_silent: float = 3.0
    """Without a word of who drives it by hand for this long, the robot is disabled."""
    relax_after: float = 2.0
    map_late: float = MAP_HEARTBEAT.max_age_s
    map_lost: float = 3.0
    gap_lost: float = 1.0
    plan_late: float = ROBOT_RELEASE.max_age_s
    released_end: float = 0.15
    """With less released path ahead (m) the robot has come to its end, within the goal tolerance."""
    lidar_lost: float = 0.3
    scan_lost: float = 0.45
    identical_scans: int = 3
    empty_scans: int = 2
    """So many in a row with less than `returns_least`; one alone may be a moment's glare."""
    returns_least: float = 0.03
    """Share of a scan's samples with a return. In rooms, recorded lidars had 44 % at least, and a robot that faces half
    a hall out of their range has more than this, too."""
    base_lost: float = 0.3
    position_sigma_max: float = 0.8
    """A robot whose position has a larger standard deviation (m) in some direction does not drive a mission: one in
    twenty would be more than 1.6 m from where it believes to be."""
    hold_needs_operator_after: float = 60.0
    stops_to_fault: int = 3
    stops_within: float = 60.0
    late: float = 0.15
    """The agent streams every 0.05 s, idle every 0.1 s; when it did not for this long, its computer ran it too late."""
    late_explains: float = 0.5
    """For how long such a delay explains old sensor data: until another scan and messages of the guardian are in."""
    ramp: float = 0.5
    """Time in which a ramp brings the fastest possible wheel to rest."""
    egress_max: float = 60.0
    egress_stall: float = 10.0
    """How long what is left of a maneuver may not shrink by `egress_step`: planning and turning take some seconds."""
    egress_step: float = 0.05
    """m, of a turn rad."""
    egress_back: float = 0.10
    """By how much (m, of a turn rad) what is left may grow again: the pose's noise."""
    egress_end: float = 0.05
    """The way out is driven to within this (m) of its end."""
    dock_max: float = 60.0
    dock_settled: float = 1.0
    """For how long (s) the dock must have contact until the base has found it."""
    undock_max: float = 15.0
    back_off_max: float = 5.0
    turn_max: float = 30.0
    advance_max: float = 15.0


@dataclass(frozen=True, slots=True, kw_only=True)
class StopFieldConfig:
    """Limits of the stop field; lengths in m, times in s, speeds in m/s."""

    margin: float = 0.02
    """How far from a lidar point the body comes to rest: twice the error of a near range."""
    reaction: float = 0.25
    """How long a command may act: 0.05 s to the next one, and 0.2 s until the guardian ends it when none comes."""
    slowest: float = 0.01
    """A slower wheel is a standing one."""
    memory: float = 0.5
    """How long a lidar point counts: two turns and a half, because thin and dark things are not seen in each; longer
    for a lidar that turns more slowly than 5 times a second or whose samples arrive late."""


@dataclass(frozen=True, slots=True, kw_only=True)
class VisibilityConfig:
    """When missing returns of the lidar in the direction of travel slow or stop the robot; m, rad, m/s, shares."""

    half_width: float = TRAVEL_HALF_RAD
    range_share: float = 0.75
    range_max: float = 6.0
    """A return is expected of walls within this range, and within `range_share` of the lidar's rated range."""
    speed: float = 0.10
    missing_slow: float = 0.5
    missing_refused: float = 0.9
    blind_slow: float = 0.1
    blind_refused: float = BLIND_SHARE
    """Shares of the sectors of travel without an expected return, and without any sample."""
    lift: float = 0.7
    """A limit ends below this part of the share at which it began."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LocalizationConfig:
    """Particle filter (Thrun, Burgard, Fox 2005; KLD sampling by Fox 2003) and the likelihood field's model."""

    particles_min: int = 500
    particles_max: int = 2000
    particles_start: int = 2000
    kld_error: float = 0.05
    kld_z: float = 2.326
    bin_xy: float = 0.25
    bin_theta: float = 0.1745
    beams: int = 60
    z_hit: float = 0.5
    z_rand: float = 0.5
    sigma_hit: float = 0.2
    field_reach: float = 2.0
    sharpness: float = 12.0
    """Logarithm of the weight ratio between a pose that all beams fit and one that none fits."""
    alphas: tuple[float, float, float, float] = (0.05, 0.05, 0.01, 0.05)
    """Variances of the odometry's noise per squared motion, over steps of `update_distance` and `update_angle`:
    rotation from rotation, rotation from translation, translation from translation, translation from rotation."""
    update_distance: float = 0.1
    update_angle: float = 0.1
    match_sigma: float = 0.08
    """Standard deviation (m) of a beam's end when the estimate is refined by matching the scan."""
    range_min: float = 0.15
    range_max: float = 12.0
    lidar_x: float = 0.0
    lidar_y: float = 0.0
    lidar_yaw: float = 0.0
    lidar_mirrored: bool | None = None
    lidar_latency: float | None = None
    """With these two its scans are corrected before they arrive: a recording says with which, older ones don't."""
    markers: tuple[MarkerSite, ...] = ()
    """The markers of the site; without any, sightings change nothing."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MotionConfig:
    """Path follower and dynamic window (Fox, Burgard, Thrun 1997): the base's limits, and how arcs are chosen."""

    limits: DwaLimits
    arcs: DwaSettings = field(default_factory=partial(DwaSettings, goal_tolerance=0.06, heading_tolerance=0.12))
    """At a goal the pose that is believed may be 4 cm and 3 degrees off, and the robot shall truly be within 0.10 m and
    0.17 rad of it."""
    jerk_v: float = 5.0
    jerk_w: float = 20.0
    """How fast (m/s3, rad/s3) the accelerations may grow."""
    arrived_within: float = 0.09
    """A robot that has come within its tolerance of the goal drives on only beyond this distance (m): it turns to the
    goal's heading, whatever the noise of its pose says meanwhile."""
    window: float = 2.0
    inflation: Inflation = LOCAL_INFLATION
    stuck_after: float = 10.0
    slow_within: float = 0.12
    """Free space (m) beside the body from which on the robot passes at full speed."""
    speed_narrow: float = 0.10
    """Speed (m/s) where there is hardly any."""
    lookahead_narrow: float = 0.2
    """Share of the lookahead that remains there."""
    path_narrow: float = 16.0
    """How many times more the distance from the path counts there: a curve must not be cut."""


@dataclass(frozen=True, slots=True, kw_only=True)
class AgentConfig:
    """Configuration of one robot's agent."""

    robot: str
    operator_key: bytes
    boot: str
    """Id of this run of the agent: operators' commands name it."""
    drive_train: DriveTrain
    motion: MotionConfig
    footprint: Footprint = field(default_factory=partial(Footprint.circle, ROBOT_RADIUS))
    radius: float = ROBOT_RADIUS
    """Radius of a circle around the body, which the robot tells others."""
    height: float = 0.35
    decision_max_age: float = 0.4
    obstacle_ttl: float = 600.0
    """How long (s) a reported obstacle counts while no lidar looks there again: longer than a detour takes."""
    obstacle_limit: int = 400
    rest_after: float = 0.0
    """How long (s) an idle robot waits before it rests, with its lidar's motor at a standstill; 0: it never does."""
    rest_base: bool = False
    """Whether its base sleeps then, too."""
    battery_low: float = 0.2
    """Charge (of 1) below which the robot announces a low battery."""
    dock_below: float = 0.0
    """Charge (of 1) below which an enabled robot without a mission goes to its dock by itself; 0: never."""
    finds_dock: bool = False
    """Whether the base drives into its dock by itself."""
    dock: Pose | None = None
    """The robot's pose (frame `map`) on its dock; None if its site gives none."""
    staging: Pose | None = None
    """Where it goes before the base looks for the dock."""
    berth: Berth | None = None
    """The floor that the robot is on, by its own record; None if it knows no other."""
    floors: tuple[str, ...] = ()
    """All floors that it knows."""
    resumes: bool = False
    """Whether it was enabled when it left the last floor just now: it may drive on once nothing else keeps it."""
    safety: SafetyConfig = field(default_factory=SafetyConfig)
    stop_field: StopFieldConfig = field(default_factory=StopFieldConfig)
    visibility: VisibilityConfig = field(default_factory=VisibilityConfig)
    localization: LocalizationConfig = field(default_factory=LocalizationConfig)


def agent_config(  # noqa: PLR0913  # what the process knows about its robot
    robot: str,
    operator_key: bytes,
    drive_train: DriveTrain,
    lidar: LidarTraits,
    body: RobotSite | None = None,
    *,
    boot: str,
    obstacle_ttl: float | None = None,
    footprint: Footprint | None = None,
    settings: RobotSettings | None = None,
    finds_dock: bool = False,
    markers: Sequence[MarkerSite] = (),
) -> AgentConfig:
    """Return the configuration of a robot with this id, base and lidar, and the radius and height that its site gives.

    boot: id of this run of the agent, never used before.
    obstacle_ttl: how long (s) a reported obstacle counts while no lidar looks there again; None for the default.
    footprint: outline of the body; None for the circle of the site's radius.
    settings: the robot's own settings; None for the defaults.
    finds_dock: whether the base drives into its dock by itself.
    markers: those of the site, by which a robot with a camera knows its place.
    """
    limits = DwaLimits(axle=drive_train.axle_m, wheel_max=min(_WHEEL_SPEED_MAX, drive_train.wheel_speed_max_m_s))
    scan_lost = max(SafetyConfig().scan_lost, _LOST_AFTER_REVOLUTIONS * lidar.scan_period_s)
    config = AgentConfig(
        robot=robot,
        operator_key=operator_key,
        boot=boot,
        drive_train=drive_train,
        motion=MotionConfig(limits=limits),
        localization=LocalizationConfig(
            range_min=lidar.range_min_m,
            range_max=lidar.range_max_m,
            markers=tuple(markers),
            lidar_mirrored=False,
            lidar_latency=0.0,
        ),
        safety=SafetyConfig(scan_lost=scan_lost),
        stop_field=StopFieldConfig(memory=max(StopFieldConfig().memory, _REMEMBERED_REVOLUTIONS * lidar.scan_period_s)),
    )
    if obstacle_ttl is not None:
        config = replace(config, obstacle_ttl=obstacle_ttl)
    if body is not None:
        config = replace(config, height=body.height, dock=body.dock, staging=body.staging, finds_dock=finds_dock)
    if footprint is not None:
        radius, inscribed = footprint.circumscribed_radius, footprint.inscribed_radius
    else:
        radius = inscribed = config.radius if body is None else body.radius
        footprint = Footprint.circle(radius)
    inflation = replace(config.motion.inflation, inscribed_radius=inscribed)
    config = replace(config, footprint=footprint, radius=radius, motion=replace(config.motion, inflation=inflation))
    config = _with_motion(config, MotionSettings() if settings is None else settings.motion)
    return config if settings is None else _with_settings(config, settings, can_rest=lidar.can_rest)


def _with_motion(config: AgentConfig, motion: MotionSettings) -> AgentConfig:
    """Return the configuration of a robot that may move so."""
    limits = replace(
        config.motion.limits,
        v_max=motion.speed_m_s,
        w_max=motion.turn_rad_s,
        acc_v=motion.acceleration_m_s2,
        acc_w=motion.turn_acceleration_rad_s2,
    )
    creep = min(config.safety.speed_egress, motion.degraded_speed_m_s)
    longer = config.safety.speed_egress / creep
    safety = replace(
        config.safety,
        speed_normal=motion.speed_m_s,
        speed_degraded=motion.degraded_speed_m_s,
        speed_egress=creep,
        speed_teleop=min(config.safety.speed_teleop, motion.degraded_speed_m_s),
        turn_teleop=min(config.safety.turn_teleop, motion.turn_rad_s),
        # What is left of the way does not shrink while it turns.
        egress_stall=config.safety.egress_stall + max(0.0, math.pi / motion.turn_rad_s - _TURNED_BACK_S),
        undock_max=config.safety.undock_max * longer,
        advance_max=config.safety.advance_max * longer,
    )
    moving = replace(config.motion, limits=limits, jerk_v=motion.jerk_m_s3, jerk_w=motion.turn_jerk_rad_s3)
    return replace(config, motion=moving, safety=safety)


def _with_settings(config: AgentConfig, settings: RobotSettings, *, can_rest: bool) -> AgentConfig:
    """Return the configuration with the robot's lidar, odometry's noise and battery as in its settings."""
    rest_after = settings.power.rest_after_s if can_rest else 0.0
    lidar = settings.lidar
    localization = replace(
        config.localization,
        alphas=settings.odometry.alphas,
        lidar_x=lidar.x_m,
        lidar_y=lidar.y_m,
        lidar_yaw=lidar.yaw_rad,
        lidar_mirrored=lidar.mirrored,
        lidar_latency=lidar.latency_s,
    )
    # A point is as old as its measurement: one that arrives late must not count for less time than others.
    stop_field = replace(config.stop_field, memory=config.stop_field.memory + lidar.latency_s)
    return replace(
        config,
        drive_train=replace(config.drive_train, wheel_ratio=settings.odometry.wheel_ratio),
        localization=localization,
        stop_field=stop_field,
        battery_low=settings.power.low_fraction,
        dock_below=settings.power.dock_below,
        rest_after=rest_after,
        rest_base=settings.power.rest_base,
    )
