"""Measures path searches on a floor: from scratch, and again after a hazard on the path, against exact references.

Every query is planned from scratch by A*, guided by landmarks as for a goal that has no field yet. Its cost is compared
with that of a Dijkstra search from the goal, which is another kernel, and with the length that a scenario of the
MovingAI benchmarks publishes. Then a hazard is put onto the path, and the path is planned again as the planner does it:
from the robot, guided by the goal's field over the floor without the hazard, or, if the hazard is nearer to the goal,
from the goal, guided by the field of where the robot began. Its cost is compared with that of a search without a guide
on the same costs.

Times are of the processor, so that other work on the machine counts little, with cold caches, and in turn with the
searches of other packages that are installed.
"""

from __future__ import annotations

import dataclasses
import itertools
import math
import time
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Final, NamedTuple, TypeVar

import numpy as np

from fog_contracts.costs import DEFAULT_INFLATION, INSCRIBED, LETHAL, NEUTRAL_WEIGHT
from fog_kernels.astar import Planner
from fog_kernels.components import Components
from fog_kernels.inflation import inflate, inflation_table
from fog_kernels.landmarks import Landmarks
from fog_kernels.lines import line_cost
from fog_kernels.steps import STRAIGHT
from fog_kernels.tiles import TilePatterns
from fog_runtime.configuration.maps import MapTextError, load_map, read_map_text
from fognav_experiments.bench.common import make_office
from fognav_experiments.bench.fleet import percentile
from fognav_experiments.bench.path_peers import gradient_path_cost, installed_peers
from planner.config import PlannerConfig

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from fog_contracts.grid import StaticMap
    from fog_kernels.guides import GoalField

    Cell = tuple[int, int]
    Grid = NDArray[np.uint8]

_HAZARD_CELLS: Final = 40
"""Side of the hazard: 2 m at 5 cm."""
_ALONG: Final = (0.3, 0.7)
"""Where on the path the hazard lies, as shares of its cells ..."""
_NEAR_GOAL: Final = (0.9, 0.95)
"""... and where it lies near the goal."""
_PATTERN_BYTES: Final = 200_000_000


class Query(NamedTuple):
    """Start and goal (column, row), and the published length of the shortest path (cells) on a map without margins."""

    start: Cell
    goal: Cell
    length: float | None = None


@dataclass(frozen=True)
class Floor:
    """What is searched: the cells of the map as they are, the costs, and how these follow from those."""

    raw: Grid
    costmap: Grid
    costs_of: Callable[[Grid], Grid]


def load_floor(map_file: Path | None, seed: int) -> Floor:
    """Return the floor of a map_server YAML or of MovingAI's `.map`, or an office.

    Raises `MapTextError`, `MapFileError` and `OSError`.
    """
    if map_file is not None and map_file.suffix == ".map":
        return read_movingai(map_file)
    return floor_of(make_office(seed=seed) if map_file is None else load_map(map_file))


def floor_of(static: StaticMap) -> Floor:
    """Return the floor of a map with the margins that a robot's planner keeps."""
    table = inflation_table(static.geometry.resolution, DEFAULT_INFLATION)
    raw = np.ascontiguousarray(static.cells)
    return Floor(raw, inflate(raw, table), lambda cells: inflate(cells, table))


def read_movingai(path: Path) -> Floor:
    """Return the floor of a `.map` of the MovingAI benchmarks, without margins, as its lengths are.

    Raises `MapTextError` and `OSError`.
    """
    raw = read_map_text(path)
    return Floor(raw, raw.copy(), np.copy)


def read_scenario(path: Path, most: int) -> list[Query]:
    """Return up to `most` queries of a `.scen` file, spread over all of it; raises `MapTextError` and `OSError`."""
    lines = [line.split() for line in path.read_text("utf-8", errors="replace").splitlines()[1:] if line.strip()]
    try:
        queries = [Query((int(x), int(y)), (int(u), int(v)), float(length)) for *_, x, y, u, v, length in lines]
    except ValueError as error:
        raise MapTextError(f"{path}: needs rows of nine columns, as MovingAI's scenarios have ({error})") from error
    if not queries:
        raise MapTextError(f"{path}: has no queries")
    chosen = np.unique(np.linspace(0, len(queries) - 1, min(most, len(queries))).round().astype(int))
    return [queries[index] for index in chosen]


