"""Which readings a node publishes: the model's counterpart of the firmware's `publishing`. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.messages import AreaState

HEARTBEAT_S: Final = 1.0
EQUAL_READINGS: Final = 10
MOVED_M: Final = 0.1


class PublishPolicy:
    """After a change every reading until ten equal ones have gone out, then one a second; or, as the thesis, every one.

    A change is another state of a sonar, or a range of a blocked one that is 0.1 m off that of the last change.
    """

    def __init__(self, *, every_reading: bool) -> None:
        self._every_reading = every_reading
        self._sonars: list[tuple[AreaState, float]] = []
        self._equal = 0
        self._published = 0.0

    def restart(self) -> None:
        """Publish again as after a change."""
        self._equal = 0

    def update(self, states: Sequence[AreaState], ranges: Sequence[float | None], now: float) -> bool:
        """Take each sonar's state and range (m; None for no echo) at `now` (s); return whether they go out."""
        shown = [(state, measured or 0.0) for state, measured in zip(states, ranges, strict=True)]
        if not self._sonars:
            self._sonars = [("unknown", 0.0)] * len(shown)
        for index, ((state, measured), (before, reference)) in enumerate(zip(shown, self._sonars, strict=True)):
            if state != before or (state == "blocked" and abs(measured - reference) > MOVED_M):
                self._sonars[index] = shown[index]
                self._equal = 0
        repeated = self._equal < EQUAL_READINGS
        self._equal += repeated
        if not (self._every_reading or repeated or now - self._published >= HEARTBEAT_S):
            return False
        self._published = now
        return True
