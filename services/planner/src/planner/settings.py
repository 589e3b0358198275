"""The settings of the planner (environment FOGNAV_*), on top of those of every process."""

from fog_runtime.settings import InflationSettings


class Settings(InflationSettings, frozen=True, kw_only=True):
    """The inflation should equal the map-service's: a different one only makes the search slower.

    `release_m` is the released length: how far (m) a robot may drive without a message from the planner.
    """

    release_m: float = 15.0
