"""Parts of a robot by name: base and lidar as its settings name them, with their own options, and profiles."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from fog_runtime.configuration import parts
from fog_runtime.configuration.settings import SettingsError
from robot_agent.device_signature import Signature
from robot_agent.hardware import BaseFactory, LidarFactory
from robot_agent.profiles import ENTRY_POINTS, FOG, Profile, ProfileError

if TYPE_CHECKING:
    import msgspec

    from fog_contracts.messages import ProfileName
    from fog_runtime.configuration.robot_file import RobotFile
    from robot_agent.hardware import BaseDriver, LidarDriver

BASES: Final = "fognav.bases"
LIDARS: Final = "fognav.lidars"
SIGNATURES: Final = "fognav.device_signatures"


def base_factory(robot: RobotFile) -> BaseFactory[Any]:
    """Return what the base's package registered under its name; raises `SettingsError`."""
    try:
        factory: BaseFactory[Any] = parts.load(BASES, robot.settings.base.driver, BaseFactory)
    except parts.PartError as error:
        raise robot.error("base.driver", str(error).rstrip(".")) from error
    return factory


def lidar_factory(robot: RobotFile) -> LidarFactory[Any]:
    """Return what the lidar's package registered under its name; raises `SettingsError`."""
    try:
        factory: LidarFactory[Any] = parts.load(LIDARS, robot.settings.lidar.driver, LidarFactory)
    except parts.PartError as error:
        raise robot.error("lidar.driver", str(error).rstrip(".")) from error
    return factory


def signatures() -> dict[str, Signature]:
    """Return how each installed device sounds on its line; raises `SettingsError`."""
    try:
        return {name: parts.load(SIGNATURES, name, Signature) for name in parts.names(SIGNATURES)}
    except parts.PartError as error:
        raise SettingsError(str(error)) from error


def options(robot: RobotFile) -> tuple[msgspec.Struct, msgspec.Struct]:
    """Return the options of base and lidar, each as its driver's own type; raises `SettingsError`."""
    return (
        robot.options("base", base_factory(robot).options),
        robot.options("lidar", lidar_factory(robot).options),
    )


def make_base(robot: RobotFile) -> BaseDriver:
    """Make the driver of the robot's base; raises `SettingsError`."""
    factory = base_factory(robot)
    return factory.make(robot.options("base", factory.options))


def make_lidar(robot: RobotFile) -> LidarDriver:
    """Make the driver of the robot's lidar, as it is mounted; raises `SettingsError`."""
    from robot_agent.scan_builder import MountedLidar, Mounting  # noqa: PLC0415  # numpy: the guardian needs none

    factory = lidar_factory(robot)
    driver = factory.make(robot.options("lidar", factory.options))
    given = robot.settings.lidar
    mounting = Mounting(
        yaw_rad=given.yaw_rad, mirrored=given.mirrored, latency_s=given.latency_s, masks=tuple(given.masks)
    )
    return driver if mounting.plain else MountedLidar(driver, mounting)


def profile(name: ProfileName) -> Profile:
    """Return a profile by its name; raises `ProfileError` if its package is not installed here."""
    if name == FOG.name:
        return FOG
    installed = parts.names(ENTRY_POINTS)
    if name not in installed:
        others = " or ".join([FOG.name, *installed])
        raise ProfileError(
            f"the profile {name} is not installed on this robot: "
            f"install fognav-experiments there and restart its agent, or use {others}"
        )
    try:
        return parts.load(ENTRY_POINTS, name, Profile)
    except parts.PartError as error:
        raise ProfileError(str(error)) from error
