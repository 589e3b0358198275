"""What the hazard aggregator can be told (environment FOGNAV_*), beside what all processes can."""

from fog_runtime.settings import CommonSettings
from hazard_aggregator.debounce import DEFAULT_RULE


class Settings(CommonSettings, frozen=True, kw_only=True):
    """`debounce` is the name of the rule for areas that choose none (entry points `fognav.debounce_rules`)."""

    debounce: str = DEFAULT_RULE
