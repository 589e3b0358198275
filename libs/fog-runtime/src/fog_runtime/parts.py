"""Exchangeable parts by name: what installed packages registered in a group of entry points.

A part is chosen by its name in a setting. Ours are registered in the same way as anybody's, in `pyproject.toml`:

    [project.entry-points."fognav.lidars"]
    my-lidar = "my_package.lidar:FACTORY"

Imports nothing but the standard library: the watchdog uses it too.
"""

from importlib.metadata import entry_points
from typing import TypeVar

T = TypeVar("T")


class PartError(ValueError):
    """A part that is not there or can't be used; the message names it, those that there are, and the remedy."""


def names(group: str) -> list[str]:
    """Return the names of all parts of a group, sorted."""
    return sorted({point.name for point in entry_points(group=group)})


def load(group: str, name: str, kind: type[T]) -> T:
    """Import the part of this name and return it.

    Raises:
        PartError: if no package or more than one registers the name, or if what it registers can't be imported or is
            of another kind.

    """
    found = entry_points(group=group, name=name)
    if not found:
        known = ", ".join(names(group)) or "none"
        raise PartError(f"{group} has no {name!r} (known: {known}). Use one of these, or install the package with it")
    if len({point.value for point in found}) > 1:
        rivals = ", ".join(sorted(f"{point.value} of {point.dist.name if point.dist else '?'}" for point in found))
        raise PartError(f"{group}: {name!r} is registered more than once ({rivals}). Uninstall all but one")
    (point, *_) = found
    try:
        part = point.load()
    except (ImportError, AttributeError) as error:
        raise PartError(f"{group}: {name!r} ({point.value}) can't be imported: {error}. Correct its package") from error
    if not isinstance(part, kind):
        raise PartError(f"{group}: {name!r} ({point.value}) is no {kind.__name__}. Correct its package's entry point")
    return part
