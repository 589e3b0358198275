"""Where on its path the robot is, how much of it is released, and where it is blocked. Frame: `map`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts.costs import INSCRIBED, LETHAL, UNKNOWN
from fog_kernels.lines import nearest_on

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_contracts.grid import GridGeometry

_SEARCH_BACK_M: Final = 0.5
_SEARCH_AHEAD_M: Final = 2.5
_OFF_PATH_M: Final = 1.0
_PROGRESS_M: Final = 0.1
_SLOW_M_S: Final = 0.1
"""A robot that must drive more slowly than this gets longer before it counts as stuck."""
_END_M: Final = 0.05
"""A path released to within this of its end counts as released whole: rounded points change its length."""


class PathFollower:
    """Progress of the robot along a path. It is searched near the last progress only, so a path may cross itself."""

    def __init__(self, points: NDArray[np.float64], released_length: float) -> None:
        self.points = np.ascontiguousarray(points, np.float64)
        deltas = self.points[1:] - self.points[:-1]
        lengths = np.sqrt(deltas[:, 0] ** 2 + deltas[:, 1] ** 2)
        self.along = np.concatenate(([0.0], np.cumsum(lengths)))
        """Metres from the path's start to each point."""
        self.released = 0.0
        self.release(released_length)
        self.progress = 0.0
        self.distance = 0.0
        """Metres from the robot to the path, as of the last `advance`."""
        self._started = False
        self._best_progress = 0.0
        self._best_at: float | None = None

    @property
    def length(self) -> float:
        """Metres of the whole path."""
        return float(self.along[-1])

    @property
    def released_remaining(self) -> float:
        """Metres of released path ahead of the robot."""
        return max(0.0, self.released - self.progress)

    @property
    def remaining(self) -> float:
        """Metres of path ahead of the robot."""
        return max(0.0, self.length - self.progress)

    def release(self, length: float) -> None:
        """Update how much of the path (m) is released."""
        self.released = length if length < self.length - _END_M else self.length

    def advance(self, x: float, y: float, now: float) -> None:
        """Update the progress from the robot's position (m)."""
        low, high = 0.0, math.inf
        if self._started:
            low, high = self.progress - _SEARCH_BACK_M, self.progress + _SEARCH_AHEAD_M
        found = self._nearest(x, y, low, high)
        if found[1] > _OFF_PATH_M:
            found = self._nearest(x, y, 0.0, math.inf)
        self.progress, self.distance = found
        self._started = True
        if self._best_at is None or self.progress > self._best_progress + _PROGRESS_M:
            self._best_progress, self._best_at = self.progress, now

    def restart_progress_timer(self, now: float) -> None:
        """Restart the timer of `stuck_for`: a robot that must not drive is not stuck."""
        self._best_at = now

    def stuck_for(self, now: float) -> float:
        """Seconds without progress while driving was allowed."""
        return 0.0 if self._best_at is None else now - self._best_at

    def released_ahead(self, limit: float) -> tuple[NDArray[np.float64], bool]:
        """Return the next `limit` metres of the released path (n, 2), and whether its last point is the path's end."""
        end = min(self.progress + limit, self.released)
        end = max(end, self.progress)
        first, last = int(self.along.searchsorted(self.progress, "right")), int(self.along.searchsorted(end))
        points = np.empty((max(last - first, 0) + 2, 2))
        points[0], points[1:-1], points[-1] = self._point(self.progress), self.points[first:last], self._point(end)
        return points, end >= self.length - 1e-6

    def next_points(self, limit: float) -> NDArray[np.float64]:
        """Return those of the path's points (n, 2) that lie on the next `limit` metres of it, released or not."""
        first, last = self.along.searchsorted((self.progress, self.progress + limit))
        return self.points[first:last]

    def ahead(self, spacing: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return points (n, 2) every `spacing` metres of the rest of the path, and their distances ahead (m)."""
        count = max(2, math.ceil(self.remaining / spacing) + 1)
        step = (self.length - self.progress) / (count - 1)
        distances = np.arange(count, dtype=np.float64) * step + self.progress
        distances[-1] = self.length
        xs, ys = (np.interp(distances, self.along, self.points[:, i]) for i in (0, 1))
        return np.column_stack((xs, ys)), distances - self.progress

    def _point(self, along: float) -> tuple[float, float]:
        """Return the point so many metres along the path; its first or last one before its begin and beyond its end."""
        after = int(self.along.searchsorted(along, "right"))
        if after == 0 or after == len(self.along):
            x, y = self.points[min(after, len(self.points) - 1)].tolist()
            return x, y
        (x, y), (next_x, next_y) = self.points[after - 1 : after + 1].tolist()
        begin, end = self.along[after - 1 : after + 1].tolist()
        return (next_x - x) / (end - begin) * (along - begin) + x, (next_y - y) / (end - begin) * (along - begin) + y

    def _nearest(self, x: float, y: float, low: float, high: float) -> tuple[float, float]:
        if len(self.points) == 1:
            return 0.0, math.hypot(self.points[0, 0] - x, self.points[0, 1] - y)
        first = max(int(self.along.searchsorted(low)) - 1, 0)
        last = min(int(self.along.searchsorted(high, "right")), len(self.points) - 1)
        progress, distance = nearest_on(self.points, self.along, first, last, x, y)
        return (self.progress if math.isinf(distance) else progress), distance


def at_speed(cap: float) -> float:
    """Return which share of the time without progress counts for a robot that may go at `cap` (m/s) at most."""
    return min(cap / _SLOW_M_S, 1.0)


def first_blocked(
    cost: NDArray[np.uint8],
    geometry: GridGeometry,
    follower: PathFollower,
    skip: float = 0.5,
    *,
    known_to_planner: bool = False,
) -> float | None:
    """Return how far ahead (m) the rest of the path first meets a cell that the robot must not enter, or None.

    Inscribed and unknown cells count beyond the first `skip` metres, where the planner may lead the robot out of a
    tight place. Lethal ones count everywhere, unless the planner knew of them (`known_to_planner`).
    """
    points, ahead = follower.ahead(0.5 * geometry.resolution)
    cells = geometry.sample(cost, points, UNKNOWN)
    bad = (cells >= INSCRIBED) & (ahead > skip)
    if not known_to_planner:
        bad |= cells == LETHAL
    return float(ahead[int(bad.argmax())]) if bad.any() else None
