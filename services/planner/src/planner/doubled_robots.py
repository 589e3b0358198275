"""Robots whose id two agents use at the same time, as when a memory card was copied. Pure; time is an argument.

Both would follow every path and goal of that id, each from where the other one stands.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Final

RETURNS: Final = 3
"""How often the states must change back to an earlier run: a late one after a restart changes back to it, and again."""
REMEMBERED_S: Final = 10.0
"""How long a run, and what was found, are remembered after they were last heard."""


@dataclass
class _Runs:
    current: str = ""
    heard_at: dict[str, float] = field(default_factory=dict)
    returns: int = 0
    found_at: float | None = None


class DoubledRobots:
    """Finds them by their states: each run of an agent has an id of its own (`boot`), and never comes back."""

    def __init__(self) -> None:
        self._runs: dict[str, _Runs] = {}

    def on_state(self, robot: str, boot: str, now: float) -> bool:
        """Handle a state of the agent run `boot`, at `now` (s, monotonic); return whether the robot is a new find."""
        if not boot:
            return False
        runs = self._runs.setdefault(robot, _Runs())
        runs.heard_at = {run: at for run, at in runs.heard_at.items() if now - at <= REMEMBERED_S}
        if len(runs.heard_at) <= 1:
            runs.returns = 0
        new = False
        if boot != runs.current and boot in runs.heard_at:
            runs.returns += 1
            if runs.returns >= RETURNS:
                new, runs.found_at = not self.is_doubled(robot, now), now
        runs.current = boot
        runs.heard_at[boot] = now
        return new

    def is_doubled(self, robot: str, now: float) -> bool:
        """Whether two agents use this id now."""
        runs = self._runs.get(robot)
        return runs is not None and runs.found_at is not None and now - runs.found_at <= REMEMBERED_S

    def found(self, now: float) -> list[str]:
        """Return the ids that two agents use now, sorted."""
        return sorted(robot for robot in self._runs if self.is_doubled(robot, now))
