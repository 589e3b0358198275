"""What the hazard aggregator can be told (environment FOGNAV_*), beside what all processes can."""

from fog_runtime.settings import CommonSettings


class Settings(CommonSettings, frozen=True, kw_only=True):
    """`debounce` is the name of a rule: a file in the package `hazard_aggregator.debounce`."""

    debounce: str = "consecutive"
