"""Makes a world that breaks a rule smaller while it still breaks it: what is left is what it takes.

Each try is a whole drive of some seconds of computation, so this tries the few changes that make a world simpler to a
reader, the largest first, instead of the hundreds of small ones of a general shrinker.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from msgspec.structs import asdict, replace

from fog_runtime.configuration.parts import DEFAULT_BASE, DEFAULT_LIDAR
from fognav_experiments.hunt.world import HuntWorld, Mounting, Sensors

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

_LISTS: Final = ("events", "placed", "opened", "pillars", "watched")
_PLAIN: Final[dict[str, Any]] = {
    "warp_m": 0.0,
    "resolution": 0.05,
    "radius": 0.17,
    "base": DEFAULT_BASE,
    "lidar": DEFAULT_LIDAR,
    "mounting": Mounting(),
    "quirks": {},
}


def shrink(world: HuntWorld, breaks: Callable[[HuntWorld], float | None], tries: int) -> HuntWorld:
    """Return the smallest world found in so many tries.

    `breaks`: when (s) a world breaks the rule that it is about, or None if it does not.
    """
    left = tries
    changed = True
    while changed and left > 0:
        changed = False
        for smaller in _smaller(world):
            if left <= 0:
                break
            left -= 1
            if breaks(smaller) is not None:
                world, changed = smaller, True
                break
    return world


def _smaller(world: HuntWorld) -> Iterator[HuntWorld]:
    """Yield the next simpler worlds."""
    if world.sensors != Sensors():
        yield replace(world, sensors=Sensors())
    for name in _LISTS:
        yield from (replace(world, **{name: fewer}) for fewer in _fewer(getattr(world, name)))
    for name, plain in _PLAIN.items():
        if getattr(world, name) != plain:
            yield replace(world, **{name: plain})
    for sensors in _plainer(world.sensors):
        yield replace(world, sensors=sensors)
    for free in _fewer(world.free[1:]):
        yield replace(world, free=[*world.free[:1], *free])


def _plainer(sensors: Sensors) -> Iterator[Sensors]:
    usual = asdict(Sensors())
    for name, value in asdict(sensors).items():
        if isinstance(value, list):
            yield from (replace(sensors, **{name: fewer}) for fewer in _fewer(value))
        elif value != usual[name]:
            yield replace(sensors, **{name: usual[name]})


def _fewer(items: list[Any]) -> Iterator[list[Any]]:
    """Yield none of them, if there are several, and all but one."""
    if len(items) > 1:
        yield []
    for index in range(len(items)):
        yield items[:index] + items[index + 1 :]
