"""Settings of the agent (environment FOGNAV_*) besides the common ones, and the files that they name.

Settings of a robot that are valid one by one and make no sense together are refused before anything moves. Without
numpy: the agent looks at them before it loads that.
"""

from __future__ import annotations

import importlib.util
import math
import secrets
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple

import msgspec
from msgspec import Meta, structs

from fog_contracts.commands import KEY_BYTES
from fog_contracts.messages import Id, Pose
from fog_contracts.site import MarkerSite, RobotSite, Site
from fog_runtime.configuration.robot_file import VARIABLES
from fog_runtime.configuration.settings import CommonSettings, SettingsError
from fog_runtime.credentials import NOBODY
from fog_runtime.keys import KeyFileError
from fog_runtime.keys import read_operator_key as read_key
from robot_agent import registry
from robot_agent.footprint import BLIND_SHARE, SECTORS, TRAVEL_HALF_RAD, Footprint, FootprintError
from robot_agent.hardware import DockingDriver, SleepingDriver

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_runtime.configuration.robot_file import RobotFile
    from fog_runtime.credentials import Credentials
    from robot_agent.agent.berths import Berths
    from robot_agent.hardware import BaseDriver, LidarTraits

SITE_FILE: Final = "site.toml"
NO_SITE: Final = "none"
_BODY_TOLERANCE_M: Final = 0.02
CAMERA_LIBRARIES: Final = ("pyapriltags", "linuxpy")
_ADD_RADIUS: Final = "Add how far (m) the robot's body reaches from the point between its driven wheels"


class Settings(CommonSettings, frozen=True, kw_only=True):
    """The robot's id, the seed of its particle filter, and its memory; what is mounted on it is in its robot file.

    `input_log`: file for the log of the core's inputs, for `python -m robot_agent.agent.recording.replay`; some 1.5 MB
    a minute. The log of the previous run is kept beside it.

    `obstacle_memory_s`: how long (s) a reported obstacle counts while no lidar looks there again.

    `fog`: whether there is a fog node. Without one the robot knows no site and no map, nobody can enable it, and it
    moves by hand only: for its bring-up, and until its building has a map.

    `site_dir` has the `site.toml` that the fog node has: this robot's entry says how large it is, where it starts, and
    where its dock is. The map itself comes from the map-service.

    `floors_file`: the floors of its building that the robot knows. Then site, router, keys and `site_dir` are those of
    the floor that it is on, whatever the other settings say.

    `agent_realtime_priority`: of all its threads, below the guardian's; 0 for none. On a clock of another speed: none.
    """

    robot: Id
    guardian_socket: Path
    fog: bool = True
    site_dir: Path = Path()
    floors_file: Path | None = None
    seed: Annotated[int, Meta(ge=0)] = 0
    input_log: Path | None = None
    obstacle_memory_s: Annotated[float, Meta(gt=0.0, le=600.0)] = 600.0
    agent_realtime_priority: Annotated[int, Meta(ge=0, le=9)] = 5


class Given(NamedTuple):
    """What the files say that the settings and the robot's file name, and the driver of the base."""

    site: str
    body: RobotSite
    markers: list[MarkerSite]
    operator_key: bytes
    credentials: Credentials
    footprint: Footprint | None
    base: BaseDriver
    berths: Berths | None = None


