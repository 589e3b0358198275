"""Whether this machine keeps the speed that a demonstration was asked for. Pure: docs/adr/0008-what-excuses-a-demo.md.

At a speed that the machine can't sustain, periods and limits are missed although nothing is wrong with the system; the
demonstration then begins anew, more slowly. At speed 1 there is nothing to lower.
"""

from collections.abc import Sequence
from typing import Final

from fog_contracts.messages import RobotState, SimTruth
from fognav_sim.drive.evaluation import DriveOutcome

STRIKES: Final = 2
"""Checks in a row that find the processes late before the attempt is given up."""
KEPT_SHARE: Final = 0.93
"""Share of the asked speed that the simulator must keep."""
LATE_PER_S: Final = 3.0
"""Late beats per second of the agent's loops (25 are due) from which on it can't keep up."""
SLOWER: Final = 0.7


class TooFastError(Exception):
    """The machine does not keep the speed; `sustained` is the one that the simulator kept."""

    def __init__(self, sustained: float, why: str) -> None:
        super().__init__(why)
        self.sustained = sustained

    def lower(self, speed: float) -> float:
        """Return the speed to try next after `speed`."""
        return max(1.0, round(min(speed * SLOWER, self.sustained), 1))


class SpeedWatch:
    """Watches one attempt at a speed. `stops` are the stops of the drive that nothing in its scene asks for."""

    def __init__(self, speed: float) -> None:
        self._speed = speed
        self._strikes = 0
        self._late_beats = 0
        self._stops_seen = 0
        self._sustained: list[float] = []

    @property
    def sustained(self) -> float | None:
        """Mean of the speeds that the simulator kept, None before the first check."""
        return round(sum(self._sustained) / len(self._sustained), 2) if self._sustained else None

    def check(
        self, elapsed_s: float, truth: SimTruth, state: RobotState, stops: Sequence[str], *, entered_blocked: bool
    ) -> None:
        """Look at the `elapsed_s` (s of the clock) since the last check.

        Raises `TooFastError` when the processes have been late for a while, or late and the robot stopped for it; never
        when the robot has entered a blocked area.
        """
        self._sustained.append(truth.sustained_speed)
        fresh = max(0, state.loop.late - self._late_beats)
        self._late_beats = state.loop.late
        slow = truth.sustained_speed < KEPT_SHARE * self._speed
        late = fresh / elapsed_s > LATE_PER_S
        self._strikes = self._strikes + 1 if slow or late else 0
        new_stops, self._stops_seen = stops[self._stops_seen :], len(stops)
        stopped = bool(new_stops) and (slow or fresh > 0)
        if self._speed > 1.0 and not entered_blocked and (stopped or self._strikes >= STRIKES):
            why = f"{truth.sustained_speed:.2f} sustained, {fresh} of the agent's beats late in {elapsed_s:.0f} s"
            raise TooFastError(truth.sustained_speed, "; ".join([why, *(new_stops if stopped else [])]))

    def check_outcome(
        self,
        outcome: DriveOutcome,
        truth: SimTruth | None,
        stops: Sequence[str],
        *,
        entered_blocked: bool,
        hazard_done: bool,
    ) -> None:
        """Raise `TooFastError` when the haste is to blame for the outcome, and not the robot.

        A drive that failed while something was late is not counted, nor one at which the robot arrived, but stopped on
        its way although nothing in its scene asks for a stop. A touch or a blocked area entered is never excused: what
        stops the robot must work at any speed. Nor is a stop by itself an excuse for a drive that failed, or for one
        whose hazard never appeared (`hazard_done`).
        """
        if self._speed <= 1.0 or entered_blocked or outcome.kind == "contact":
            return
        sustained = truth.sustained_speed if truth is not None else 1.0
        if outcome.kind == "reached":
            if stops and hazard_done:
                raise TooFastError(sustained, f"it arrived, but stopped on its way: {'; '.join(stops)}")
        elif self._strikes:
            raise TooFastError(sustained, f"{outcome.kind}: {outcome.reason}")
