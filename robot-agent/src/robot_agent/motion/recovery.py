"""What a robot does that gets no further: it waits, turns to its path, backs up along its trail, and tries again.

`step` is a pure state machine; which move is possible without touching anything decides `recovery_moves`. The moves at
one place are numbered, so that they have an end: afterwards the robot holds, and the planner learns of the place.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final, Literal, NamedTuple

Kind = Literal["turn", "back"]


class Attempt(NamedTuple):
    """One move of the series: turn in place towards the path, or back up for `length` m."""

    kind: Kind
    length: float = 0.0


SERIES: Final = (Attempt("turn"), Attempt("back", 0.15), Attempt("turn"), Attempt("back", 0.3))
"""The moves at one place, each followed by another try to drive on."""
PATIENCE_S: Final = 4.0
"""What blocks the path may go away by itself: the robot waits so long without progress before each move."""
MOVE_MAX_S: Final = 5.0
"""A move that takes longer is given up: the stop field may forbid it."""
ALIGNED_RAD: Final = 0.1
"""A robot that heads so nearly along its path has turned."""
WORTH_TURNING_RAD: Final = 0.25
WORTH_BACKING_M: Final = 0.06
"""A smaller turn, or less of a trail, changes nothing."""
SAME_PLACE_M: Final = 0.6
"""Within this distance of where its series began a robot is still stuck at the same place."""


class Situation(NamedTuple):
    """Where the robot is (m, in a frame that does not jump), and for how long (s) it has made no progress.

    error: how far (rad) its path leads to the left of its heading. trail: m that it could back up.
    refused: whether the move that runs can't go on because there is no room.
    """

    place: tuple[float, float]
    stuck_for: float
    error: float
    trail: float
    refused: bool = False


@dataclass(frozen=True, slots=True)
class Recovery:
    """State of the machine: moves begun at this place, the one that runs with its begin (s), and where it all began.

    until: length of trail (m) at which backing up ends.
    """

    begun: int = 0
    running: Attempt | None = None
    since: float = 0.0
    until: float = 0.0
    origin: tuple[float, float] | None = None


def step(state: Recovery, seen: Situation, now: float) -> Recovery:
    """Return the state at `now` (s, monotonic); call it with each decision while the robot may drive."""
    if state.origin is not None and math.dist(state.origin, seen.place) > SAME_PLACE_M:
        return Recovery()
    if state.running is not None:
        return replace(state, running=None) if _over(state, state.running, seen, now) else state
    if seen.stuck_for < PATIENCE_S:
        return state
    for number in range(state.begun, len(SERIES)):
        attempt = SERIES[number]
        if _worth(attempt, seen):
            return Recovery(
                begun=number + 1,
                running=attempt,
                since=now,
                until=max(seen.trail - attempt.length, 0.0),
                origin=state.origin or seen.place,
            )
    return replace(state, begun=len(SERIES), origin=state.origin or seen.place)


def _worth(attempt: Attempt, seen: Situation) -> bool:
    """Whether a move would change anything."""
    if attempt.kind == "turn":
        return abs(seen.error) >= WORTH_TURNING_RAD
    return seen.trail >= WORTH_BACKING_M


def _over(state: Recovery, running: Attempt, seen: Situation, now: float) -> bool:
    """Whether the move that runs is done, or is given up."""
    if seen.refused or now - state.since >= MOVE_MAX_S:
        return True
    return abs(seen.error) <= ALIGNED_RAD if running.kind == "turn" else seen.trail <= state.until