def read_given(settings: Settings, robot: RobotFile, berths: Berths | None = None) -> Given:
    """Read all of it, before any device moves and anything slow is loaded; `settings` are those of the floor.

    Raises:
        SettingsError: for a wrong setting or file.
        CredentialsError: for wrong credentials.

    """
    footprint, base = read_footprint(robot), registry.make_base(robot)
    if settings.fog:
        came_by = None if berths is None else berths.berth.came_by
        site, body, markers = read_site(settings, None if came_by is None else came_by.lift)
    else:
        site, body, markers = *without_site(settings.robot, robot, footprint), []
    refuse_contradictions(robot, base)
    _refuse_missing_libraries(robot)
    refuse_body(robot, base, footprint or Footprint.circle(body.radius))
    if footprint is not None and footprint.circumscribed_radius > body.radius + _BODY_TOLERANCE_M:
        raise robot.error(
            "body.footprint" if robot.settings.body.footprint else "body.radius_m",
            f"it reaches {footprint.circumscribed_radius:.2f} m from the point between the driven wheels, and the "
            f"`radius` in {settings.site_dir / SITE_FILE}, by which the fog node knows this robot's echoes, is "
            f"{body.radius:g} m",
            "Correct the one that is wrong, the site's file on the fog node too",
        )
    return Given(
        site=site,
        body=body,
        markers=markers,
        operator_key=read_operator_key(settings.operator_key_file) if settings.fog else secrets.token_bytes(KEY_BYTES),
        credentials=settings.credentials() if settings.fog else NOBODY,
        footprint=footprint,
        base=base,
        berths=berths,
    )


def read_site(settings: Settings, lift: str | None = None) -> tuple[str, RobotSite, list[MarkerSite]]:
    """Return the site's id, its entry of this robot, without which the body is not known, and its markers.

    One that has come by a `lift` starts in its cabin. Raises `SettingsError`.
    """
    file = settings.site_dir / SITE_FILE
    if settings.site_dir == Path() and not file.is_file():
        raise SettingsError(
            "FOGNAV_SITE_DIR is not set, so this robot's body, start and dock are not known. Set it to a folder with "
            f"the fog node's {SITE_FILE} (deploy/robot/install --site {SITE_FILE} copies it and sets it)"
        )
    try:
        site = msgspec.convert(tomllib.loads(file.read_text("utf-8")), Site)
    except OSError as error:
        raise SettingsError(
            f"{file} can't be read: {error.strerror}. Copy the fog node's {SITE_FILE} there, or correct FOGNAV_SITE_DIR"
        ) from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, msgspec.ValidationError) as error:
        remedy = _ADD_RADIUS if "`radius`" in str(error) else "Correct the field that it names"
        raise SettingsError(f"{file}: {error}. {remedy}") from error
    if settings.site not in {"", site.id}:
        raise SettingsError(
            f"FOGNAV_SITE is {settings.site!r}, but {file} describes {site.id!r}, whose start and dock are on another "
            f"map. Copy the {SITE_FILE} of {settings.site!r} there, or remove FOGNAV_SITE"
        )
    for robot in site.robots:
        if robot.id == settings.robot:
            cabins = [each.cabin for each in site.lifts if each.id == lift]
            return site.id, structs.replace(robot, start=cabins[0]) if cabins else robot, site.markers
    known = ", ".join(robot.id for robot in site.robots) or "none"
    raise SettingsError(f"{file}: robots: there is no {settings.robot!r} (known: {known}). Add it, or set FOGNAV_ROBOT")


def without_site(name: str, robot: RobotFile, footprint: Footprint | None) -> tuple[str, RobotSite]:
    """Return what stands for the site's id and entry of a robot without a fog; raises `SettingsError`."""
    if footprint is None:
        raise robot.error(
            "body.radius_m",
            "there is no fog, so no site says how large the robot is",
            "Set it to how far the body reaches from the point between its driven wheels, or set `footprint`",
        )
    return NO_SITE, RobotSite(id=name, start=Pose(x=0.0, y=0.0, theta=0.0), radius=footprint.circumscribed_radius)


def read_footprint(robot: RobotFile) -> Footprint | None:
    """Return the footprint of the robot's settings, None for the site's circle; raises `SettingsError`."""
    if not robot.settings.body.footprint:
        radius = robot.settings.body.radius_m
        return Footprint.circle(radius) if radius else None
    try:
        return Footprint(tuple(robot.settings.body.footprint))
    except FootprintError as error:
        raise robot.error("body.footprint", str(error).rstrip("."), "Correct it") from error


def read_port(robot: RobotFile) -> str:
    """Return the lidar's serial port; raises `SettingsError` if none is set."""
    if not robot.settings.lidar.port:
        raise robot.error("lidar.port", "the lidar's serial port is not set", f"Set it, or {VARIABLES['lidar.port']}")
    return robot.settings.lidar.port


