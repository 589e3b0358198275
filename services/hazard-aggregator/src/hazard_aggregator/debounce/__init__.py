"""Debounce rules: when the readings of a node suffice to confirm its state. One rule per module.

A rule, in this package or any other, registers a `RuleFactory` under its name in the entry points
`fognav.debounce_rules`. An area chooses it by name, together with its options:
`debounce = { rule = "consecutive", to_blocked = 3 }`. The thesis's rule is `consecutive`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Generic, NamedTuple, Protocol, TypeVar

import msgspec

from fog_contracts.site import OptionError, read_options
from hazard_aggregator.area_size import AreaError

if TYPE_CHECKING:
    from fog_contracts.messages import AreaState

Options = TypeVar("Options", bound=msgspec.Struct)

DEFAULT_RULE: Final = "evidence"
_FIRST_RULE: Final = "consecutive"
"""The rule of areas whose options are older than the choice of rules, and name none."""
_RULE: Final = "rule"


class SonarSample(NamedTuple):
    """What one sonar of a reading shows; range and limit in m. `explained`: a robot causes its echo.

    `false_echo_rate`: the share of its readings of a free area with an echo within the limit; None: it is not known.
    """

    state: AreaState
    range_m: float | None = None
    limit_m: float | None = None
    explained: bool = False
    false_echo_rate: float | None = None


class Observation(NamedTuple):
    """What one reading of a node shows, and its sonars one by one (none: the sensor has no sonars)."""

    state: AreaState
    sonars: tuple[SonarSample, ...] = ()


class Rule(Protocol):
    """Debounces the classified readings of one node."""

    def update(self, seen: Observation, now: float) -> AreaState | None:
        """Process what one reading shows; `now` is when it was taken, in seconds of a monotonic clock.

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

    `default` is the rule of an area that names none; options that only the thesis's rule has choose that one.
    """
    given = {key: value for key, value in choice.items() if key != _RULE}
    name = str(choice.get(_RULE, default))
    try:
        factory = registry(name)
        if _RULE not in choice and given and not _accepts(factory, given) and _accepts(registry(_FIRST_RULE), given):
            name, factory = _FIRST_RULE, registry(_FIRST_RULE)
    except ValueError as error:
        raise DebounceError(area, f"debounce.{_RULE}", str(error)) from error
    try:
        options = read_options(factory.options, given)
    except OptionError as error:
        field = f"debounce.{error.field}" if error.field else "debounce"
        raise DebounceError(area, field, f"{error.problem}, as an option of the rule {name}") from error
    return factory.make(options)


def _accepts(factory: RuleFactory[Any], given: Mapping[str, Any]) -> bool:
    """Whether a rule has options of all these names."""
    return given.keys() <= set(factory.options.__struct_encode_fields__)
