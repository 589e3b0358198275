"""The robot's base and lidar by their names in settings (FOGNAV_BASE, FOGNAV_LIDAR), with their own options."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from fog_runtime import parts
from fog_runtime.settings import SettingsError, load_options
from robot_agent.hardware import BaseFactory, LidarFactory

if TYPE_CHECKING:
    from robot_agent.hardware import BaseDriver, LidarDriver

BASES: Final = "fognav.bases"
LIDARS: Final = "fognav.lidars"


def make_base(name: str, options: str = "") -> BaseDriver:
    """Make the driver of a base; `options` is a JSON object, empty for the defaults. Raises `SettingsError`."""
    try:
        factory: BaseFactory[Any] = parts.load(BASES, name, BaseFactory)
    except parts.PartError as error:
        raise SettingsError(f"FOGNAV_BASE: {error}") from error
    return factory.make(load_options(factory.options, options, variable="FOGNAV_BASE_OPTIONS"))


def make_lidar(name: str, options: str = "") -> LidarDriver:
    """Make the driver of a lidar; `options` is a JSON object, empty for the defaults. Raises `SettingsError`."""
    try:
        factory: LidarFactory[Any] = parts.load(LIDARS, name, LidarFactory)
    except parts.PartError as error:
        raise SettingsError(f"FOGNAV_LIDAR: {error}") from error
    return factory.make(load_options(factory.options, options, variable="FOGNAV_LIDAR_OPTIONS"))
