"""Bounds of the way round: never above the true cost, so that guided searches stay optimal, and worth their time."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import pytest
from compiler import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from shortest_paths import cell_of, costmaps, dijkstra, floors

from fog_contracts.costs import INSCRIBED
from fog_kernels.astar import Planner
from fog_kernels.dead_ends import DeadEnds
from fog_kernels.detour import Shadow, compare_levels
from fog_kernels.steps import SEALED, STRAIGHT
from fog_kernels.tiles import TilePatterns

if TYPE_CHECKING:
    from numpy.typing import NDArray


def raise_somewhere(costmap: NDArray[np.uint8], data: st.DataObject) -> NDArray[np.uint8]:
    """Return the costmap with a rectangle of higher costs."""
    raised = costmap.copy()
    height, width = costmap.shape
    x, y = cell_of(data, costmap)
    patch = raised[y : y + data.draw(st.integers(1, height)), x : x + data.draw(st.integers(1, width))]
    np.maximum(patch, data.draw(st.sampled_from([30, 200, 253, 254, 255])), out=patch)
    return raised


@settings(max_examples=examples(200), deadline=None)
@given(st.one_of(costmaps(), floors()), st.data())
def test_searches_guided_by_field_and_detour_equal_full_searches(bound: NDArray[np.uint8], data: st.DataObject) -> None:
    planner, patterns = Planner(bound.shape[1], bound.shape[0]), TilePatterns(10**6)
    reference = planner.goal_field(bound, cell_of(data, bound), patterns)
    closed = raise_somewhere(raise_somewhere(bound, data), data)
    starts = [cell_of(data, bound) for _ in range(data.draw(st.integers(1, 4)))]
    dead_ends = DeadEnds(bound, planner.weight) if data.draw(st.booleans()) else None
    shadow = Shadow(closed, bound, reference, starts, planner, dead_ends, [cell_of(data, bound)])
    levels = np.maximum(reference.costs(shadow.border), 0)
    detour = shadow.detour(levels + data.draw(st.integers(0, 10**6)) * np.arange(len(levels)))
    if detour is None:
        assert len(shadow.border) == 0
        return
    later = raise_somewhere(closed, data)
    for costmap in (closed, later) if detour.holds(later) else (closed,):
        for start in starts:
            goal = cell_of(data, bound)
            if not shadow.contains(start) or not detour.outside(goal):
                continue
            field = planner.goal_field(bound, goal, patterns)
            for _ in range(data.draw(st.integers(0, 2))):
                field = field.coarser()
            expected = dijkstra(costmap, start).get(goal)
            found = planner.plan(costmap, start, goal, field=field, detour=detour)
            assert found.cost == (math.inf if expected is None else expected / (2 * STRAIGHT))
            offset = detour.offset(field)
            if expected is not None and offset is not None:
                assert min(int(detour.costs[start[1], start[0]]), detour.highest) + offset <= expected
                assert detour.covers(start)


@settings(max_examples=examples(200), deadline=None)
@given(floors(), st.data())
def test_bound_that_begins_with_a_goals_costs_is_that_goals_exact_cost(
    bound: NDArray[np.uint8], data: st.DataObject
) -> None:
    planner, goal = Planner(bound.shape[1], bound.shape[0]), cell_of(data, bound)
    reference = planner.goal_field(bound, goal, TilePatterns(10**6))
    closed = raise_somewhere(bound, data)
    closed[goal[1], goal[0]] = bound[goal[1], goal[0]]  # else the way into the goal costs more than its field knows
    starts = [cell_of(data, bound) for _ in range(3)]
    dead_ends = DeadEnds(bound, planner.weight) if data.draw(st.booleans()) else None
    shadow = Shadow(closed, bound, reference, starts, planner, dead_ends)
    detour = shadow.detour(np.maximum(reference.costs(shadow.border), 0))
    if detour is None or closed[goal[1], goal[0]] >= INSCRIBED or (offset := detour.offset(reference)) is None:
        return
    costs = dijkstra(closed, goal)
    for start in starts:
        if detour.covers(start) and start in costs:
            assert int(detour.costs[start[1], start[0]]) + offset == costs[start]


@settings(max_examples=examples(60), deadline=None)
@given(costmaps(), st.data())
def test_what_earlier_searches_left_in_memory_changes_nothing(bound: NDArray[np.uint8], data: st.DataObject) -> None:
    height, width = bound.shape
    goal, starts = cell_of(data, bound), [cell_of(data, bound) for _ in range(3)]
    closed = raise_somewhere(raise_somewhere(bound, data), data)
    found = []
    for left in (0, 7, -5, (1 << 30) + 3):
        planner, patterns = Planner(width, height), TilePatterns(10**6)
        reference = planner.goal_field(bound, goal, patterns)
        for memory in planner.scratch:
            memory.fill(left)
        shadow = Shadow(closed, bound, reference, starts, planner)
        inside = [(x, y) for y in range(height) for x in range(width) if shadow.contains((x, y))]
        levels = np.maximum(reference.costs(shadow.border), 0)
        detour = shadow.detour(levels)
        assert inside == [(x, y) for y in range(height) for x in range(width) if shadow.contains((x, y))]
        found.append((inside, shadow.border.tolist(), None if detour is None else detour.costs.tolist()))
    assert all(other == found[0] for other in found)


def test_least_rise_is_the_lowest_difference_at_the_cells_with_a_path_to_the_goal() -> None:
    bound = np.zeros((6, 20), np.uint8)
    bound[:, 10] = 254
    field = Planner(20, 6).goal_field(bound, (15, 3), TilePatterns(10**6))
    cells, levels = np.array([12, 5, 59], np.int32), np.array([7, -(10**9), 900], np.int64)
    for each in (field, field.coarser()):
        costs = each.costs(cells)
        assert each.least_rise(cells, levels) == min(costs[0] - 7, costs[2] - 900)
    assert field.least_rise(cells[1:2], levels[1:2]) is None  # it is behind the wall
    with pytest.raises(ValueError, match="each of the 3 cells, not 2"):
        field.least_rise(cells, levels[:2])


def test_labels_of_another_type_or_size_are_refused() -> None:
    bound = np.zeros((6, 20), np.uint8)
    planner = Planner(20, 6)
    field = planner.goal_field(bound, (15, 3), TilePatterns(10**6))
    with pytest.raises(ValueError, match="each of the 120 cells, not 119"):
        Shadow(bound, bound, field, [(2, 2)], planner, label=np.zeros(119, np.int32))
    with pytest.raises(TypeError, match="label must be int32"):
        Shadow(bound, bound, field, [(2, 2)], planner, label=np.zeros(120, np.int64))


@pytest.mark.parametrize("other", [(7, 20), (5, 20), (20, 6)])
def test_costmap_or_bound_of_another_shape_than_the_planners_is_refused(other: tuple[int, int]) -> None:
    bound, wrong = np.zeros((6, 20), np.uint8), np.zeros(other, np.uint8)
    planner = Planner(20, 6)
    field = planner.goal_field(bound, (15, 3), TilePatterns(10**6))
    for costmap, least in ((wrong, bound), (bound, wrong), (wrong, wrong)):
        with pytest.raises(ValueError, match="planner's shape") as refused:
            Shadow(costmap, least, field, [(2, 2)], planner)
        assert str(refused.value).endswith(f"(6, 20), not {costmap.shape} and {least.shape}")


def test_room_whose_corners_are_left_through_what_is_sealed_is_no_way_out() -> None:
    bound = np.full((54, 60), 254, np.uint8)
    bound[1:12, 1:58] = 0
    bound[5:8, 5:54] = 254  # a ring of corridors
    bound[1:5, 5:54] = 252  # the way round is expensive
    bound[12, 10:35] = 0  # a wide door, so that twelve rows of the room behind it are not left out
    bound[13:52, 3:45] = 0
    bound[14:16, 16:36] = 254
    bound[16:25, 18:25] = bound[16:25, 28:35] = 252  # between these one gets out by the far side, which is left out
    closed = bound.copy()
    closed[8:12, 48] = 254
    goal, start = (57, 10), (6, 10)
    planner = Planner(60, 54)
    reference = planner.goal_field(bound, goal, TilePatterns(10**6))
    shadow = Shadow(closed, bound, reference, [start], planner, DeadEnds(bound, planner.weight))
    detour = shadow.detour(reference.costs(shadow.border))
    assert detour is not None
    assert detour.costs[40, 20] == SEALED
    assert detour.costs[20, 26] != SEALED
    assert int(detour.costs[10, 6]) + (detour.offset(reference) or 0) == dijkstra(closed, goal)[start]


def test_closed_corridor_is_its_own_shadow_and_is_left_by_its_ends_only() -> None:
    bound = np.full((9, 40), 254, np.uint8)
    bound[1:8, 1:39] = 0
    bound[3, 3:37] = bound[5, 3:37] = 254
    bound[4, 3:37] = 0  # a corridor in the middle
    closed = bound.copy()
    closed[4, 30] = 254
    planner = Planner(40, 9)
    shadow = Shadow(closed, bound, planner.goal_field(bound, (38, 4), TilePatterns(10**6)), [(10, 4)], planner)
    assert shadow.contains((10, 4))
    assert shadow.contains((29, 4))
    assert not shadow.contains((30, 4))
    assert not shadow.contains((20, 1))
    columns, rows = shadow.border % 40, shadow.border // 40
    assert set(columns.tolist()) <= {1, 2, 3}
    assert set(rows.tolist()) <= set(range(1, 8))


def test_shadow_that_the_reference_goal_cannot_be_reached_from_is_left_like_any_other() -> None:
    bound = np.zeros((6, 20), np.uint8)
    bound[:, 10] = 254  # the reference's goal is behind it
    closed = bound.copy()
    closed[2:4, 2:4] = 30  # passable, on the near side
    planner, patterns = Planner(20, 6), TilePatterns(10**6)
    reference = planner.goal_field(bound, (15, 3), patterns)
    shadow = Shadow(closed, bound, reference, [(2, 2)], planner)
    detour = shadow.detour(np.maximum(reference.costs(shadow.border), 0))
    assert detour is not None
    found = planner.plan(closed, (2, 2), (7, 3), field=planner.goal_field(bound, (7, 3), patterns), detour=detour)
    assert found.cost == planner.plan(closed, (2, 2), (7, 3)).cost


def test_raised_goal_still_ends_the_shadow() -> None:
    bound = np.zeros((8, 20), np.uint8)
    closed = bound.copy()
    closed[2:6, 12:18] = 30  # passable, around the goal
    planner = Planner(20, 8)
    field = planner.goal_field(bound, (15, 4), TilePatterns(10**6))
    shadow = Shadow(closed, bound, field, [(2, 4)], planner)
    assert not shadow.contains((15, 4))
    assert shadow.border.tolist() == [4 * 20 + 15]
    detour = shadow.detour(field.costs(shadow.border))
    assert detour is not None
    expected = planner.plan(closed, (2, 4), (15, 4)).cost * 2 * STRAIGHT
    assert detour.costs[4, 2] == expected


def test_step_that_a_closed_corner_cuts_off_is_in_the_shadow() -> None:
    bound = np.full((5, 6), 254, np.uint8)
    bound[1, 1:4] = bound[2:4, 3] = bound[3, 3:5] = 0
    bound[2, 2] = 0  # where the cheapest path cuts the corner
    closed = bound.copy()
    closed[2, 2] = 254
    planner = Planner(6, 5)
    shadow = Shadow(closed, bound, planner.goal_field(bound, (4, 3), TilePatterns(10**6)), [(1, 1)], planner)
    assert shadow.contains((1, 1))


def test_detour_saves_the_flood_of_a_closed_room() -> None:
    bound = np.zeros((60, 60), np.uint8)
    closed = bound.copy()
    closed[5:55, 40] = closed[5, 10:40] = closed[54, 10:40] = 254  # a pocket that opens to the left
    planner = Planner(60, 60)
    patterns = TilePatterns(10**6)
    fields = [planner.goal_field(bound, goal, patterns) for goal in ((55, 30), (55, 33))]
    shadow = Shadow(closed, bound, fields[0], [(30, 30), (20, 35)], planner)
    detour = shadow.detour(fields[0].costs(shadow.border))
    assert detour is not None
    flooded = planner.plan(closed, (20, 35), (55, 33), field=fields[1])
    guided = planner.plan(closed, (20, 35), (55, 33), field=fields[1], detour=detour)
    assert guided.cost == flooded.cost
    assert guided.expansions < 0.5 * flooded.expansions


def test_shadow_of_a_coarse_field_is_refused() -> None:
    bound = np.zeros((8, 8), np.uint8)
    planner = Planner(8, 8)
    field = planner.goal_field(bound, (1, 1), TilePatterns(10**6))
    with pytest.raises(ValueError, match="exact"):
        Shadow(bound, bound, field.coarser(), [(6, 6)], planner)


def test_levels_are_compared_as_their_bounds_are_in_sum_however_goals_and_border_lie() -> None:
    rng = np.random.default_rng(7)
    for goals, cells in ((1, 1), (2, 5), (5, 2), (17, 40)):
        costs = rng.integers(0, 2**40, (goals, cells))
        own = int(rng.integers(goals))
        expected = [
            sum(int((row - levels).min()) for row in costs) + goals * int((levels - costs[own]).min())
            for levels in costs
        ]

        assert compare_levels(costs, own).tolist() == expected


@pytest.mark.parametrize(
    ("costs", "own", "error"),
    [
        (np.zeros((2, 3), np.int32), 0, "costs must be int64"),
        (np.zeros((2, 0), np.int64), 0, "costs must have cells"),
        (np.zeros((2, 3), np.int64), 2, "row 2"),
    ],
)
def test_levels_that_cannot_be_compared_are_refused(costs: NDArray[np.integer], own: int, error: str) -> None:
    with pytest.raises((TypeError, ValueError), match=error):
        compare_levels(costs, own)  # type: ignore[arg-type]  # other types are what is tested
