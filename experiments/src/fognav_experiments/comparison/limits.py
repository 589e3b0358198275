"""What bounds the savings that a comparison finds: the floor's geometry. Pure.

What knowing of an obstacle saves in distance is computed from the map alone, for a robot that decides at once: who is
warned turns the moment the obstacle appears, the other one the moment its lidar can see any point of it, and both then
know all of it and drive shortest paths.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from fog_contracts.costs import DEFAULT_INFLATION, LETHAL, Inflation
from fog_contracts.geometry import lengths_along
from fog_contracts.messages import Pose, RobotGoal
from fog_contracts.shapes import polygon_spans
from fog_kernels.astar import Planner
from fog_kernels.inflation import inflate, inflation_table, raise_costs
from fog_kernels.raycast import cast
from fognav_experiments.comparison.drives import ends_of
from fognav_experiments.figures import Block, Paragraph, Table, estimate, told
from fognav_experiments.onboard.navigator import Search
from fognav_sim.barrier import barrier_across
from fognav_sim.drive.hazard import PlannedHazard, is_clear_of_robot, remaining

if TYPE_CHECKING:
    from collections.abc import Hashable, Sequence

    from numpy.typing import NDArray

    from fog_contracts.geometry import Point
    from fog_contracts.messages import Place
    from fognav_experiments.comparison.drives import RouteDraw
    from fognav_sim.drive.hazard import SiteWithMap

    Floats = NDArray[np.float64]
    Cells = NDArray[np.uint8]


LIDAR_M: Final = 12.0
"""Reach of the experiment's lidar."""
_STEP_M: Final = 0.25
_SPACING_M: Final = 0.2
_TOLERANCE_M: Final = 0.1


class Saving(NamedTuple):
    """Distances (m) of a robot that nobody warns, and of one that is.

    `met`: whether the obstacle barred what was left of the way when it appeared.
    """

    unwarned_m: float
    warned_m: float
    met: bool

    @property
    def saved_m(self) -> float:
        """What the warning saves, m."""
        return self.unwarned_m - self.warned_m


