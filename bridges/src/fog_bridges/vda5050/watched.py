"""A robot of Fognav as the floor tells of it, and whether a fleet control or an operator is in control. Pure."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from fog_bridges.heard import SILENT_S
from fog_bridges.vda5050.charging import START
from fog_bridges.vda5050.orders import Where

if TYPE_CHECKING:
    from fog_bridges.vda5050.outgoing import OperatingMode

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


_BY_HAND: Final = {
    "TELEOP": "it is driven by hand", "DOCK": "it docks", "EGRESS": "it leaves a blocked area on an operator's command",
}  # fmt: skip


class Doings(NamedTuple):
    """What a robot does for whom: its mission for somebody else, its dock for the fleet; and what has just ended."""

    is_foreign: bool
    has_mission: bool
    """Whether it has one of the fleet, for which it leaves its dock by itself."""
    charging: str
    """The fleet's action that leads it to its dock or off it; empty without one."""
    is_taken: bool
    """Whether an operator has just ended the fleet's mission."""


def mode_of(view: dict[str, Any], doings: Doings) -> tuple[OperatingMode, str]:
    """Return the operating mode (6.6.6), and in words why the fleet is not in control; empty if it is."""
    state, out = view["state"] or {}, view.get("out_of_service")
    if not state:
        return "STARTUP", "it has not told its state yet"
    mode = state["mode"]
    waits = bool(state.get("awaits_operator")) or not state["enabled"]
    by_hand = mode in _BY_HAND and not (mode == "DOCK" and (doings.charging or doings.has_mission))
    starts = mode == "INIT" and (waits or not doings.charging)  # it may only wait for its lidar, to leave its dock
    reasons: tuple[tuple[bool, OperatingMode, str], ...] = (
        (out is not None, "SERVICE", f"an operator has taken it out of service: {(out or {}).get('reason')}"),
        (doings.is_foreign, "MANUAL", "it has a mission of an operator of Fognav"),
        (starts, "STARTUP", "it is starting, and does not know where it is"),
        (by_hand, "MANUAL", _BY_HAND.get(mode, "")),
        (bool(state.get("wants_dock")) and doings.charging != START, "MANUAL", "it is on its way to its dock"),
        (waits, "MANUAL", "it waits for an operator of Fognav, who enables it"),
        (doings.is_taken, "MANUAL", "an operator of Fognav has ended its mission"),
    )
    return next(((mode, words) for holds, mode, words in reasons if holds), ("AUTOMATIC", ""))
