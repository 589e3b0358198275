"""The firmware's own drive into its dock, and the dock's contacts.

The dock sends infrared beams to its front. The robot follows them onto the middle line and along it until the contacts
close; where it sees none it turns on the spot for a while, and then gives up.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

BEAM_M: Final = 1.5
"""The beams reach this far."""
_BEAM_HALF_RAD: Final = math.radians(45.0)
_GIVE_UP_S: Final = 20.0
_FAST_MM_S: Final = 150.0
_SLOW_MM_S: Final = 70.0
_SLOW_WITHIN_M: Final = 0.4
_LOOKAHEAD_M: Final = 0.25
_TURN_FROM_RAD: Final = 0.5
_TURN_MM_S: Final = 60.0
_CONTACT_M: Final = 0.012
_CONTACT_RAD: Final = 0.3
_CONTACT_ASIDE_M: Final = 0.05
_STOP_M: Final = 0.005


class Dock(NamedTuple):
    """Where the robot is, seen from where it stands on its dock.

    ahead: m that it has still to go along the dock's middle line. aside: m to the left of that line. heading: rad
    counter-clockwise from that line's direction.
    """

    ahead: float
    aside: float
    heading: float

    @property
    def has_contact(self) -> bool:
        """Whether the robot touches the dock's contacts."""
        near = abs(self.ahead) <= _CONTACT_M and abs(self.aside) <= _CONTACT_ASIDE_M
        return near and abs(self.heading) <= _CONTACT_RAD

    @property
    def is_seen(self) -> bool:
        """Whether the robot is in the dock's beams."""
        away = math.hypot(self.ahead, self.aside)
        return 0.0 < away <= BEAM_M and abs(math.atan2(self.aside, self.ahead)) <= _BEAM_HALF_RAD


class Search:
    """One search for the dock, since it was commanded."""

    def __init__(self) -> None:
        self._unseen_s = 0.0

    def wheels(self, dock: Dock | None, dt: float) -> tuple[int, int] | None:
        """Return the speeds (mm/s) of left and right wheel after `dt` more seconds; None once the search has ended."""
        if dock is not None and dock.has_contact and abs(dock.ahead) <= _STOP_M:
            return None
        if dock is None or not dock.is_seen:
            self._unseen_s += dt
            return None if self._unseen_s > _GIVE_UP_S else (round(-_TURN_MM_S), round(_TURN_MM_S))
        error = math.remainder(math.atan2(-dock.aside, _LOOKAHEAD_M) - dock.heading, math.tau)
        turn = max(-1.0, min(1.0, 3.0 * error)) * _TURN_MM_S
        forward = _FAST_MM_S if dock.ahead > _SLOW_WITHIN_M else _SLOW_MM_S
        if abs(error) > _TURN_FROM_RAD:
            forward = 0.0
        return round(forward - turn), round(forward + turn)