class RouteGeometry:
    """Shortest paths on a site's map, with and without the obstacle of a draw."""

    def __init__(self, site: SiteWithMap) -> None:
        self._site = site
        inflation = Inflation(
            inscribed_radius=site.site.robots[0].radius,
            inflation_radius=DEFAULT_INFLATION.inflation_radius,
            cost_scaling=DEFAULT_INFLATION.cost_scaling,
        )
        grid = site.map.geometry
        self._table = inflation_table(grid.resolution, inflation)
        self._open = inflate(site.map.cells, self._table)
        self._walls = np.ascontiguousarray(site.map.cells == LETHAL, dtype=np.uint8)
        self._planner = Planner(grid.width, grid.height)

    @property
    def open_cost(self) -> Cells:
        """Inflated costs of the floor as the map shows it."""
        return self._open

    def way(self, start: Place, goal: Place) -> list[Point] | None:
        """Return the shortest way (m) between two places; None if none leads there."""
        found = self._path(self._open, (start.x, start.y), (goal.x, goal.y))
        return None if found is None else [(x, y) for x, y in found.tolist()]

    def saving(self, drawn: RouteDraw) -> Saving | None:
        """Return what a warning saves on a drawn route; None if the obstacle leaves no way to the goal."""
        start, goal = ends_of(self._site, drawn)
        hazard = self._hazard(drawn)
        polygon = np.array(hazard.barrier.polygon)
        closed = self._with(polygon)
        way = self._path(self._open, (start.x, start.y), (goal.x, goal.y))
        if way is None:
            return None
        length = float(lengths_along(way)[-1])
        appears = _appears_at(hazard, way)
        if appears is None:
            return Saving(length, length, met=False)
        warned = self._rest(closed, way, appears, goal.x, goal.y)
        seen = self._first_sight(way, appears, polygon)
        unwarned = length if seen is None else self._rest(closed, way, seen, goal.x, goal.y)
        if warned is None or unwarned is None:
            return None
        left = np.array(remaining([(x, y) for x, y in way.tolist()], appears))
        met = bool(np.any(closed[self._rows(left)] >= LETHAL))
        return Saving(unwarned, min(warned, unwarned), met)

    def _hazard(self, drawn: RouteDraw) -> PlannedHazard:
        site = self._site.site
        area = next(area for area in site.areas if area.id == drawn.area)
        return PlannedHazard(area, barrier_across(area, site, self._site.map, drawn.seed), drawn.trigger_m)

    def _with(self, polygon: Floats) -> Cells:
        """Return the costs with an obstacle on the floor.

        Its outermost cells are those that it touches: of those whose centre it covers alone, a gap of 0.30 m beside a
        barrier looked wide enough for a robot of 0.34 m, and on one recorded floor the way seemed never barred.
        """
        cells, grid = self._site.map.cells.copy(), self._site.map.geometry
        middle = polygon.mean(axis=0)
        away = polygon - middle
        grown = middle + away + np.sign(away) * grid.resolution
        spans = polygon_spans([(float(x), float(y)) for x, y in grown], grid)
        window = spans.window
        part = np.ascontiguousarray(cells[window.rows, window.columns])
        raise_costs([(spans, LETHAL)], window.x, window.y, part)
        cells[window.rows, window.columns] = part
        return inflate(cells, self._table)

    def _rows(self, way: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        cells, inside = self._site.map.geometry.cells(_every(way, _STEP_M / 5))
        return cells[inside][:, 1], cells[inside][:, 0]

    def _path(self, cost: Cells, start: tuple[float, float], goal: tuple[float, float]) -> Floats | None:
        wanted = RobotGoal(goal_id="geometry", pose=Pose(x=goal[0], y=goal[1], theta=0.0))
        search = Search(planner=self._planner, cost=cost, geometry=self._site.map.geometry, start=start, goal=wanted)
        found = search.run()
        return np.array(found.points) if found.points else None

    def _rest(self, cost: Cells, way: Floats, driven: float, x: float, y: float) -> float | None:
        """Return the length (m) of the way up to `driven`, and from there on the shortest one at these costs."""
        px, py = _at(way, driven)
        rest = self._path(cost, (px, py), (x, y))
        return None if rest is None else driven + float(lengths_along(rest)[-1])

    def _first_sight(self, way: Floats, since: float, polygon: Floats) -> float | None:
        """Return the distance (m) along the way, at least `since`, from which the lidar sees some of an obstacle."""
        outline = _every(np.vstack((polygon, polygon[:1])), _SPACING_M)
        grid = self._site.map.geometry
        for driven in np.arange(since, lengths_along(way)[-1], _STEP_M):
            x, y = _at(way, float(driven))
            away = outline - (x, y)
            distances = np.hypot(away[:, 0], away[:, 1])
            near = distances <= LIDAR_M
            if not near.any():
                continue
            angles = np.arctan2(away[near, 1], away[near, 0])
            free = cast(self._walls, grid.resolution, grid.origin_x, grid.origin_y, x, y, angles, LIDAR_M + 1.0)
            if (free >= distances[near] - _TOLERANCE_M).any():
                return float(driven)
        return None


def _appears_at(hazard: PlannedHazard, way: Floats) -> float | None:
    """Return the distance (m) along the way at which an obstacle appears: once it is due and the robot is away."""
    for driven in np.arange(hazard.trigger_m, lengths_along(way)[-1], _STEP_M).tolist():
        if is_clear_of_robot(hazard, _at(way, driven)):
            return float(driven)
    return None


def _at(way: Floats, driven: float) -> tuple[float, float]:
    along = lengths_along(way)
    return float(np.interp(driven, along, way[:, 0])), float(np.interp(driven, along, way[:, 1]))


def _every(way: Floats, spacing: float) -> Floats:
    """Return points of a line, `spacing` (m) apart."""
    along = lengths_along(way)
    places = np.append(np.arange(0.0, along[-1], spacing), along[-1])
    return np.column_stack((np.interp(places, along, way[:, 0]), np.interp(places, along, way[:, 1])))


SPEED_M_S: Final = 0.30
"""The robot's highest speed: no drive saves its metres faster."""
_NOTHING_M: Final = 0.05
"""What a map allows to save below one of its cells is rounding: no share of it means anything."""


class Saved(NamedTuple):
    """What the map allows to save on a drive, what was saved (m, s), and of which situation the drive is."""

    allowed: Saving
    metres: float
    seconds: float
    situation: Hashable


def allowed_savings(drives: Sequence[Saved]) -> list[Block]:
    """Return what the map allows to save beside what was measured."""
    if not drives:
        return []
    rows = []
    for subject, chosen in (
        ("all drives", drives),
        ("obstacle on the way", [drive for drive in drives if drive.allowed.met]),
    ):
        if not chosen:
            continue
        known = [drive.situation for drive in chosen]
        allowed, metres = [drive.allowed.saved_m for drive in chosen], [drive.metres for drive in chosen]
        possible = estimate(allowed).mean
        share = f"{100.0 * estimate(metres).mean / possible:.0f} %" if possible >= _NOTHING_M else "-"
        rows.append([
            subject, str(len(chosen)), str(len(set(known))), told(allowed, known), told(metres, known), share,
            f"{possible / SPEED_M_S:.1f}", told([drive.seconds for drive in chosen], known),
        ])  # fmt: skip
    return [
        Paragraph(
            "Warned and unwarned robots were also computed from the map alone. Both drive shortest paths; the one "
            "turns when the obstacle appears, the other when its lidar, 12 m of reach, could see any point of it. "
            "This is what a warning can save on this floor, however well a robot drives. Where the measured saving is "
            "larger, the unwarned robot drove nearer before it was sure."
        ),
        Table(
            [
                "default - fog", "drives", "situations", "the map allows, m", "measured, m", "share",
                f"the map allows at {SPEED_M_S} m/s, s", "measured, s",
            ],
            rows,
        ),
    ]  # fmt: skip
