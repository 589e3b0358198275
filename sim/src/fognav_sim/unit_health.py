"""Whether a simulated robot is well, as its container's health tells: it speaks over the fog, and is in no fault.

It goes by the state that arrives over the router, so an agent that hangs, a dead router and a lost network show, too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from fog_contracts.messages import RobotState

SILENT_S: Final = 5.0
"""A robot tells its state once a second."""


class UnitHealth:
    """The conditions of a robot's health; times are in s of one monotonic clock."""

    def __init__(self, robot: str) -> None:
        """Start without a state: a robot that has never spoken is not well."""
        self._robot = robot
        self._state: RobotState | None = None
        self._at = 0.0

    def on_state(self, state: RobotState, now: float) -> None:
        """Take note of the robot's state."""
        self._state, self._at = state, now

    def conditions(self, now: float) -> dict[str, str]:
        """Return why each condition is not met, empty if it is: `speaks`, `no_fault`."""
        if self._state is None:
            return {"speaks": f"{self._robot} has told no state yet", "no_fault": "its state is unknown"}
        silent = now - self._at
        speaks = "" if silent <= SILENT_S else f"{self._robot} has told no state for {silent:.0f} s"
        fault = f"FAULT: {'; '.join(self._state.reasons)}" if self._state.mode == "FAULT" else ""
        return {"speaks": speaks, "no_fault": fault}
