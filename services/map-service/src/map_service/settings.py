"""What the map-service can be told (environment FOGNAV_*), beside what all processes can."""

from fog_runtime.settings import CommonSettings


class Settings(CommonSettings, frozen=True, kw_only=True):
    """Radii in m, `cost_scaling` in 1/m; `hazards_wait_s`: how long a start waits for the aggregator's word."""

    inscribed_radius: float = 0.17
    inflation_radius: float = 0.55
    cost_scaling: float = 3.0
    hazards_wait_s: float = 3.0