def long_queries(costmap: Grid, count: int, rng: np.random.Generator) -> list[Query]:
    """Return queries between free cells of the largest part of the floor, at least half of its diagonal apart."""
    components = Components(costmap)
    height, width = costmap.shape
    labels = components.labels(0, 0, width, height)
    largest = int(np.argmax(np.bincount(labels[labels >= 0])))
    rows, columns = np.nonzero((labels == largest) & (costmap < INSCRIBED // 2))
    least = 0.5 * math.hypot(float(np.ptp(rows)), float(np.ptp(columns)))
    queries: list[Query] = []
    while len(queries) < count:
        first, last = rng.integers(len(rows), size=2)
        if math.hypot(float(rows[first] - rows[last]), float(columns[first] - columns[last])) >= least:
            queries.append(Query((int(columns[first]), int(rows[first])), (int(columns[last]), int(rows[last]))))
    return queries


@dataclass
class Figures:
    """What was measured: times in ms, and how many results equal their references."""

    cold: list[float] = dataclasses.field(default_factory=list)
    """Searches that landmarks guide ..."""
    unguided: list[float] = dataclasses.field(default_factory=list)
    """... and the same without."""
    field: list[float] = dataclasses.field(default_factory=list)
    expansions: list[int] = dataclasses.field(default_factory=list)
    shortcut: list[float] = dataclasses.field(default_factory=list)
    corners: list[int] = dataclasses.field(default_factory=list)
    corners_at_first: list[int] = dataclasses.field(default_factory=list)
    second: list[float] = dataclasses.field(default_factory=list)
    """The same with a second search beside the path, guided by landmarks."""
    dearer: list[float] = dataclasses.field(default_factory=list)
    """By how many percent paths cost more than those along the gradient, after the second search ..."""
    dearer_at_first: list[float] = dataclasses.field(default_factory=list)
    """... and without it."""
    replan: list[float] = dataclasses.field(default_factory=list)
    replan_near_goal: list[float] = dataclasses.field(default_factory=list)
    closed: list[float] = dataclasses.field(default_factory=list)
    """Searches after a hazard that left no path."""
    peers: dict[str, list[float]] = dataclasses.field(default_factory=dict)
    optimal: int = 0
    replans_optimal: int = 0

    def summary(self) -> dict[str, float | int]:
        """Return the figures by the names of the command's JSON; without those of which there is none."""
        replans = len(self.replan) + len(self.replan_near_goal) + len(self.closed)
        dearer = [percent for percent in self.dearer if not math.isnan(percent)]
        at_first = [percent for percent in self.dearer_at_first if not math.isnan(percent)]
        figures: dict[str, float | int] = {
            "queries": len(self.cold),
            "optimal": self.optimal,
            "median_ms": percentile(self.cold, 50),
            "mean_ms": round(float(np.mean(self.cold)), 2),
            "p99_ms": percentile(self.cold, 99),
            "unguided_median_ms": percentile(self.unguided, 50),
            "unguided_p99_ms": percentile(self.unguided, 99),
            "expansions_median": int(np.median(self.expansions)),
            "field_median_ms": percentile(self.field, 50),
            "shortcut_median_ms": percentile(self.shortcut, 50),
            "second_median_ms": percentile(self.second, 50),
            "second_p99_ms": percentile(self.second, 99),
            "corners_mean": round(float(np.mean(self.corners)), 1),
            "corners_at_first_mean": round(float(np.mean(self.corners_at_first)), 1),
            "replans": replans,
            "replans_optimal": self.replans_optimal,
            "replans_closed": len(self.closed),
        }
        if dearer:
            figures["dearer_than_gradient_mean_percent"] = round(float(np.mean(dearer)), 2)
            figures["dearer_than_gradient_worst_percent"] = round(max(dearer), 2)
            figures["dearer_at_first_mean_percent"] = round(float(np.mean(at_first)), 2)
            figures["dearer_at_first_worst_percent"] = round(max(at_first), 2)
        for name, times in (("", self.replan), ("_near_goal", self.replan_near_goal), ("_closed", self.closed)):
            if times:
                figures[f"replan{name}_median_ms"] = percentile(times, 50)
                figures[f"replan{name}_p99_ms"] = percentile(times, 99)
        for name, times in self.peers.items():
            figures[f"{name}_median_ms"] = percentile(times, 50)
            ratios = [own / other for own, other in zip(self.cold, times, strict=True)]
            figures[f"ratio_to_{name}"] = round(float(np.median(ratios)), 3)
            figures[f"worst_ratio_to_{name}"] = round(max(ratios), 3)
        return figures


T = TypeVar("T")


def measure(
    floor: Floor, queries: Sequence[Query], rng: np.random.Generator, on_progress: Callable[[int], object]
) -> dict[str, object]:
    """Run all queries and return the figures; `on_progress` is called with the number of those that are done."""
    height, width = floor.costmap.shape
    planner, figures, landmarks = Planner(width, height), Figures(), Landmarks(width, height)
    begun = time.thread_time()
    while not landmarks.is_complete:
        landmarks.add(floor.costmap, planner.goal_field)
    built = time.thread_time() - begun
    peers, missing = installed_peers(floor.costmap)
    for number, query in enumerate(queries):
        _measure_query(floor, query, planner, landmarks, figures, rng)
        for name, search in peers.items():
            _timed(figures.peers.setdefault(name, []), partial(search, query.start, query.goal))
        on_progress(number + 1)
    return {
        **figures.summary(),
        "landmarks": len(landmarks.fields),
        "landmarks_mb": round(landmarks.size / 1e6, 1),
        "landmarks_s": round(built, 2),
        "not_installed": ", ".join(missing) or "none",
    }


_OTHER_DATA: Final[NDArray[np.uint8]] = np.zeros(64_000_000, np.uint8)


def _timed(times: list[float], work: Callable[[], T]) -> T:
    """Do some work with cold caches, as between a robot's other tasks; note the processor's time (ms)."""
    _OTHER_DATA[::64] += 1
    begun = time.thread_time()
    done = work()
    times.append(1000.0 * (time.thread_time() - begun))
    return done


def _measure_query(  # what a query needs, and what it tells
    floor: Floor, query: Query, planner: Planner, landmarks: Landmarks, figures: Figures, rng: np.random.Generator
) -> None:
    start, goal, length = query
    costmap, patterns = floor.costmap, TilePatterns(_PATTERN_BYTES)
    unguided = _timed(figures.unguided, lambda: planner.plan(costmap, start, goal))
    found = _timed(figures.cold, lambda: planner.plan(costmap, start, goal, landmarks=landmarks))
    figures.expansions.append(found.expansions)
    guide = _timed(figures.field, lambda: planner.goal_field(costmap, goal, patterns))
    expected = math.inf if length is None else NEUTRAL_WEIGHT * length
    figures.optimal += unguided.cost == found.cost == _cost(guide, start, width=costmap.shape[1]) and (
        length is None or math.isclose(found.cost, expected, rel_tol=1e-5, abs_tol=NEUTRAL_WEIGHT * 5e-3)
    )
    if not found.found:
        return
    first = _timed(figures.shortcut, lambda: planner.shortcut(costmap, found.cells))
    most = PlannerConfig.second_expansions
    corners = _timed(figures.second, lambda: planner.straightened(costmap, found.cells, most, landmarks=landmarks))
    figures.corners.append(len(corners))
    figures.corners_at_first.append(len(first))
    if start != goal:
        least = gradient_path_cost(costmap, start, goal)
        for line, percents in ((first, figures.dearer_at_first), (corners, figures.dearer)):
            cost = sum(line_cost(costmap, *before, *after) for before, after in itertools.pairwise(line.tolist()))
            percents.append(100.0 * (cost / least - 1.0))
    if len(found.cells) <= 2 * _HAZARD_CELLS:
        return
    origin = planner.goal_field(costmap, start, patterns)
    for where, times in ((_ALONG, figures.replan), (_NEAR_GOAL, figures.replan_near_goal)):
        share = rng.uniform(*where)
        column, row = found.cells[round(share * (len(found.cells) - 1))].tolist()
        raised = _with_hazard(floor, column, row)
        if max(raised[start[1], start[0]], raised[goal[1], goal[0]]) >= INSCRIBED:
            continue  # the hazard lies on the robot or on its goal
        taken: list[float] = []
        if share <= 0.5:
            again = _timed(taken, partial(planner.plan, raised, start, goal, field=guide))
        else:
            again = _timed(taken, lambda: planner.plan(raised, goal, start, field=origin.toward(start)))  # noqa: B023  # called in this pass only
        figures.replans_optimal += again.cost == planner.plan(raised, start, goal).cost
        (times if again.found else figures.closed).extend(taken)


def _cost(guide: GoalField, start: Cell, *, width: int) -> float:
    """Return the cost that a goal's field has at a cell, in the unit of a plan's cost; infinite without a path."""
    cost = int(guide.costs(np.array([start[1] * width + start[0]], np.int32))[0])
    return math.inf if cost < 0 else cost / (2.0 * STRAIGHT)


def _with_hazard(floor: Floor, column: int, row: int) -> Grid:
    """Return the costs with a square hazard around a cell."""
    raw, half = floor.raw.copy(), _HAZARD_CELLS // 2
    raw[max(0, row - half) : row + half, max(0, column - half) : column + half] = LETHAL
    return floor.costs_of(raw)
