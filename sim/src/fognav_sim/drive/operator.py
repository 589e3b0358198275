"""What a person at the console does for a drive: enable, look after a stop, reset a fault, send the next goal. Pure."""

from dataclasses import dataclass
from typing import Final, Literal

from fog_contracts.messages import RobotState

OperatorCommand = Literal["enable", "reset"]

LOOK_S: Final = 5.0
"""A robot that stands in a protective stop for this long is looked at, and enabled again; one that just started is
given as long to come by what it says that it lacks."""
HELD_S: Final = 61.0
"""After 60 s in HOLD a robot waits for an operator."""
FAULT_S: Final = 2.0
"""Time after which a fault is reset; the robot refuses while its cause is there."""


def lacks_only_operator(state: RobotState) -> bool:
    """Whether a robot that is not enabled names one reason alone: then that is the missing operator."""
    return state.mode == "INIT" and len(state.reasons) <= 1


class OperatorPolicy:
    """Decides on a robot's states which command a person would give; times are in seconds of the clock."""

    def __init__(self, now: float) -> None:
        """Begin at `now`, before the robot has said anything."""
        self._state: RobotState | None = None
        self._mode_since = now
        self._lacked_at = now

    def on_state(self, state: RobotState, now: float) -> None:
        """Take the robot's newest state."""
        if self._state is None or state.mode != self._state.mode:
            self._mode_since = now
        if not lacks_only_operator(state):
            self._lacked_at = now
        self._state = state

    def ready_s(self, now: float) -> float:
        """For how long the robot has lacked nothing but an operator who enables it."""
        return now - self._lacked_at if self._state is not None and lacks_only_operator(self._state) else 0.0

    def command_due(self, now: float) -> OperatorCommand | None:
        """Return the command that the robot needs now, or None; ask again until the robot's state has changed."""
        state = self._state
        if state is None:
            return None
        in_mode_s = now - self._mode_since
        if state.mode == "FAULT":
            return "reset" if in_mode_s >= FAULT_S else None
        # One that lacks more is asked as well in the end: its refusal says what keeps it.
        waits = state.mode == "INIT" and (lacks_only_operator(state) or in_mode_s >= LOOK_S)
        waits = waits or (state.mode == "PROTECTIVE_STOP" and in_mode_s >= LOOK_S)
        waits = waits or (state.mode == "HOLD" and in_mode_s >= HELD_S)
        return "enable" if waits else None


@dataclass
class Shuttle:
    """Sends a robot back and forth between two places: from `start` to `goal` first."""

    start: str
    goal: str
    legs: int = 0
    """How often it has arrived."""
    under_way: bool = False

    @property
    def next_place(self) -> str:
        """Where the robot is to drive, or drives."""
        return (self.goal, self.start)[self.legs % 2]

    def on_state(self, state: RobotState) -> str | None:
        """Take the robot's newest state; return the place at which it has just arrived, if so."""
        if not (self.under_way and state.enabled and state.goal_reached):
            return None
        arrived = self.next_place
        self.legs += 1
        self.under_way = False
        return arrived

    def goal_due(self, state: RobotState) -> str | None:
        """Return the place to send the robot to now, or None; set `under_way` once the planner has taken it."""
        return self.next_place if state.enabled and state.mode != "INIT" and not self.under_way else None
