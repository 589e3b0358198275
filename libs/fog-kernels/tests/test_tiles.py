"""Fields in tiles: the cost of every cell, whatever fields they share patterns with, and within the given memory."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from compiler import examples
from hypothesis import given, settings
from hypothesis import strategies as st
from shortest_paths import Cell, cell_of, costmaps, dijkstra

from fog_kernels.astar import Planner
from fog_kernels.tiles import TilePatterns

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_kernels.guides import GoalField


def grid(field: GoalField) -> NDArray[np.int64]:
    """Return the field's cost of every cell (h, w)."""
    return field.costs(np.arange(field.width * field.height)).reshape(field.height, field.width)


def true_costs(costmap: NDArray[np.uint8], goal: Cell) -> NDArray[np.int64]:
    """Return the cost of every cell by the definition; -1 without a path."""
    costs = np.full(costmap.shape, -1, np.int64)
    for (x, y), cost in dijkstra(costmap, goal).items():
        costs[y, x] = cost
    return costs


@settings(max_examples=examples(100), deadline=None)
@given(costmaps(), st.integers(0, 12), st.data())
def test_fields_that_fit_are_exact_and_others_are_lower_bounds(
    costmap: NDArray[np.uint8], room: int, data: st.DataObject
) -> None:
    planner, patterns = Planner(costmap.shape[1], costmap.shape[0]), TilePatterns(1024 * room)
    known: list[tuple[GoalField, NDArray[np.int64]]] = []
    for _ in range(4):
        goal = cell_of(data, costmap)
        field = planner.goal_field(costmap, goal, patterns, bits=data.draw(st.integers(0, 3)))
        known.append((field, true_costs(costmap, goal)))
        assert patterns.size <= 1024 * room
        if data.draw(st.booleans()):
            patterns, kept = patterns.compacted([field for field, _ in known])
            known = [(field, costs) for field, (_, costs) in zip(kept, known, strict=True)]
    for field, costs in known:
        if field.exact:
            np.testing.assert_array_equal(grid(field), costs)
        coarse = grid(field.coarser())
        reached = costs >= 0
        assert np.all(grid(field)[reached] <= costs[reached])
        assert np.all(coarse[reached] <= grid(field)[reached])
        assert np.all(coarse[reached] >= 0)


def test_goals_outside_a_room_share_its_patterns() -> None:
    costmap = np.zeros((96, 160), np.uint8)
    costmap[::32], costmap[:, ::32] = 254, 254
    costmap[42, 32:160:32] = 0  # one row of rooms, connected by doors
    planner, patterns = Planner(160, 96), TilePatterns(10**6)
    fields = [planner.goal_field(costmap, goal, patterns) for goal in ((140, 40), (140, 48), (145, 52), (140, 60))]
    assert all(field.exact for field in fields)
    slots = np.stack([field.slots[2:4, :8] for field in fields])  # the rooms that have no goal
    assert np.all(slots == slots[0])
    assert len(np.unique(slots)) > 1


def test_compacting_forgets_the_patterns_of_fields_that_ended() -> None:
    rng = np.random.default_rng(3)
    costmap = rng.integers(0, 253, (64, 64)).astype(np.uint8)
    planner, patterns = Planner(64, 64), TilePatterns(40 * 1024)
    first, second = (planner.goal_field(costmap, goal, patterns) for goal in ((3, 3), (60, 60)))
    assert first.exact
    assert second.exact
    assert patterns.crowded
    assert not patterns.worth_compacting([first, second])
    third = planner.goal_field(costmap, (3, 60), patterns, bits=2)
    assert not third.exact
    assert patterns.worth_compacting([second, third])
    before = patterns.size
    patterns, (kept, coarse) = patterns.compacted([second, third])
    assert patterns.size < before
    assert coarse is third
    np.testing.assert_array_equal(grid(kept), grid(second))
    assert planner.goal_field(costmap, (3, 60), patterns).exact
    np.testing.assert_array_equal(grid(first), true_costs(costmap, (3, 3)))  # whoever still has it may use it


def test_pattern_of_costs_beyond_32_bits_is_a_lower_bound() -> None:
    costs = np.full(16 * 16, np.iinfo(np.int64).max, np.int64)
    costs[:3] = 0, 2**32, 2**40
    field = TilePatterns(10**4).field(costs, (0, 0), 16, 16, 0)
    assert not field.exact
    found = field.costs(np.arange(4))
    assert found[0] == 0
    assert 0 < found[1] <= 2**32
    assert 0 < found[2] <= 2**40
    assert found[3] == -1
