"""A*: optimal against a plain Dijkstra and against published lengths, with and without the goal field."""

from __future__ import annotations

import itertools
import math
import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from compiler import compiled_only, examples
from hypothesis import given, settings
from hypothesis import strategies as st
from shortest_paths import Cell, cell_of, costmaps, dijkstra, floors

from fog_contracts.costs import DEFAULT_INFLATION
from fog_contracts.geometry import lengths_along
from fog_kernels.astar import Planner, nearest_traversable
from fog_kernels.guides import LANDMARKS
from fog_kernels.inflation import inflate, inflation_table
from fog_kernels.landmarks import Landmarks
from fog_kernels.lines import cost_from, line_cost, shortcut
from fog_kernels.steps import DIAGONAL, STRAIGHT
from fog_kernels.tiles import TilePatterns

if TYPE_CHECKING:
    from numpy.typing import NDArray

DATA = Path(os.environ.get("FOGNAV_DATA") or Path(__file__).resolve().parents[3].parent / "shared" / "data")


def assert_valid(costmap: NDArray[np.uint8], cells: NDArray[np.int32], start: Cell, goal: Cell, cost: float) -> None:
    """Assert that the cells are a path of allowed steps from start to goal with this cost."""
    assert tuple(cells[0]) == start
    assert tuple(cells[-1]) == goal
    total = 0
    for (x0, y0), (x1, y1) in itertools.pairwise(cells.tolist()):
        assert max(abs(x1 - x0), abs(y1 - y0)) == 1
        assert max(costmap[y0, x0], costmap[y1, x0], costmap[y0, x1], costmap[y1, x1]) < 253
        weights = round(50 + 0.8 * int(costmap[y0, x0])) + round(50 + 0.8 * int(costmap[y1, x1]))
        total += (DIAGONAL if x0 != x1 and y0 != y1 else STRAIGHT) * weights
    assert total / (2 * STRAIGHT) == cost


@settings(max_examples=examples(250), deadline=None)
@given(costmaps(), st.data())
def test_cost_equals_dijkstra_and_the_path_has_that_cost(costmap: NDArray[np.uint8], data: st.DataObject) -> None:
    start, goal = cell_of(data, costmap), cell_of(data, costmap)
    expected = dijkstra(costmap, start).get(goal)
    planner = Planner(costmap.shape[1], costmap.shape[0])
    for _ in range(2):  # the second search finds the scratch memory as the first did
        result = planner.plan(costmap, start, goal)
        assert result.found == (expected is not None)
        assert not result.timed_out
        if expected is None:
            assert result.cost == math.inf
            assert result.cells.shape == (0, 2)
        else:
            assert result.cost == expected / (2 * STRAIGHT)
            assert_valid(costmap, result.cells, start, goal, result.cost)


@settings(max_examples=examples(60), deadline=None)
@given(costmaps(), st.integers(1, 3000), st.floats(0, 20), st.data())
def test_cost_equals_dijkstra_for_any_weights(
    costmap: NDArray[np.uint8], neutral: int, factor: float, data: st.DataObject
) -> None:
    start, goal = cell_of(data, costmap), cell_of(data, costmap)
    expected = dijkstra(costmap, start, neutral, factor).get(goal)
    result = Planner(costmap.shape[1], costmap.shape[0], neutral, factor).plan(costmap, start, goal)
    assert result.cost == (math.inf if expected is None else expected / (2 * STRAIGHT))


@settings(max_examples=examples(200), deadline=None)
@given(costmaps(), st.data())
def test_replanning_with_the_goal_field_equals_a_full_search(static: NDArray[np.uint8], data: st.DataObject) -> None:
    start, goal = cell_of(data, static), cell_of(data, static)
    planner = Planner(static.shape[1], static.shape[0])
    room = data.draw(st.sampled_from([0, 1, 4, 100]))  # tiles whose patterns fit
    field = planner.goal_field(static, goal, TilePatterns(1024 * room), bits=data.draw(st.integers(0, 3)))
    for _ in range(data.draw(st.integers(0, 2))):
        field = field.coarser()
    height, width = static.shape
    for _ in range(3):
        costmap = static.copy()
        x, y = cell_of(data, static)
        patch = costmap[y : y + data.draw(st.integers(1, height)), x : x + data.draw(st.integers(1, width))]
        np.maximum(patch, data.draw(st.sampled_from([0, 30, 200, 253, 254, 255])), out=patch)
        expected = dijkstra(costmap, start).get(goal)
        result = planner.plan(costmap, start, goal, field=field)
        assert result.cost == (math.inf if expected is None else expected / (2 * STRAIGHT))
        if result.found:
            assert_valid(costmap, result.cells, start, goal, result.cost)


