"""Exchangeable parts by name, registered by installed packages in groups of entry points.

A setting chooses a part by its name. All parts, Fognav's own included, are registered in a `pyproject.toml`:

    [project.entry-points."fognav.lidars"]
    my-lidar = "my_package.lidar:FACTORY"

Imports only the standard library, because the watchdog uses it.
"""

import sys
from functools import cache
from importlib.metadata import EntryPoints, entry_points
from typing import Final, TypeVar

# The hardware of the thesis: the one place outside their own folders that names a base or a lidar.
DEFAULT_BASE: Final = "roomba600"
"""In the entry points `fognav.bases`, `fognav.base_stops` and `fognav.base_emulators`."""
DEFAULT_LIDAR: Final = "rplidar-a1"
"""In the entry points `fognav.lidars` and `fognav.lidar_emulators`."""

T = TypeVar("T")


class PartError(ValueError):
    """A part is unknown or unusable; the message names it, the known ones and the remedy."""


def names(group: str) -> list[str]:
    """Return the names of all parts of a group, sorted."""
    return sorted({point.name for point in _points(group, tuple(sys.path))})


@cache
def _points(group: str, path: tuple[str, ...]) -> EntryPoints:
    """Return a group's parts on this path of imports: looking for them reads a file of each installed package."""
    del path
    return entry_points(group=group)


def load(group: str, name: str, kind: type[T]) -> T:
    """Import the part of this name and return it.

    Raises:
        PartError: if no package or more than one registers the name, or if the part can't be imported or has the wrong
            type.

    """
    points = _points(group, tuple(sys.path)).select(name=name)
    if not points:
        known = ", ".join(names(group)) or "none"
        raise PartError(
            f"{group} has no {name!r} (known: {known}). Use one of these, or install the package that provides it"
        )
    if len({point.value for point in points}) > 1:
        providers = ", ".join(sorted(f"{point.value} of {point.dist.name if point.dist else '?'}" for point in points))
        raise PartError(f"{group}: {name!r} is registered more than once ({providers}). Uninstall all but one")
    (point, *_) = points
    try:
        part = point.load()
    except Exception as error:  # whatever its code raises: the user must hear which package it is
        raise PartError(f"{group}: {name!r} ({point.value}) can't be imported: {error}. Correct its package") from error
    if not isinstance(part, kind):
        raise PartError(
            f"{group}: {name!r} ({point.value}) is not a {kind.__name__}. Correct its package's entry point"
        )
    return part