def read_operator_key(file: Path | None) -> bytes:
    """Return the operators' key from a file with its hexadecimal digits; raises `SettingsError`."""
    if file is None:
        raise SettingsError(
            "there is no operators' key, so nobody could enable the robot. Set FOGNAV_OPERATOR_KEY_FILE to a file "
            f"with {2 * KEY_BYTES} or more hexadecimal digits (openssl rand -hex {KEY_BYTES})"
        )
    try:
        return read_key(file)
    except KeyFileError as error:
        raise SettingsError(str(error)) from error


_SECTOR_MIN_RAD: Final = 0.005
"""Less is no sector: a lidar's samples are farther apart."""
_STEPS: Final = 20
"""Directions of a sector that are looked at, 0.25 degrees apart."""
_AXLE_SHARE: Final = 0.8
"""An axle as measured by turns is longer than the true one, by up to a fifth with soft wheels."""

Sector = tuple[float, float]


def refuse_contradictions(robot: RobotFile, base: BaseDriver) -> None:
    """Raise `SettingsError` for settings that contradict one another or the base."""
    _refuse_masks(robot)
    _refuse_speed(robot, base)
    _refuse_power(robot, base)
    _refuse_camera(robot)


def refuse_body(robot: RobotFile, base: BaseDriver, footprint: Footprint) -> None:
    """Raise `SettingsError` for a lidar or wheels outside of the body's outline.

    What sticks out hits what the stop field takes for free, and would be the first to do so.
    """
    lidar = robot.settings.lidar
    outside = footprint.outside_by(lidar.x_m, lidar.y_m)
    if outside > 0.0:
        raise robot.error(
            "lidar.y_m" if abs(lidar.y_m) > abs(lidar.x_m) else "lidar.x_m",
            f"the lidar's axis ({lidar.x_m:g}, {lidar.y_m:g}) is {outside:.3f} m outside of the robot's body, so what "
            "carries it would hit obstacles that the robot believes to pass",
            "Correct x_m and y_m, or let `footprint` of [body] (without one: the site's `radius`) include the lidar",
        )
    half = 0.5 * base.drive_train.axle_m
    outside = max(footprint.outside_by(0.0, side * _AXLE_SHARE * half) for side in (1.0, -1.0))
    if outside > 0.0:
        raise robot.error(
            "body.footprint",
            f"the body's outline does not include the wheels, {half:.3f} m to the left and right of the middle of "
            "their axle",
            "Correct it (without one: the site's `radius`), or `axle_m` of [base.options]",
        )


def remarks(robot: RobotFile, lidar: LidarTraits, footprint: Footprint) -> list[str]:
    """Return what a person may not expect of settings that are no mistake."""
    told = []
    inside, place = -footprint.outside_by(robot.settings.lidar.x_m, robot.settings.lidar.y_m), "lidar.x_m and lidar.y_m"
    if 0.0 <= inside < lidar.range_min_m:
        told.append(
            f"{place}: the lidar measures from {lidar.range_min_m:g} m on, and the body's rim is only {inside:.2f} m "
            "from it: what stands within the rest when the robot is started, or comes in there from aside, it does not "
            "see. Keep that free, or mount the lidar farther from the rim"
        )
    if _hidden(robot.settings.lidar.masks, math.pi) >= BLIND_SHARE:
        told.append("lidar.masks hide the way behind: the robot never drives backwards, nor off a dock")
    if robot.settings.power.rest_base and not lidar.can_rest:
        told.append(
            "power.rest_base has no effect: the motor of this lidar can't be switched, so the robot never rests"
        )
    return told


