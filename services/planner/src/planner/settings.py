"""What the planner can be told (environment FOGNAV_*), beside what all processes can."""

from fog_runtime.settings import InflationSettings


class Settings(InflationSettings, frozen=True, kw_only=True):
    """The inflation should be the map-service's: another one only makes the search slower.

    `release_m` is how much of the path ahead a robot may drive without hearing from the planner.
    """

    release_m: float = 15.0