@settings(max_examples=examples(200), deadline=None)
@given(costmaps(), st.data())
def test_search_from_the_goal_guided_by_the_field_of_another_cell_equals_a_full_search(
    static: NDArray[np.uint8], data: st.DataObject
) -> None:
    origin, robot, goal = (cell_of(data, static) for _ in range(3))
    planner = Planner(static.shape[1], static.shape[0])
    field = planner.goal_field(static, origin, TilePatterns(1024 * data.draw(st.sampled_from([0, 100]))), bits=1)
    bound = field.toward(robot)
    assert (bound is not None) == (field.exact and robot in dijkstra(static, origin))
    costmap = static.copy()
    x, y = cell_of(data, static)
    patch = costmap[y : y + data.draw(st.integers(1, 22)), x : x + data.draw(st.integers(1, 22))]
    np.maximum(patch, data.draw(st.sampled_from([0, 30, 200, 254])), out=patch)
    if bound is not None:
        expected = dijkstra(costmap, robot).get(goal)
        result = planner.plan(costmap, goal, robot, field=bound)
        assert result.cost == (math.inf if expected is None else expected / (2 * STRAIGHT))


@settings(max_examples=examples(200), deadline=None)
@given(floors(), st.data())
def test_search_guided_by_landmarks_equals_a_full_search(static: NDArray[np.uint8], data: st.DataObject) -> None:
    height, width = static.shape
    planner, landmarks = Planner(width, height), Landmarks(width, height)
    for _ in range(data.draw(st.integers(0, 17))):
        if not landmarks.is_complete:
            landmarks.add(static, planner.goal_field)
    for _ in range(3):  # one search finds the tiles' bounds as another has left them
        start, goal = cell_of(data, static), cell_of(data, static)
        costmap = static.copy()
        x, y = cell_of(data, static)
        patch = costmap[y : y + data.draw(st.integers(1, height)), x : x + data.draw(st.integers(1, width))]
        np.maximum(patch, data.draw(st.sampled_from([0, 30, 200, 254])), out=patch)
        expected = dijkstra(costmap, start).get(goal)
        result = planner.plan(costmap, start, goal, landmarks=landmarks)
        assert result.cost == (math.inf if expected is None else expected / (2 * STRAIGHT))
        if result.found:
            assert_valid(costmap, result.cells, start, goal, result.cost)


def test_landmarks_lead_round_what_lies_on_the_straight_way_and_are_far_from_each_other() -> None:
    costmap = np.zeros((48, 80), np.uint8)
    costmap[:44, 40] = 254
    planner, landmarks = Planner(80, 48), Landmarks(80, 48)
    while not landmarks.is_complete:
        landmarks.add(costmap, planner.goal_field)
    cells = [field.goal for field in landmarks.fields]
    assert len(set(cells)) == len(cells) == min(LANDMARKS, landmarks.lowest.shape[1])
    assert {(x < 40, y < 24) for x, y in cells[:5]} == {(True, True), (False, True), (True, False), (False, False)}
    unguided, guided = (planner.plan(costmap, (35, 2), (45, 2), landmarks=each) for each in (None, landmarks))
    assert guided.cost == unguided.cost
    assert guided.expansions < unguided.expansions / 2
    with pytest.raises(ValueError, match="landmarks"):
        Planner(48, 80).plan(costmap.T.copy(), (0, 0), (3, 3), landmarks=landmarks)


@pytest.mark.parametrize(
    ("side", "neutral", "factor"), [pytest.param(101, 2000, 30.0, marks=compiled_only), (13, 50_000, 198.0)]
)
def test_costs_beyond_32_bits_are_exact(side: int, neutral: int, factor: float) -> None:
    """A serpentine over cells of the highest cost costs more than 2^31."""
    costmap = np.full((side, side), 252, np.uint8)
    costmap[1::4, :-1] = 254
    costmap[3::4, 1:] = 254
    planner = Planner(side, side, neutral, factor)
    start, goal = (0, 0), (side - 1, side - 1)
    weight = neutral + 252 * factor
    result = planner.plan(costmap, start, goal)
    assert result.cost * 2 * STRAIGHT > 2**31
    assert result.cost == weight * (len(result.cells) - 1)
    guided = planner.plan(costmap, start, goal, field=planner.goal_field(costmap, goal, TilePatterns(10**6)))
    assert guided.cost == result.cost
    assert guided.expansions < result.expansions + 1
    fresh = Planner(side, side, neutral, factor)
    assert (
        fresh.plan(costmap, start, goal, field=fresh.goal_field(costmap, goal, TilePatterns(10**6))).cost == result.cost
    )


