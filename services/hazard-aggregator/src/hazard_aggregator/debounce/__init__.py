"""When the readings of a node are enough to settle its state: one rule per module, ours like anybody's.

A rule registers a `RuleFactory` under its name in the entry points `fognav.debounce_rules`. An area chooses it by name,
with the rule's own options beside: `debounce = { rule = "consecutive", to_blocked = 3 }`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Generic, Protocol, TypeVar

import msgspec

from fog_contracts.options import OptionError, read_options

if TYPE_CHECKING:
    from fog_contracts.messages import AreaState

Options = TypeVar("Options", bound=msgspec.Struct)

DEFAULT_RULE: Final = "consecutive"
_RULE: Final = "rule"


class Rule(Protocol):
    """Watches the classified readings of one node."""

    def feed(self, state: AreaState, at: float) -> AreaState | None:
        """Take what one reading says, `at` seconds of a monotonic clock.

        Returns the state that is settled now, or None while that is open.
        """

    def reset(self) -> None:
        """Forget all readings: the node fell silent or is not trusted any more."""


@dataclass(frozen=True, slots=True, kw_only=True)
class RuleFactory(Generic[Options]):
    """What a rule registers: the type of its options, and how a rule for one node is made of them."""

    options: type[Options]
    make: Callable[[Options], Rule]


class DebounceError(ValueError):
    """An area's choice of a rule that can't be used; the message names the area, the field and what there is."""

    def __init__(self, area: str, field: str, problem: str) -> None:
        super().__init__(f"area {area}: {field}: {problem}")
        self.field = field
        self.problem = problem


Registry = Callable[[str], "RuleFactory[Any]"]
"""Returns the factory of a name; raises `ValueError`, which says what names there are, for an unknown one."""


def make_rule(area: str, choice: Mapping[str, Any], registry: Registry, default: str = DEFAULT_RULE) -> Rule:
    """Return a fresh rule for one node of an area, as the area's `debounce` says; raises `DebounceError`.

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
