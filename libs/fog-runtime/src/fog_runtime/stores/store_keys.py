"""Which keys each service writes in Redis, below `fog:SITE:`: for its store, and for its rights in Redis.

A service with a new key names it here: Redis refuses it every other one.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

AREAS: Final = "areas"
HAZARDS: Final = "hazards"
OVERRIDES: Final = "overrides"
OVERRIDE_RESTS: Final = "override_rests"
ALERTS: Final = "alerts"
HISTORY: Final = "history"
"""Of each area: `history:AREA`."""
ZONES: Final = "zones"
ZONE_TIMES: Final = "zone_times"
GOALS: Final = "goals"

OWN: Final[Mapping[str, Sequence[str]]] = {
    "hazard-aggregator": (AREAS, HAZARDS, OVERRIDES, OVERRIDE_RESTS, ALERTS, f"{HISTORY}:*"),
    "map-service": (ZONES, ZONE_TIMES),
    "planner": (GOALS,),
}
"""The keys of each service's own records, as patterns."""
AUDITED: Final[Mapping[str, Sequence[str]]] = {
    "hazard-aggregator": ("alert", "area", "override", "store"),
    "map-service": ("zone", "store"),
    "planner": ("mission", "robot", "stop", "store"),
}
"""The kinds of records whose audit trail (`audit:KIND`) each service writes."""
BOOKKEEPING: Final = ("probe", "generation", "writes", "floors", "no-attempt", "idempotency:*")
"""Keys that every service of a site writes: by which they notice that Redis lost something."""
