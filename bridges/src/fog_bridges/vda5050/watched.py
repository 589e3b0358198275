"""A robot of Fognav as the floor tells of it. Pure."""

from __future__ import annotations

import math
from typing import Any, Final

from fog_bridges.heard import SILENT_S
from fog_bridges.vda5050.orders import Where

STILL: Final = (0.01, 0.05)
"""A robot that moves no faster (m/s, rad/s) stands."""


class Watched:
    """What was told last of a robot, and when."""

    def __init__(self) -> None:
        self.view: dict[str, Any] = {"state": None, "goal": None}
        self.pose: dict[str, Any] | None = None
        self.path: list[tuple[float, float]] = []
        self.path_changes = 0
        self.is_known = False
        """Whether the floor's state is: else nothing is concluded from it."""
        self._heard = -math.inf

    def watch(self, view: dict[str, Any], now: float) -> None:
        """Take in the robot's state, mission and plan."""
        before = (self.view["state"] or {}).get("stamp")
        if self.is_known and (view["state"] or {}).get("stamp") != before:
            self._heard = now  # what is told before all is known may be long ago
        self.view = view

    def forget(self) -> None:
        """Drop what was told: the floor tells all anew."""
        self.is_known = False
        self.view, self.pose = {"state": None, "goal": None}, None
        self.on_path([])

    def on_path(self, points: list[tuple[float, float]]) -> None:
        """Take in the robot's path (m)."""
        self.path = points
        self.path_changes += 1

    def is_there(self, now: float) -> bool:
        """Whether the robot itself is heard of."""
        return now - self._heard < SILENT_S

    @property
    def state(self) -> dict[str, Any]:
        """The robot's own state; empty before the first one."""
        return self.view["state"] or {}

    @property
    def at(self) -> Where | None:
        """Where the robot is, if it knows."""
        pose = self.pose
        return None if pose is None or not pose["localized"] else Where(pose["x"], pose["y"], pose["theta"])

    @property
    def has_dock(self) -> bool:
        """Whether the site gives the robot a dock."""
        return self.view.get("dock") is not None

    @property
    def is_driving(self) -> bool:
        """Whether it moves."""
        return self.pose is not None and (abs(self.pose["v"]) > STILL[0] or abs(self.pose["w"]) > STILL[1])
