"""The robot's own costmap is what its layers are, whatever order they changed in."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fog_contracts.costs import DEFAULT_INFLATION, LETHAL
from fog_contracts.grid import GridGeometry
from fog_contracts.replica import MasterMap, Replica
from fog_contracts.shapes import polygon_spans
from fog_kernels.inflation import inflate, inflation_table
from fog_kernels.raycast import cast
from fognav_experiments.onboard.costmap import OnboardCostmap
from robot_agent.localization.pose import Pose2

GEOMETRY = GridGeometry(120, 100, 0.05, 0.0, 0.0)
TABLE = inflation_table(0.05, DEFAULT_INFLATION)
PLACES = {
    "box": polygon_spans([(1.0, 1.0), (2.0, 1.0), (2.0, 2.0), (1.0, 2.0)], GEOMETRY),
    "strip": polygon_spans([(0.5, 3.0), (5.5, 3.0), (5.5, 3.2), (0.5, 3.2)], GEOMETRY),
}


def floor():
    """A room of 6 x 5 m with a pillar."""
    static = np.zeros(GEOMETRY.shape, np.uint8)
    static[[0, -1], :] = static[:, [0, -1]] = LETHAL
    static[40:50, 70:80] = LETHAL
    replica = Replica()
    replica.load(MasterMap("lab", GEOMETRY, static, static, epoch=3).snapshot())
    return replica


def scan(solid, pose):
    """What a lidar without noise sees from a pose: points, and which of them the floor plan does not explain."""
    angles = np.linspace(-math.pi, math.pi, 720, endpoint=False)
    ranges = cast(solid, 0.05, 0.0, 0.0, pose.x, pose.y, angles, 12.0)
    # The cell that was hit lies just behind the place where the beam ends.
    points = np.column_stack((pose.x + (ranges + 0.01) * np.cos(angles), pose.y + (ranges + 0.01) * np.sin(angles)))
    points = points[np.isfinite(ranges)]
    return points, GEOMETRY.sample(floor().static, points, LETHAL) != LETHAL


def with_obstacle(*boxes):
    solid = floor().static.copy()
    for left, bottom, right, top in boxes:
        solid[round(bottom / 0.05) : round(top / 0.05), round(left / 0.05) : round(right / 0.05)] = LETHAL
    return solid


STEPS = st.lists(
    st.one_of(
        st.sets(st.sampled_from(sorted(PLACES))).map(lambda names: ("close", names)),
        st.tuples(
            st.just("observe"),
            st.tuples(st.floats(0.5, 5.5), st.floats(0.5, 4.5)),
            st.sampled_from([(), ((2.5, 1.0, 2.8, 1.4),), ((4.4, 3.4, 4.9, 4.0), (1.2, 3.9, 1.5, 4.2))]),
        ),
    ),
    max_size=8,
)


@settings(max_examples=40, deadline=None)
@given(STEPS)
def test_costs_are_those_of_a_costmap_inflated_from_scratch(steps):
    costmap = OnboardCostmap(floor(), 0.17)
    for step in steps:
        before, cost = costmap.replica.version, costmap.replica.cost.copy()
        if step[0] == "close":
            costmap.close({name: PLACES[name] for name in step[1]})
        else:
            pose = Pose2(*step[1], 0.0)
            costmap.observe(pose, *scan(with_obstacle(*step[2]), pose))
        raw = floor().static.copy()
        for spans in costmap._closed.values():
            window, mask = spans.to_mask()
            raw[window.rows, window.columns][mask] = LETHAL
        marked = costmap._marks.cells
        raw[marked[:, 1], marked[:, 0]] = LETHAL
        expected = inflate(raw, TABLE)
        # What is marked may be anywhere in its cell, up to half a diagonal from the centre.
        rows, columns = np.mgrid[: GEOMETRY.height, : GEOMETRY.width]
        for column, row in marked:
            expected[(np.hypot(columns - column, rows - row) * 0.05 <= 0.17 + 0.0354) & (expected < 253)] = 253
        assert np.array_equal(costmap.replica.cost, expected)
        assert (costmap.replica.version != before) >= (not np.array_equal(cost, costmap.replica.cost))


def test_an_obstacle_is_marked_when_it_is_seen_and_freed_when_it_is_seen_to_be_gone():
    costmap, pose = OnboardCostmap(floor(), 0.17), Pose2(1.0, 1.2, 0.0)
    middle = GEOMETRY.cell(2.6, 1.2)[::-1]
    costmap.observe(pose, *scan(with_obstacle((2.5, 1.0, 2.8, 1.4)), pose))
    assert costmap.replica.cost[middle] >= 253
    # From behind the pillar nothing tells that it is gone.
    hidden = Pose2(4.5, 2.25, 0.0)
    costmap.observe(hidden, *scan(with_obstacle((3.0, 0.5, 3.2, 4.5)), hidden))
    assert costmap.replica.cost[middle] >= 253
    costmap.observe(pose, *scan(floor().static, pose))
    assert costmap.replica.cost[middle] == 0


def edge_of_a_box(costmap):
    """Return how many cells beside the box of the tests below are closed, upwards from its upper edge at 2.9 m."""
    column = costmap.replica.cost[:, GEOMETRY.cell(2.6, 1.0)[0]]
    return int((column[58:90] >= 253).sum())


def turned(points, pose, angle):
    """Return points (n, 2) as a robot at this pose takes them to be whose heading is wrong by an angle."""
    cos, sin = math.cos(angle), math.sin(angle)
    return (points - pose[:2]) @ np.array(((cos, sin), (-sin, cos))) + pose[:2]


def test_an_obstacle_s_edge_stays_where_it_was_seen_while_the_robot_sees_the_obstacle_from_farther_away():
    box = with_obstacle((2.5, 1.0, 2.8, 2.9))
    costmap, near = OnboardCostmap(floor(), 0.17), Pose2(1.6, 2.5, 0.0)
    for error in (0.0, 0.06):
        points, unexplained = scan(box, near)
        costmap.observe(near, turned(points, near, error), unexplained)
    closed = edge_of_a_box(costmap)
    for x in (1.4, 1.2, 1.0, 0.8):
        for error in (-0.05, 0.0, 0.05):
            pose = Pose2(x, 2.5, 0.0)
            points, unexplained = scan(box, pose)
            costmap.observe(pose, turned(points, pose, error), unexplained)
            assert edge_of_a_box(costmap) >= closed


def test_an_obstacle_s_edge_is_corrected_by_what_the_robot_sees_from_clearly_nearer():
    box = with_obstacle((2.5, 1.0, 2.8, 2.9))
    costmap, far = OnboardCostmap(floor(), 0.17), Pose2(0.6, 2.7, 0.0)
    points, unexplained = scan(box, far)
    costmap.observe(far, turned(points, far, 0.08), unexplained)
    smeared = edge_of_a_box(costmap)
    near = Pose2(1.6, 2.7, 0.0)
    costmap.observe(near, *scan(box, near))
    assert edge_of_a_box(costmap) < smeared


def test_an_obstacle_that_is_gone_as_a_whole_is_freed_from_farther_away_too():
    costmap, near = OnboardCostmap(floor(), 0.17), Pose2(1.6, 2.0, 0.0)
    costmap.observe(near, *scan(with_obstacle((2.5, 1.8, 2.8, 2.2), (2.4, 4.0, 2.8, 4.4)), near))
    assert costmap.replica.cost[GEOMETRY.cell(2.52, 2.0)[::-1]] == LETHAL
    far = Pose2(0.5, 2.0, 0.0)
    costmap.observe(far, *scan(with_obstacle((2.4, 4.0, 2.8, 4.4)), far))
    assert costmap.replica.cost[GEOMETRY.cell(2.52, 2.0)[::-1]] == 0
    assert costmap.replica.cost[GEOMETRY.cell(2.42, 4.1)[::-1]] >= 253


@pytest.mark.parametrize(("cells", "open_"), [(3, False), (4, False), (5, True)])
def test_a_gap_between_two_obstacles_on_a_coarse_grid_is_open_only_if_the_body_fits_wherever_in_their_cells_they_are(
    cells, open_
):
    geometry = GridGeometry(40, 40, 0.1, 0.0, 0.0)
    replica = Replica()
    empty = np.zeros(geometry.shape, np.uint8)
    replica.load(MasterMap("hall", geometry, empty, empty, epoch=3).snapshot())
    costmap = OnboardCostmap(replica, 0.17)
    rows = [*range(10), *range(10 + cells, 40)]
    points = np.array([(2.05, 0.1 * row + 0.05) for row in rows])
    costmap.observe(Pose2(0.5, 1.0, 0.0), points, np.ones(len(points), np.bool_))
    assert bool((costmap.replica.cost[:, 20] < 253).any()) == open_


def test_a_place_that_the_robot_could_not_pass_is_closed_as_long_as_it_is_reported_and_until_it_is_seen_to_be_free():
    costmap, pose = OnboardCostmap(floor(), 0.17), Pose2(1.0, 1.2, 0.0)
    bar = np.column_stack((np.full(5, 2.6), np.linspace(1.0, 1.4, 5)))
    middle = GEOMETRY.cell(2.6, 1.2)[::-1]
    for _ in range(3):
        costmap.observe(pose, *scan(floor().static, pose), bar)
        assert costmap.replica.cost[middle] == LETHAL
    hidden = Pose2(4.5, 2.25, 0.0)
    costmap.observe(hidden, *scan(with_obstacle((3.0, 0.5, 3.2, 4.5)), hidden))
    assert costmap.replica.cost[middle] == LETHAL
    costmap.observe(pose, *scan(floor().static, pose))
    assert costmap.replica.cost[middle] == 0


BOX = (1.8, 1.0, 2.1, 1.4)
OTHER_BOX = (3.0, 4.4, 3.4, 4.7)
IN_BOX = (1.9, 1.2)


def seen_from_far(*boxes):
    """Return a costmap on which boxes are marked that were seen from more than 3 m, and from where."""
    costmap, far = OnboardCostmap(floor(), 0.17), Pose2(5.7, 0.4, math.pi)
    costmap.observe(far, *scan(with_obstacle(*boxes), far))
    return costmap, far


def boxes_marked(costmap):
    cost = costmap.replica.cost
    return [name for name, box in (("box", BOX), ("other", OTHER_BOX)) if closed_inside(cost, box)]


def closed_inside(cost, box):
    left, bottom, right, top = (round(edge / 0.05) for edge in box)
    return bool((cost[bottom:top, left:right] == LETHAL).any())


def test_what_was_seen_only_from_far_away_is_forgotten_when_it_is_doubted_and_marked_again_from_near_only():
    costmap, far = seen_from_far(BOX)
    assert boxes_marked(costmap) == ["box"]
    version = costmap.replica.version
    assert costmap.doubt()
    assert boxes_marked(costmap) == []
    assert costmap.replica.version != version
    assert not costmap.doubt()
    costmap.observe(far, *scan(with_obstacle(BOX), far))
    assert boxes_marked(costmap) == []
    near = Pose2(4.0, 1.2, math.pi)
    costmap.observe(near, *scan(with_obstacle(BOX), near))
    assert boxes_marked(costmap) == ["box"]
    assert not costmap.doubt()
    assert boxes_marked(costmap) == ["box"]


def test_what_was_seen_from_near_once_is_not_doubted_from_far_away():
    costmap, near = OnboardCostmap(floor(), 0.17), Pose2(4.0, 1.2, math.pi)
    costmap.observe(near, *scan(with_obstacle(BOX), near))
    far = Pose2(5.7, 0.4, math.pi)
    costmap.observe(far, *scan(with_obstacle(BOX), far))
    cost = costmap.replica.cost.copy()
    costmap.doubt()
    assert boxes_marked(costmap) == ["box"]
    assert (costmap.replica.cost <= cost).all()


def test_only_what_is_near_a_place_is_doubted_there_and_marked_as_before_elsewhere():
    costmap, far = seen_from_far(BOX, OTHER_BOX)
    assert boxes_marked(costmap) == ["box", "other"]
    assert costmap.doubt(around=IN_BOX)
    assert boxes_marked(costmap) == ["other"]
    assert not costmap.doubt(around=IN_BOX)
    for boxes in ((), (BOX, OTHER_BOX)):
        costmap.observe(far, *scan(with_obstacle(*boxes), far))
    assert boxes_marked(costmap) == ["other"]
    assert costmap.doubt()
    costmap.observe(far, *scan(with_obstacle(BOX, OTHER_BOX), far))
    assert boxes_marked(costmap) == []


def test_a_doubt_without_a_cause_changes_nothing():
    costmap, far = seen_from_far()
    version = costmap.replica.version
    assert not costmap.doubt()
    assert costmap.replica.version == version
    costmap.observe(far, *scan(with_obstacle(BOX), far))
    assert boxes_marked(costmap) == ["box"]


def test_what_is_seen_from_far_away_is_marked_again_once_it_is_believed():
    costmap, far = seen_from_far(BOX)
    assert costmap.doubt()
    costmap.believe()
    costmap.observe(far, *scan(with_obstacle(BOX), far))
    assert boxes_marked(costmap) == ["box"]


def test_the_fog_s_own_copy_of_the_map_is_left_alone():
    fog = floor()
    costmap, pose = OnboardCostmap(fog, 0.17), Pose2(1.0, 1.2, 0.0)
    costmap.close(PLACES)
    costmap.observe(pose, *scan(with_obstacle((2.5, 1.0, 2.8, 1.4)), pose))
    assert np.array_equal(fog.static, floor().static)
    assert np.array_equal(fog.cost, floor().cost)
