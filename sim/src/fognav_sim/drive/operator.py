"""The decisions of an operator during a drive: enable, enable again after a stop, reset a fault, send goals. Pure."""

from dataclasses import dataclass
from typing import Final, Literal

from fog_contracts.messages import ReasonCode, RobotState

OperatorCommand = Literal["enable", "reset"]

STOP_RESPONSE_S: Final = 5.0
"""After this long in a protective stop a robot that waits for it is enabled again. One that has just started has as
long to become ready by itself."""
HOLD_RESPONSE_S: Final = 61.0
"""After 60 s in HOLD a robot waits for an operator."""
FAULT_RESPONSE_S: Final = 2.0
"""Time after which a fault is reset; the robot refuses while the cause persists."""


_READY: Final = {ReasonCode.NOT_ENABLED, ReasonCode.JUST_STARTED}


def waits_only_for_operator(state: RobotState) -> bool:
    """Whether the only reason why a robot in INIT does not drive is that no operator has enabled it."""
    return state.mode == "INIT" and _READY.issuperset(state.codes)


class OperatorPolicy:
    """Decides from a robot's states which command an operator would give; times are in seconds of the clock."""

    def __init__(self, now: float) -> None:
        """Begin at `now`, before any state was received."""
        self._state: RobotState | None = None
        self._mode_since = now
        self._not_ready_at = now

    def on_state(self, state: RobotState, now: float) -> None:
        """Record the robot's latest state."""
        if self._state is None or state.mode != self._state.mode:
            self._mode_since = now
        if not waits_only_for_operator(state):
            self._not_ready_at = now
        self._state = state

    def ready_s(self, now: float) -> float:
        """For how long the robot has been ready and waiting only to be enabled."""
        return now - self._not_ready_at if self._state is not None and waits_only_for_operator(self._state) else 0.0

    def command_due(self, now: float) -> OperatorCommand | None:
        """Return the command that the robot needs now, or None; it is due until the robot's state changes."""
        state = self._state
        if state is None:
            return None
        in_mode_s = now - self._mode_since
        if state.mode == "FAULT":
            return "reset" if in_mode_s >= FAULT_RESPONSE_S else None
        # A robot that is not ready is enabled too in the end: its refusal names what is missing.
        waits = state.mode == "INIT" and (waits_only_for_operator(state) or in_mode_s >= STOP_RESPONSE_S)
        # One that was stopped by what ends by itself goes on by itself.
        stopped = state.mode == "PROTECTIVE_STOP" and state.awaits_operator
        waits = waits or (stopped and in_mode_s >= STOP_RESPONSE_S)
        waits = waits or (state.mode == "HOLD" and in_mode_s >= HOLD_RESPONSE_S)
        return "enable" if waits else None


@dataclass
class Shuttle:
    """Sends a robot back and forth between two places: from `start` to `goal` first."""

    start: str
    goal: str
    legs: int = 0
    """Number of arrivals."""
    under_way: bool = False

    @property
    def next_place(self) -> str:
        """The place that the robot drives to, or will be sent to next."""
        return (self.goal, self.start)[self.legs % 2]

    def on_state(self, state: RobotState) -> str | None:
        """Record the robot's latest state; return the place at which it has just arrived, or None."""
        if not (self.under_way and state.enabled and state.goal_reached):
            return None
        arrived = self.next_place
        self.legs += 1
        self.under_way = False
        return arrived

    def goal_due(self, state: RobotState) -> str | None:
        """Return the place to send the robot to now, or None; set `under_way` once the planner accepts the goal."""
        return self.next_place if state.enabled and state.mode != "INIT" and not self.under_way else None
