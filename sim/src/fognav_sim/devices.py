"""The devices of the simulated robot, of any make: byte-exact emulators, found by name.

A base or lidar comes with its emulator, and registers it by an entry point like its driver. Emulator and driver share
no code: two independent implementations of one data sheet reveal each other's errors.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from fog_runtime.configuration import parts
from fog_runtime.configuration.settings import SettingsError
from fognav_sim.emulators import BASES, LIDARS

if TYPE_CHECKING:
    from fognav_sim.emulators import BaseEmulator, LidarEmulator, Measure


def make_base(name: str) -> BaseEmulator:
    """Make the emulator of a base. Raises `SettingsError` for an unknown name."""
    try:
        emulator: BaseEmulator = parts.load(BASES, name, type)()
    except parts.PartError as error:
        raise SettingsError(f"base.driver: {error}") from error
    return emulator


def make_lidar(name: str, measure: Measure) -> LidarEmulator:
    """Make the emulator of a lidar that measures by `measure`. Raises `SettingsError` for an unknown name."""
    try:
        emulator: LidarEmulator = parts.load(LIDARS, name, type)(measure)
    except parts.PartError as error:
        raise SettingsError(f"lidar.driver: {error}") from error
    return emulator
