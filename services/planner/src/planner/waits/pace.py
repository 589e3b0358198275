"""How long robots take for their ways: the time at the usual speed or the limits', times each one's pace. Pure.

A way's time at those speeds is a lower bound, which no turn, narrow place, start or arrival is part of. By how much a
robot exceeds it is learned from its drives: the ratio of both, for each stretch that it drove by one plan.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Final, NamedTuple

import numpy as np
from msgspec import Meta

from fog_contracts.messages import Arrival, Message
from fog_kernels.course import sampled_along, seconds_along
from planner.planning_map import USUAL_SPEED

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

    from fog_contracts.grid import GridGeometry
    from planner.path_search import Route

    Floats = NDArray[np.float64]
    Grid = NDArray[np.uint8]


class Times(NamedTuple):
    """How long a way takes at the usual speed or the limits': places along it (m), and the time to each (s)."""

    along: Floats
    seconds: Floats

    @classmethod
    def of(cls, route: Route, limits: Grid, geometry: GridGeometry, begin: float = 0.0) -> Times:
        """Return the times of a route from `begin` (m) on by the limits in its cells (cm/s, 0: none)."""
        points, along = sampled_along(route.remaining(begin) if begin > 0.0 else route.corners, route.spacing)
        place = geometry.origin_x, geometry.origin_y, geometry.resolution
        return cls(along, seconds_along(points, along, limits, place, USUAL_SPEED))

    def at(self, along: float) -> float:
        """Return the time (s) to a place (m) along the way."""
        return float(np.interp(along, self.along, self.seconds))

    def rest(self, along: float) -> float:
        """Return the time (s) from a place (m) along the way to its end."""
        return float(self.seconds[-1]) - self.at(along)


_PRIOR: Final = ((20.0, 1.0), (20.0, 1.1), (20.0, 1.3))
"""What is assumed of a robot that has not driven yet: times (s) at the usual speed, and ratios."""
_KEPT: Final = 40
"""Stretches that are kept of each robot, the newest ones."""
_SHORT_S: Final = 8.0
"""A stretch that takes less at the usual speed tells too little."""
ARRIVAL_S: Final = 2.5
"""What the arrival at a goal takes beyond that: the robot brakes, and comes to rest within its tolerance."""
_GAP_S: Final = 2.0
"""Of a robot that was not heard of for longer nobody knows whether it drove."""
_QUANTILES: Final = (0.05, 0.95)


class PaceRecord(Message, frozen=True, kw_only=True):
    """A robot's last stretches as they are stored: the time (s) at the usual speed or the limits', and the ratio."""

    stretches: list[tuple[Annotated[float, Meta(gt=0.0, le=1e6)], Annotated[float, Meta(gt=0.0, le=1e3)]]]


class _Stretch(NamedTuple):
    """What a robot drives by one plan: times at the usual speed when it began and now (s), how long it took, when.

    `begin` is later by what was driven in time that does not count.
    """

    plan_id: int
    begin: float
    at: float
    took: float
    now: float


class Paces:
    """The paces of all robots; times are s of the planner's monotonic clock."""

    def __init__(self) -> None:
        self._kept: dict[str, list[tuple[float, float]]] = {}
        self._driving: dict[str, _Stretch] = {}
        self._changed: set[str] = set()

    def on_progress(self, robot: str, plan_id: int, seconds: float, now: float, *, drives: bool) -> None:
        """Note where on a plan a robot is: `seconds` from its begin at the usual speed. Time counts while it drives."""
        known = self._driving.get(robot)
        if known is None or known.plan_id != plan_id:
            self.end(robot)
            self._driving[robot] = _Stretch(plan_id, seconds, seconds, 0.0, now)
            return
        at, begin, took = max(known.at, seconds), known.begin, known.took
        if drives and now - known.now <= _GAP_S:
            took += now - known.now
        else:
            begin += at - known.at  # what it drove meanwhile counts as little as the time that it took
        self._driving[robot] = known._replace(begin=begin, at=at, took=took, now=now)

    def end(self, robot: str, seconds: float | None = None) -> None:
        """End a robot's stretch: it has reached the goal, `seconds` from the begin, or drives by another plan."""
        known = self._driving.pop(robot, None)
        if known is None:
            return
        usual = (known.at if seconds is None else seconds) - known.begin
        took = known.took - (0.0 if seconds is None else ARRIVAL_S)
        if usual >= _SHORT_S and took > 0.0:
            self._kept[robot] = [*self._kept.get(robot, []), (usual, took / usual)][-_KEPT:]
            self._changed.add(robot)

    def arrival(self, robot: str, seconds: float) -> Arrival:
        """Return how long a robot takes for a way of so many seconds at the usual speed."""
        stretches = [*_PRIOR, *self._kept.get(robot, [])]
        seconds_driven, ratios = np.array(stretches).T
        counts = np.ones(len(stretches))
        if len(stretches) > 2 * len(_PRIOR):
            counts[: len(_PRIOR)] = 0.1
        # Long stretches tell most of the pace, and as much as short ones of how much drives differ.
        order = np.argsort(ratios)
        below = (np.cumsum(counts[order]) - 0.5 * counts[order]) / counts.sum()
        low, high = np.interp(_QUANTILES, below, ratios[order])
        expected = float(np.average(ratios, weights=seconds_driven * counts))
        return Arrival(
            earliest_s=round(seconds * float(low) + ARRIVAL_S, 1),
            expected_s=round(seconds * expected + ARRIVAL_S, 1),
            latest_s=round(seconds * float(high) + ARRIVAL_S, 1),
        )

    # --- Redis ------------------------------------------------------------------------------------------------------

    def to_store(self) -> dict[str, PaceRecord]:
        """Return the records of the robots that have driven since the last call."""
        due, self._changed = self._changed, set()
        return {robot: PaceRecord(stretches=[*self._kept[robot]]) for robot in due}

    def store_again(self, robots: Mapping[str, PaceRecord]) -> None:
        """Note that these could not be stored."""
        self._changed.update(robots)

    def restore(self, records: Mapping[str, PaceRecord]) -> None:
        """Continue with what is stored."""
        self._kept = {robot: record.stretches[-_KEPT:] for robot, record in records.items()}
        self._changed = set()