@pytest.mark.parametrize("side", [pytest.param(101, marks=compiled_only), 17])
def test_plan_beyond_32_bits_after_a_32_bit_goal_field_is_exact(side: int) -> None:
    static = np.zeros((side, side), np.uint8)
    goal = (side - 1, side - 1)
    static[1::4, :-1] = 254
    static[3::4, 1:] = 254
    planner = Planner(side, side, neutral=100, factor=300.0)
    field = planner.goal_field(static, goal, TilePatterns(10**6))
    raised = np.maximum(static, 252)
    result = planner.plan(raised, (0, 0), goal, field=field)
    assert result.cost * 2 * STRAIGHT > 2**31
    fresh = Planner(side, side, neutral=100, factor=300.0)
    assert fresh.plan(raised, (0, 0), goal).cost == result.cost
    cut = raised.copy()
    cut[side // 4 * 2, side // 2] = 254
    assert not planner.plan(cut, (0, 0), goal, field=field).found


def test_field_of_another_goal_or_map_is_refused() -> None:
    costmap = np.zeros((6, 7), np.uint8)
    planner = Planner(7, 6)
    field = planner.goal_field(costmap, (3, 3), TilePatterns(10**6))
    with pytest.raises(ValueError, match="field"):
        planner.plan(costmap, (0, 0), (3, 4), field=field)
    with pytest.raises(ValueError, match="field"):
        Planner(6, 7).plan(costmap.T.copy(), (0, 0), (3, 3), field=field)


@settings(max_examples=examples(150), deadline=None)
@given(costmaps(), st.data())
def test_exit_path_is_a_cheapest_path_to_a_traversable_cell(costmap: NDArray[np.uint8], data: st.DataObject) -> None:
    start = cell_of(data, costmap)
    exits = costmap.copy()
    x, y = start
    reach = data.draw(st.integers(0, 12))
    exits[max(y - reach, 0) : y + reach + 1, max(x - reach, 0) : x + reach + 1] = 254
    costs = dijkstra(costmap, start)
    expected = min((cost for (x, y), cost in costs.items() if exits[y, x] < 253), default=None)
    planner = Planner(costmap.shape[1], costmap.shape[0])
    for _ in range(2):  # the second search finds the scratch memory as the first did
        cells = planner.exit_path(costmap, exits, start)
        assert (cells is None) == (expected is None)
        if cells is not None and expected is not None:
            assert_valid(costmap, cells, start, tuple(cells[-1]), expected / (2 * STRAIGHT))
            assert exits[cells[-1][1], cells[-1][0]] < 253


def test_planner_is_usable_after_a_search_ended_by_the_expansion_limit() -> None:
    costmap = np.zeros((60, 60), np.uint8)
    costmap[:50, 30] = 254
    planner = Planner(60, 60)
    bounded = planner.plan(costmap, (0, 0), (59, 0), max_expansions=50)
    assert bounded.timed_out
    assert not bounded.found
    result = planner.plan(costmap, (0, 0), (59, 0))
    assert result.cost == dijkstra(costmap, (0, 0))[59, 0] / (2 * STRAIGHT)


def test_cells_outside_the_grid_and_wrong_shapes_are_refused() -> None:
    planner = Planner(5, 4)
    costmap = np.zeros((4, 5), np.uint8)
    with pytest.raises(ValueError, match="goal"):
        planner.plan(costmap, (0, 0), (5, 0))
    with pytest.raises(ValueError, match="start"):
        planner.plan(costmap, (-1, 0), (0, 0))
    with pytest.raises(ValueError, match="shape"):
        planner.plan(costmap.T.copy(), (0, 0), (0, 0))
    with pytest.raises(ValueError, match="path"):
        shortcut(costmap, np.array([[0, 0], [3, 3]], np.int32))


def test_nearest_traversable_cell_is_found_within_reach() -> None:
    costmap = np.full((9, 9), 254, np.uint8)
    costmap[2, 7] = 252
    assert nearest_traversable(costmap, (4, 4), 3) is None
    assert nearest_traversable(costmap, (4, 4), 4) == (7, 2)


@settings(max_examples=examples(200), deadline=None)
@given(costmaps(), st.data())
def test_shortcut_crosses_no_obstacle_and_costs_no_more(costmap: NDArray[np.uint8], data: st.DataObject) -> None:
    start, goal = cell_of(data, costmap), cell_of(data, costmap)
    result = Planner(costmap.shape[1], costmap.shape[0]).plan(costmap, start, goal)
    if not result.found:
        return
    corners = shortcut(costmap, result.cells)
    assert tuple(corners[0]) == start
    assert tuple(corners[-1]) == goal
    total = 0.0
    for (x0, y0), (x1, y1) in itertools.pairwise(corners):
        total += line_cost(costmap, x0, y0, x1, y1)
        for part in np.linspace(0.0, 1.0, 200):
            x = int(np.floor(x0 + part * (x1 - x0) + 0.5))
            y = int(np.floor(y0 + part * (y1 - y0) + 0.5))
            assert costmap[y, x] < 253
    assert total <= result.cost + 1e-6 * len(result.cells) + 1e-3


def cost_of(costmap: NDArray[np.uint8], corners: NDArray[np.float64]) -> float:
    return sum(line_cost(costmap, *begin, *end) for begin, end in itertools.pairwise(corners.tolist()))


@settings(max_examples=examples(100), deadline=None)
@given(costmaps(), st.data())
def test_second_path_is_taken_only_where_its_lines_cost_less(costmap: NDArray[np.uint8], data: st.DataObject) -> None:
    start, goal = cell_of(data, costmap), cell_of(data, costmap)
    planner = Planner(costmap.shape[1], costmap.shape[0])
    found = planner.plan(costmap, start, goal)
    if not found.found:
        return
    corners = planner.straightened(costmap, found.cells)
    assert (tuple(corners[0]), tuple(corners[-1])) == (start, goal)
    assert cost_of(costmap, corners) <= cost_of(costmap, planner.shortcut(costmap, found.cells)) + 1e-9


@pytest.mark.parametrize(
    ("boxes", "start", "goal", "share"),
    [
        pytest.param([(49, 36, 32, 14)], (4, 74), (115, 35), 0.95, id="the second way"),
        pytest.param([(107, 119, 23, 22), (78, 79, 13, 38)], (53, 155), (150, 8), 0.985, id="a third, between boxes"),
    ],
)
def test_boxes_are_passed_on_the_side_that_is_nearer_in_straight_lines(
    boxes: list[tuple[int, int, int, int]], start: Cell, goal: Cell, share: float
) -> None:
    costmap = np.zeros((160, 160), np.uint8)
    for x, y, width, height in boxes:
        costmap[y : y + height, x : x + width] = 254
    planner = Planner(160, 160)
    found = planner.plan(costmap, start, goal)
    first = planner.shortcut(costmap, found.cells)
    field = planner.goal_field(costmap, goal, TilePatterns(10_000_000))
    corners = planner.straightened(costmap, found.cells, 20_000, field)
    assert cost_of(costmap, corners) < share * cost_of(costmap, first)
    assert planner.straightened(costmap, found.cells, 1, field).tolist() == first.tolist(), "it may take too long"


def test_path_through_an_open_room_becomes_one_line() -> None:
    costmap = np.zeros((40, 90), np.uint8)
    result = Planner(90, 40).plan(costmap, (2, 3), (85, 30))
    assert shortcut(costmap, result.cells).tolist() == [[2.0, 3.0], [85.0, 30.0]]


@compiled_only
def test_path_round_the_end_of_a_wall_costs_less_than_any_two_lines_and_than_steps_in_8_directions() -> None:
    raw = np.zeros((60, 80), np.uint8)
    raw[:30, 38:42] = 254
    costmap = inflate(raw, inflation_table(0.05, DEFAULT_INFLATION))
    start, goal = (6, 9), (71, 17)
    found = Planner(80, 60).plan(costmap, start, goal)
    corners = shortcut(costmap, found.cells)
    cost = sum(line_cost(costmap, *a, *b) for a, b in itertools.pairwise(corners.tolist()))
    places = itertools.product(np.arange(15.0, 65.0, 0.5), np.arange(20.0, 59.0, 0.5))
    best = min(line_cost(costmap, *start, x, y) + line_cost(costmap, x, y, *goal) for x, y in places)
    assert cost < min(best, 0.975 * found.cost)
    assert len(corners) <= 6


def test_line_cost_is_the_integral_of_the_weight() -> None:
    rng = np.random.default_rng(5)
    costmap = rng.integers(0, 253, (30, 30)).astype(np.uint8)
    for _ in range(20):
        x0, y0, x1, y1 = rng.uniform(0, 29, 4)
        parts = (np.arange(20000) + 0.5) / 20000
        cols = np.floor(x0 + parts * (x1 - x0) + 0.5).astype(int)
        rows = np.floor(y0 + parts * (y1 - y0) + 0.5).astype(int)
        expected = np.rint(50 + 0.8 * costmap[rows, cols]).mean() * math.hypot(x1 - x0, y1 - y0)
        assert line_cost(costmap, x0, y0, x1, y1) == pytest.approx(expected, rel=2e-3)
        assert line_cost(costmap, x1, y1, x0, y0) == pytest.approx(line_cost(costmap, x0, y0, x1, y1), rel=1e-9)


def test_polyline_costs_what_its_lines_cost_and_nothing_crosses_a_wall() -> None:
    rng = np.random.default_rng(6)
    costmap = rng.integers(0, 253, (30, 30)).astype(np.uint8)
    points = rng.uniform(0, 29, (6, 2))
    lines = [line_cost(costmap, *a, *b) for a, b in itertools.pairwise(points.tolist())]

    def cost(line: NDArray[np.float64], begin: float = 0.0) -> float:
        return cost_from(costmap, line, lengths_along(line), begin, (-0.5, -0.5, 1.0))

    assert cost(points) == pytest.approx(sum(lines))
    assert cost(points, begin=lengths_along(points)[2]) == pytest.approx(sum(lines[2:]))
    assert cost(points[:1]) == cost(points, begin=1000.0) == 0.0
    assert cost(np.array([[0.0, 0.0], [3.0, 3.0], [50.0, 3.0]])) == math.inf
    with pytest.raises(ValueError, match="points"):
        cost_from(costmap, np.zeros((2, 3)), np.zeros(2), 0.0, (0.0, 0.0, 1.0))
    with pytest.raises(ValueError, match="no point"):
        cost_from(costmap, np.zeros((0, 2)), np.zeros(0), 0.0, (0.0, 0.0, 1.0))


def test_line_between_two_diagonal_obstacles_is_blocked() -> None:
    costmap = np.zeros((4, 4), np.uint8)
    costmap[1, 2] = costmap[2, 1] = 254
    assert line_cost(costmap, 0, 0, 3, 3) == math.inf
    assert line_cost(costmap, 0, 0, 4, 0) == math.inf


def test_path_follows_the_middle_of_a_corridor() -> None:
    raw = np.zeros((40, 110), np.uint8)
    raw[:3] = raw[-3:] = 254
    costmap = inflate(raw, inflation_table(0.05, DEFAULT_INFLATION))
    result = Planner(110, 40).plan(costmap, (5, 8), (105, 31))
    middle = result.cells[(result.cells[:, 0] > 35) & (result.cells[:, 0] < 75)]
    assert len(middle) > 30
    distance_to_wall = np.minimum(middle[:, 1] - 2, 37 - middle[:, 1])
    assert distance_to_wall.min() >= 11


def read_movingai(path: Path) -> NDArray[np.uint8]:
    lines = path.read_text().splitlines()
    rows = lines[lines.index("map") + 1 :]
    return np.array([[0 if c in ".GS" else 254 for c in row] for row in rows if row], np.uint8)


@compiled_only
@pytest.mark.data
@pytest.mark.parametrize(
    "scenario", sorted((DATA / "movingai").glob("*.scen")) or [None], ids=lambda path: path.stem if path else "none"
)
def test_path_lengths_equal_the_published_ones(scenario: Path | None) -> None:
    if scenario is None:
        pytest.skip("no data")
    lines = scenario.read_text().splitlines()[1:]
    costmap: NDArray[np.uint8] | None = None
    planner: Planner | None = None
    for line in lines[:: max(1, len(lines) // int(os.environ.get("FOGNAV_SCENARIO_ROWS", "40")))]:
        _, name, _, _, start_x, start_y, goal_x, goal_y, length = line.split()
        if costmap is None or planner is None:
            costmap = read_movingai(scenario.parent / Path(name).name)
            planner = Planner(costmap.shape[1], costmap.shape[0])
        result = planner.plan(costmap, (int(start_x), int(start_y)), (int(goal_x), int(goal_y)))
        steps = np.abs(np.diff(result.cells, axis=0)).sum(axis=1)
        reached = float((steps == 1).sum() + (steps == 2).sum() * math.sqrt(2.0))
        assert reached == pytest.approx(float(length), abs=5e-3, rel=1e-6)
