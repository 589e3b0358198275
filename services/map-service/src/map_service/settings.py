"""The settings of the map-service (environment FOGNAV_*), on top of those of every process."""

from fog_runtime.settings import InflationSettings


class Settings(InflationSettings, frozen=True, kw_only=True):
    """`hazards_wait_s`: how long (s) the first map waits for the aggregator's hazards."""

    hazards_wait_s: float = 3.0
