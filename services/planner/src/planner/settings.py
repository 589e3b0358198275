"""What the planner can be told (environment FOGNAV_*), beside what all processes can."""

from fog_runtime.settings import CommonSettings


class Settings(CommonSettings, frozen=True, kw_only=True):
    """Radii in m, `cost_scaling` in 1/m: as the map-service's; others only make the search slower.

    `release_m` is how much of the path ahead a robot may drive without hearing from the planner.
    """

    inscribed_radius: float = 0.17
    inflation_radius: float = 0.55
    cost_scaling: float = 3.0
    release_m: float = 15.0
