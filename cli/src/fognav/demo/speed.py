"""Checks whether this machine sustains the speed of a demonstration. Pure. See docs/operations.md.

At a speed that the machine can't sustain, the processes miss their periods and limits although the system works
correctly; the demonstration then starts again more slowly. Speed 1 is never lowered.
"""

from collections.abc import Sequence
from typing import Final

from fog_contracts.messages import RobotState, SimTruth
from fognav_sim.drive.drive import DriveOutcome

MAX_LATE_CHECKS: Final = 2
"""After this many consecutive checks with late processes the attempt is given up."""
MIN_SPEED_SHARE: Final = 0.93
"""Share of the requested speed that the simulator must sustain."""
MAX_LATE_CYCLES_PER_S: Final = 3.0
"""Late cycles per second of the agent's loops (25 are due) above which it can't keep up."""
SPEED_FACTOR: Final = 0.7


class TooFastError(Exception):
    """The machine can't sustain the requested speed; `sustained` is the speed of the simulator."""

    def __init__(self, sustained: float, reason: str) -> None:
        super().__init__(reason)
        self.sustained = sustained

    def lower(self, speed: float) -> float:
        """Return the speed to try next after `speed`."""
        return max(1.0, round(min(speed * SPEED_FACTOR, self.sustained), 1))


class SpeedWatch:
    """Monitors one attempt at a speed. `stops` are the stops of the drive without a cause in its scenario."""

    def __init__(self, speed: float) -> None:
        self._speed = speed
        self._late_checks = 0
        self._late_cycles = 0
        self._stops_seen = 0
        self._sustained: list[float] = []

    @property
    def sustained(self) -> float | None:
        """Mean of the simulator's speeds, None before the first check."""
        return round(sum(self._sustained) / len(self._sustained), 2) if self._sustained else None

    def check(
        self, elapsed_s: float, truth: SimTruth, state: RobotState, stops: Sequence[str], *, entered_blocked: bool
    ) -> None:
        """Check the time since the last check, `elapsed_s` (s of the clock).

        Raises `TooFastError` if the processes were late in several checks in a row, or late while the robot stopped;
        never if the robot has entered a blocked area.
        """
        self._sustained.append(truth.sustained_speed)
        new_late = max(0, state.loop.late - self._late_cycles)
        self._late_cycles = state.loop.late
        slow = truth.sustained_speed < MIN_SPEED_SHARE * self._speed
        late = new_late / elapsed_s > MAX_LATE_CYCLES_PER_S
        self._late_checks = self._late_checks + 1 if slow or late else 0
        new_stops, self._stops_seen = stops[self._stops_seen :], len(stops)
        stopped = bool(new_stops) and (slow or new_late > 0)
        if self._speed > 1.0 and not entered_blocked and (stopped or self._late_checks >= MAX_LATE_CHECKS):
            reason = (
                f"{truth.sustained_speed:.2f} sustained, {new_late} of the agent's cycles late in {elapsed_s:.0f} s"
            )
            raise TooFastError(truth.sustained_speed, "; ".join([reason, *(new_stops if stopped else [])]))

    def check_outcome(
        self,
        outcome: DriveOutcome,
        truth: SimTruth | None,
        stops: Sequence[str],
        *,
        entered_blocked: bool,
        hazard_placed: bool,
    ) -> None:
        """Raise `TooFastError` if the speed caused the outcome, not the robot.

        This holds for a drive that failed while processes were late, and for one that reached its goal but stopped
        without a cause in its scenario. Contact or a blocked area entered is never excused: what stops the robot must
        work at any speed. A stop alone excuses neither a drive that failed nor one without its hazard
        (`hazard_placed`).
        """
        if self._speed <= 1.0 or entered_blocked or outcome.kind == "contact":
            return
        sustained = truth.sustained_speed if truth is not None else 1.0
        if outcome.kind == "reached":
            if stops and hazard_placed:
                raise TooFastError(sustained, f"the robot reached its goal, but stopped before: {'; '.join(stops)}")
        elif self._late_checks:
            raise TooFastError(sustained, f"{outcome.kind}: {outcome.reason}")
