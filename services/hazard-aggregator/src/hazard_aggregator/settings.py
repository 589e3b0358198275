"""The settings of the hazard aggregator (environment FOGNAV_*), on top of those of every process."""

from fog_runtime.configuration.settings import CommonSettings
from hazard_aggregator.debounce import DEFAULT_RULE


class Settings(CommonSettings, frozen=True, kw_only=True):
    """`debounce` names the rule of areas that choose none (entry points `fognav.debounce_rules`)."""

    debounce: str = DEFAULT_RULE
