"""Debounce rules by name: those that installed packages, this one included, registered as entry points."""

from __future__ import annotations

from functools import cache
from typing import Any, Final

from fog_runtime.configuration import parts
from hazard_aggregator.debounce import RuleFactory

GROUP: Final = "fognav.debounce_rules"


@cache  # a look-up reads every installed package's metadata
def find_rule(name: str) -> RuleFactory[Any]:
    """Return the factory of a debounce rule; raises `PartError`, which lists the known rules."""
    factory: RuleFactory[Any] = parts.load(GROUP, name, RuleFactory)
    return factory
