"""Debounce rules: when the readings of a node suffice to confirm its state. One rule per module.

A rule, in this package or any other, registers a `RuleFactory` under its name in the entry points
`fognav.debounce_rules`. An area chooses it by name, together with its options:
`debounce = { rule = "consecutive", to_blocked = 3 }`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Generic, Protocol, TypeVar

import msgspec

from fog_contracts.options import OptionError, read_options
from hazard_aggregator.area_size import AreaError

if TYPE_CHECKING:
    from fog_contracts.messages import AreaState

Options = TypeVar("Options", bound=msgspec.Struct)

DEFAULT_RULE: Final = "consecutive"
_RULE: Final = "rule"


class Rule(Protocol):
    """Debounces the classified readings of one node."""

    def update(self, state: AreaState, now: float) -> AreaState | None:
        """Process the state that one reading shows; `now` is when it was taken, in seconds of a monotonic clock.

        Delayed readings have the times at which they were taken, not that of their arrival. Returns the confirmed
        state, or None while the readings don't confirm one.
        """

    def reset(self) -> None:
        """Forget all readings: the node fell silent, went offline or contradicted itself."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RuleFactory(Generic[Options]):
    """What a rule registers: the type of its options, and a function that makes the rule of one node from them."""

    options: type[Options]
    make: Callable[[Options], Rule]


class DebounceError(AreaError):
    """An area's debounce settings are invalid; the message names the area, the field and the known values."""


Registry = Callable[[str], "RuleFactory[Any]"]
"""Returns the factory of a name; raises `ValueError`, which lists the known names, for an unknown one."""


def make_rule(area: str, choice: Mapping[str, Any], registry: Registry, default: str = DEFAULT_RULE) -> Rule:
    """Return a new rule for one node of an area from the area's `debounce` settings; raises `DebounceError`.

    `default` is the rule of an area that names none.
    """
    name = choice.get(_RULE, default)
    try:
        factory = registry(str(name))
    except ValueError as error:
        raise DebounceError(area, f"debounce.{_RULE}", str(error)) from error
    try:
        options = read_options(factory.options, {key: value for key, value in choice.items() if key != _RULE})
    except OptionError as error:
        field = f"debounce.{error.field}" if error.field else "debounce"
        raise DebounceError(area, field, f"{error.problem}, as an option of the rule {name}") from error
    return factory.make(options)