def _refuse_masks(robot: RobotFile) -> None:
    masks = robot.settings.lidar.masks
    for number, (begin, end) in enumerate(masks, 1):
        width = (end - begin) % math.tau
        if min(width, math.tau - width) < _SECTOR_MIN_RAD:
            raise robot.error(
                "lidar.masks",
                f"mask {number}, [{begin:g}, {end:g}], ends where it begins: that is no direction, or all of them",
                "Give the directions between which the lidar sees the robot itself, counter-clockwise",
            )
    hidden = _hidden(masks, 0.0)
    if hidden >= BLIND_SHARE:
        raise robot.error(
            "lidar.masks",
            f"the masks hide {100 * hidden:.0f} % of the directions within {TRAVEL_HALF_RAD:g} rad of straight ahead, "
            f"and from {100 * BLIND_SHARE:.0f} % on the robot never drives",
            "A mask goes counter-clockwise from its first direction to its second, in the robot's frame (0 ahead): "
            "correct it, or mount the lidar where it sees what is ahead",
        )


def _hidden(masks: Sequence[Sector], heading: float) -> float:
    """Return which share of the sectors of travel is masked whole; `heading`: of the travel, in the robot's frame."""
    width = math.tau / SECTORS
    begins = [sector * width - math.pi for sector in range(SECTORS)]
    travel = [begin for begin in begins if _apart(begin + 0.5 * width, heading) <= TRAVEL_HALF_RAD]
    hidden = [
        all(_is_masked(begin + (step + 0.5) / _STEPS * width, masks) for step in range(_STEPS)) for begin in travel
    ]
    return sum(hidden) / len(travel)


def _is_masked(direction: float, masks: Sequence[Sector]) -> bool:
    return any((direction - begin) % math.tau <= (end - begin) % math.tau for begin, end in masks)


def _apart(one: float, other: float) -> float:
    return abs(math.remainder(one - other, math.tau))


def _refuse_speed(robot: RobotFile, base: BaseDriver) -> None:
    speed, top = robot.settings.motion.speed_m_s, base.drive_train.wheel_speed_max_m_s
    if speed > top:
        raise robot.error(
            "motion.speed_m_s",
            f"{speed:g} m/s is more than the base's wheels can do, {top:g} m/s",
            f"Set it to {top:g} or less, or correct the top speed in [base.options]",
        )


def _refuse_camera(robot: RobotFile) -> None:
    camera = robot.settings.camera
    if camera.source and camera.focal_px == 0.0:
        raise robot.error(
            "camera.focal_px",
            "0, so the camera's pictures tell neither distances nor directions",
            f"Set it as its calibration says, or to {camera.width_px} / (2 tan(half of its horizontal angle of view))",
        )
    if len(camera.centre_px) == 1:
        raise robot.error("camera.centre_px", "it has one number", "Give [right, down] in pixels, or [] for the middle")


def _refuse_missing_libraries(robot: RobotFile) -> None:
    missing = [name for name in CAMERA_LIBRARIES if importlib.util.find_spec(name) is None]
    if robot.settings.camera.source and missing:
        raise robot.error(
            "camera.source",
            f"a camera needs {' and '.join(missing)}, which are not installed",
            "Install requirements/robot-camera.txt (docs/robot-setup.md), or remove `source`",
        )


def _refuse_power(robot: RobotFile, base: BaseDriver) -> None:
    power, driver = robot.settings.power, robot.settings.base.driver
    if power.dock_below > 0.0 and not isinstance(base, DockingDriver):
        raise robot.error(
            "power.dock_below",
            f"{power.dock_below:g}, but a {driver} does not drive into a dock by itself",
            "Set it to 0: `low_fraction` announces a low battery",
        )
    if not power.rest_base:
        return
    if not isinstance(base, SleepingDriver):
        raise robot.error("power.rest_base", f"true, but a {driver} can't be put to sleep", "Set it to false")
    if base.awakening.line is None:
        raise robot.error(
            "power.rest_base",
            "true, but no control line could wake the base again, so it would be left awake",
            "Set `brc` of [base.options] to the adapter's line that is wired to the BRC pin, or rest_base to false",
        )
    if power.rest_after_s == 0.0:
        raise robot.error(
            "power.rest_base",
            "true, but with rest_after_s = 0 the robot never rests",
            "Set rest_after_s to the idle time after which it does, or rest_base to false",
        )
