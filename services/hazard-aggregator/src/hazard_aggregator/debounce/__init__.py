"""When readings in a stream are enough to settle a node's state: one rule per file of this package.

A rule is a module here with a function `make(limits: Debounce) -> Rule`; its name is the file's. To try another one,
add a file and name it in the setting `debounce`.
"""

from __future__ import annotations

import importlib
import pkgutil
from typing import TYPE_CHECKING, Protocol, cast

if TYPE_CHECKING:
    from collections.abc import Callable

    from fog_contracts.messages import AreaState, Debounce

    RuleMaker = Callable[[Debounce], "Rule"]


class Rule(Protocol):
    """Judges the stream of verdicts of one node."""

    def feed(self, verdict: AreaState) -> AreaState | None:
        """Take the verdict of one reading; return the state that is settled now, or None while that is open."""

    def reset(self) -> None:
        """Forget all readings: the stream was interrupted."""


def names() -> list[str]:
    """Return the names of the rules that exist."""
    return sorted(module.name for module in pkgutil.iter_modules(__path__))


def find(name: str) -> RuleMaker:
    """Return the maker of a rule by its name; raises `ValueError` that lists the rules for an unknown one."""
    if name not in names():
        raise ValueError(f"there is no debounce rule {name!r}: choose one of {', '.join(names())}")
    return cast("RuleMaker", importlib.import_module(f"{__name__}.{name}").make)
