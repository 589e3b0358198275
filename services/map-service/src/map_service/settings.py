"""What the map-service can be told (environment FOGNAV_*), beside what all processes can."""

from fog_runtime.settings import InflationSettings


class Settings(InflationSettings, frozen=True, kw_only=True):
    """`hazards_wait_s`: how long a start waits for the aggregator's word."""

    hazards_wait_s: float = 3.0
