"""Whether a fleet control is in control of a robot of Fognav, or an operator is. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

from fog_bridges.vda5050.charging import START

if TYPE_CHECKING:
    from fog_bridges.vda5050.outgoing import OperatingMode

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
