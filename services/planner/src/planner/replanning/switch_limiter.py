"""How often a robot's path may be moved to another way, while hazards come and go."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from planner.config import PlannerConfig

_QUIET_S: Final = 60.0
"""After so long without a switch, the next one counts as the first again."""


@dataclass
class SwitchLimiter:
    """When a robot was last moved to another way, and how often in a row. Times are of the planner's clock (s)."""

    last: float = -math.inf
    in_a_row: int = 0
    deferred_until: float = math.inf
    """When a switch that had to wait is searched again."""

    def allowed_from(self, config: PlannerConfig) -> float:
        """Return from when on a passable path may be left for another way."""
        doubled = config.switch_dwell_s * 2.0 ** max(0, self.in_a_row - 1)
        return self.last + min(doubled, config.max_switch_dwell_s)

    def record(self, now: float) -> None:
        """Record a switch, forced or not."""
        self.in_a_row = self.in_a_row + 1 if now - self.last < _QUIET_S else 1
        self.last = now
