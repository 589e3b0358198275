"""The settings of the map-service (environment FOGNAV_*), on top of those of every process."""

from fog_runtime.clock import WallClockSource
from fog_runtime.configuration.settings import InflationSettings


class Settings(InflationSettings, frozen=True, kw_only=True):
    """Settings of the map-service.

    `hazards_wait_s`: how long (s) the first map waits for the aggregator's hazards. `wall_clock`: when the time of day
    is believed: while the kernel says that it is synchronized (`kernel`), or always (`trusted`).
    """

    hazards_wait_s: float = 3.0
    wall_clock: WallClockSource = "kernel"
