"""What cuts a robot off: the same as looking at the whole map without each hazard and zone."""

from __future__ import annotations

import numpy as np
from hypothesis import example, given, settings
from hypothesis import strategies as st

from fog_contracts.costs import DEFAULT_INFLATION, FREE, INSCRIBED, LETHAL
from fog_contracts.grid import GridGeometry
from fog_contracts.messages import RectangleShape, Zone
from fog_contracts.replica import Version
from fog_contracts.shapes import rasterize_shape
from fog_kernels.astar import Planner
from fog_kernels.components import Components
from fog_kernels.distance import squared_distance_capped
from fog_kernels.inflation import inflate, inflation_table
from planner.planning_map import PlanningMap
from planner.refusals import Cuts
from planner.regions import Region, Regions

RES = 0.1
REACH = DEFAULT_INFLATION.inscribed_radius / RES
GEOMETRY = GridGeometry(48, 32, RES, 0.0, 0.0)
TABLE = inflation_table(RES, DEFAULT_INFLATION)

Box = tuple[int, int, int, int]
Cell = tuple[int, int]

boxes = st.tuples(st.integers(0, 44), st.integers(0, 28), st.integers(1, 40), st.integers(1, 30))
"""Column, row, width and height."""


def make_map(
    walls: list[Box], zones: list[Box], obstacles: list[Cell], ended: list[Box]
) -> tuple[PlanningMap, list[Region]]:
    static = np.zeros(GEOMETRY.shape, np.uint8)
    for x, y, width, height in walls:
        static[y : y + height, x : x + min(width, 3)] = LETHAL
    raw, sources = static.copy(), []
    for number, (x, y, width, height) in enumerate(zones):
        corner, opposite = (RES * x, RES * y), (RES * min(x + width, 48), RES * min(y + height, 32))
        sources.append(Zone(id=f"z{number}", kind="BLOCKED", shape=RectangleShape(corner=corner, opposite=opposite)))
        window, mask = rasterize_shape(sources[-1].shape, GEOMETRY)
        raw[window.rows, window.columns][mask] = LETHAL
    for column, row in obstacles:
        raw[row, column] = LETHAL
    for x, y, width, height in ended:  # of these the map shows nothing
        opposite = (RES * min(x + width, 48), RES * min(y + height, 32))
        shape = RectangleShape(corner=(RES * x, RES * y), opposite=opposite)
        sources.append(Zone(id="ended", kind="BLOCKED", shape=shape))
    lower_bound = inflate(static, TABLE)
    planning_map = PlanningMap(GEOMETRY, Version(1, 1, 1), inflate(raw, TABLE), static, lower_bound, lower_bound)
    regions = Regions(DEFAULT_INFLATION)
    return planning_map, regions.of(GEOMETRY, sources)


def connected_without(planning_map: PlanningMap, regions: list[Region], ended: list[Region], a: Cell, b: Cell) -> bool:
    """Whether two cells are connected once some regions have ended, by the definition, on the whole map."""
    closings = np.zeros(GEOMETRY.shape, np.int64)
    obstacles = (planning_map.cost == LETHAL) & (planning_map.static == FREE)
    for region in regions:
        rows, columns = region.window.rows, region.window.columns
        closings[rows, columns] += region.closed & (region not in ended)
        obstacles[rows, columns] &= ~region.cells
    closed = planning_map.lower_bound >= INSCRIBED
    if obstacles.any():
        closed |= squared_distance_capped(obstacles, int(REACH) + 1) <= REACH * REACH + 1e-6
    passable = (planning_map.cost < INSCRIBED) | ((closings == 0) & ~closed)
    return Components(np.where(passable, FREE, LETHAL).astype(np.uint8)).connected(a, b)


def far_cells(planning_map: PlanningMap) -> tuple[Cell, Cell] | None:
    """Return a cell of the leftmost component and one of another; None without two."""
    labels = planning_map.components.labels(*GEOMETRY.whole)
    cells = [(column, row) for column, row in np.argwhere(labels.T >= 0).tolist()]
    start = next(iter(cells), None)
    others = [cell for cell in cells if start and labels[cell[::-1]] != labels[start[::-1]]]
    return (start, others[-1]) if start and others else None


@settings(max_examples=150, deadline=None)
@given(
    walls=st.lists(boxes, max_size=3),
    zones=st.lists(boxes, min_size=1, max_size=6),
    obstacles=st.lists(st.tuples(st.integers(0, 47), st.integers(0, 31)), max_size=2),
    ended=st.lists(boxes, max_size=2),
)
@example(walls=[], zones=[(0, 0, 1, 18), (5, 22, 1, 8)], obstacles=[], ended=[])  # parts that touch at a corner only
def test_regions_that_cut_off_alone_are_those_without_which_the_whole_map_has_a_way(
    walls: list[Box], zones: list[Box], obstacles: list[Cell], ended: list[Box]
) -> None:
    # One zone from wall to wall, so that most examples have two parts.
    planning_map, all_regions = make_map(walls, [(22, 0, 2, 32), *zones], obstacles, ended)
    regions = [region for region in all_regions if region.is_on(planning_map)]
    found = far_cells(planning_map)
    if found is None:
        return
    planner = Planner(GEOMETRY.width, GEOMETRY.height)
    cut = Cuts(planning_map, all_regions, lambda: planner, REACH).between(*found)
    expected = [region for region in regions if connected_without(planning_map, regions, [region], *found)]
    if not Components(planning_map.lower_bound).connected(*found):
        assert (cut.kind, expected) == ("walls", [])
    elif expected:
        assert (cut.kind, cut.jointly, list(cut.regions)) == ("regions", False, expected)
    elif cut.kind == "regions":
        assert cut.jointly
        assert connected_without(planning_map, regions, list(cut.regions), *found)
        for region in cut.regions:
            fewer = [other for other in cut.regions if other is not region]
            assert not connected_without(planning_map, regions, fewer, *found)
    else:
        assert cut.kind == "obstacles"
        assert not connected_without(planning_map, regions, regions, *found)


def test_region_that_cuts_off_alone_is_found_without_memory_for_searches() -> None:
    planning_map, regions = make_map([], [(22, 0, 2, 32), (5, 5, 3, 3)], [], [])

    def planner() -> Planner:
        raise AssertionError("no search is needed")

    cut = Cuts(planning_map, regions, planner, REACH).between((2, 16), (45, 16))
    assert [region.cause.id for region in cut.regions] == ["z0"]
