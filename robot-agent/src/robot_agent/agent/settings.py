"""Settings of the agent (environment FOGNAV_*) besides the common ones, and the files that they name."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple

import msgspec
from msgspec import Meta

from fog_contracts.commands import KEY_BYTES
from fog_contracts.messages import Id
from fog_contracts.site import Site
from fog_runtime.configuration.robot_file import VARIABLES
from fog_runtime.configuration.settings import CommonSettings, SettingsError
from fog_runtime.operator_key import OperatorKeyError
from fog_runtime.operator_key import read_operator_key as read_key
from robot_agent import registry
from robot_agent.contradictions import refuse_body, refuse_contradictions
from robot_agent.footprint import Footprint, FootprintError

if TYPE_CHECKING:
    from fog_contracts.site import RobotSite
    from fog_runtime.configuration.robot_file import RobotFile
    from fog_runtime.credentials import Credentials
    from robot_agent.hardware import BaseDriver

SITE_FILE: Final = "site.toml"
_BODY_TOLERANCE_M: Final = 0.02
_ADD_RADIUS: Final = "Add how far (m) the robot's body reaches from the point between its driven wheels"


class Settings(CommonSettings, frozen=True, kw_only=True):
    """The robot's id, the seed of its particle filter, and its memory; what is mounted on it is in its robot file.

    `input_log`: file for the log of the core's inputs, for `python -m robot_agent.agent.recording.replay`; some 1.5 MB
    a minute. The log of the previous run is kept beside it.

    `obstacle_memory_s`: how long (s) a reported obstacle counts while no lidar looks there again.

    `site_dir` has the `site.toml` that the fog node has: this robot's entry says how large it is, where it starts, and
    where its dock is. The map itself comes from the map-service.

    `agent_realtime_priority`: of all its threads, below the guardian's; 0 for none. On a clock of another speed: none.
    """

    robot: Id
    guardian_socket: Path
    site_dir: Path = Path()
    seed: Annotated[int, Meta(ge=0)] = 0
    input_log: Path | None = None
    obstacle_memory_s: Annotated[float, Meta(gt=0.0, le=600.0)] = 600.0
    agent_realtime_priority: Annotated[int, Meta(ge=0, le=9)] = 5


class Given(NamedTuple):
    """What the files say that the settings and the robot's file name, and the driver of the base."""

    site: str
    body: RobotSite
    operator_key: bytes
    credentials: Credentials
    footprint: Footprint | None
    base: BaseDriver


def read_given(settings: Settings, robot: RobotFile) -> Given:
    """Read all of it, before any device moves and anything slow is loaded.

    Raises:
        SettingsError: for a wrong setting or file.
        CredentialsError: for wrong credentials.

    """
    footprint, base = read_footprint(robot), registry.make_base(robot)
    site, body = read_site(settings)
    refuse_contradictions(robot, base)
    refuse_body(robot, base, footprint or Footprint.circle(body.radius))
    if footprint is not None and footprint.circumscribed_radius > body.radius + _BODY_TOLERANCE_M:
        raise robot.error(
            "body.footprint",
            f"it reaches {footprint.circumscribed_radius:.2f} m from the point between the driven wheels, and the "
            f"`radius` in {settings.site_dir / SITE_FILE}, by which the fog node knows this robot's echoes, is "
            f"{body.radius:g} m",
            "Correct the one that is wrong, the site's file on the fog node too",
        )
    return Given(
        site=site,
        body=body,
        operator_key=read_operator_key(settings.operator_key_file),
        credentials=settings.credentials(),
        footprint=footprint,
        base=base,
    )


def read_site(settings: Settings) -> tuple[str, RobotSite]:
    """Return the site's id and its entry of this robot, without which the body is not known; raises `SettingsError`."""
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
            return site.id, robot
    known = ", ".join(robot.id for robot in site.robots) or "none"
    raise SettingsError(f"{file}: robots: there is no {settings.robot!r} (known: {known}). Add it, or set FOGNAV_ROBOT")


def read_footprint(robot: RobotFile) -> Footprint | None:
    """Return the footprint of the robot's settings, None for the site's circle; raises `SettingsError`."""
    if not robot.settings.body.footprint:
        return None
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
    except OperatorKeyError as error:
        raise SettingsError(str(error)) from error
