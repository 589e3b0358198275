"""Barriers really bar, nodes see them, and events come true when they are due and the robot is far enough."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fog_contracts.costs import Inflation
from fog_contracts.geometry import contains_point, rasterize
from fog_contracts.grid import GridGeometry
from fog_contracts.messages import Pose
from fog_contracts.site import AreaSite, NodeSite, RobotSite, Site, Sonar
from fog_kernels.astar import Planner
from fog_kernels.inflation import inflate, inflation_table
from fog_runtime.maps import StaticMap
from fognav_sim.scenario import Event, Scenario, ScenarioError, barrier_across, person_at
from fognav_sim.world import World

RES = 0.05


def corridor(width, *, door=0.0):
    """A corridor along x, 12 m long, between walls 0.2 m thick, with a recess of `door` m in its upper wall."""
    geometry = GridGeometry(240, 120, RES, 0.0, 0.0)
    cells = np.full(geometry.shape, 254, np.uint8)
    bottom, top = round(1.0 / RES), round((1.0 + width) / RES)
    cells[bottom:top, 4:236] = 0
    if door:
        cells[top : top + round(door / RES), 108:130] = 0
    return StaticMap(geometry, cells)


def site(width, node_at=6.0):
    area = AreaSite(id="z1", polygon=[(4.0, 1.0), (8.0, 1.0), (8.0, 1.0 + width), (4.0, 1.0 + width)])
    sonars = [Sonar(angle=angle, range_limit=width - 0.35) for angle in (-0.22, 0.22)]
    node = NodeSite(id="n1", area="z1", x=node_at, y=1.05, theta=math.pi / 2, sonars=sonars)
    start = Pose(x=1.0, y=1.0 + width / 2, theta=0.0)
    return Site(id="s", areas=[area], nodes=[node] if node_at else [], robots=[RobotSite(id="r1", start=start)])


def can_pass(static, obstacle):
    cells = static.cells.copy()
    window, mask = rasterize([(x, y) for x, y in obstacle.polygon], static.geometry)
    cells[window.rows, window.columns][mask] = 254
    # A little less than the robot: a wider gap must not pass unseen.
    table = inflation_table(RES, Inflation(inscribed_radius=0.16, inflation_radius=0.2))
    cost = inflate((cells == 254).astype(np.uint8) * 254, table)
    y = static.geometry.cell(1.0, 2.0)[1]
    return Planner(static.geometry.width, static.geometry.height).plan(cost, (20, y), (220, y)).found


@settings(max_examples=30, deadline=None)
@given(width=st.sampled_from([1.6, 2.0, 2.4, 3.2]), door=st.sampled_from([0.0, 0.1, 0.25]), seed=st.integers(0, 10_000),
       watched=st.booleans())  # fmt: skip
def test_a_barrier_bars_the_corridor_enters_no_wall_and_stands_in_its_area(width, door, seed, watched):
    static, where = corridor(width, door=door), site(width, 6.0 if watched else 0.0)
    barrier = barrier_across(where.areas[0], where, static, seed)
    assert not can_pass(static, barrier)
    xs, ys = zip(*barrier.polygon, strict=True)
    assert all(4.0 <= x <= 8.0 for x in xs)
    assert min(ys) >= 1.0
    assert all(static.cells[static.geometry.cell(x, y)[::-1]] == 0 for x, y in barrier.polygon)


def test_the_areas_node_sees_a_barrier_that_would_swallow_sound_at_its_flanks():
    static, where = corridor(2.4), site(2.4)
    world = World(static.geometry, static.cells, where.robots[0], seed=1)
    free = [world.sonar(where.nodes[0], index) for index in (0, 1)]
    world.place(barrier_across(where.areas[0], where, static, seed=5))
    barred = [world.sonar(where.nodes[0], index) for index in (0, 1)]
    limits = [sonar.range_limit for sonar in where.nodes[0].sonars]
    assert all(r > limit for r, limit in zip(free, limits, strict=True))
    assert any(r is not None and r < limit for r, limit in zip(barred, limits, strict=True))


def test_the_same_seed_places_the_same_barrier():
    static, where = corridor(2.4), site(2.4)
    first, again, other = (barrier_across(where.areas[0], where, static, seed) for seed in (1, 1, 2))
    assert first == again
    assert first != other


def test_where_no_barrier_fits_the_error_names_the_area():
    static, where = corridor(2.4, door=1.5), site(2.4)
    with pytest.raises(ScenarioError, match="area z1: no barrier fits"):
        barrier_across(where.areas[0], where, static, seed=1)


def test_a_person_is_as_wide_and_tall_as_one():
    person = person_at(3.0, 2.0)
    xs, _ = zip(*person.polygon, strict=True)
    assert 0.4 < max(xs) - min(xs) < 0.5
    assert contains_point(person.polygon, 3.0, 2.0)
    assert person.height > 1.5


def drive(scenario, world, seconds):
    happened = []
    for step in range(round(seconds / 0.01)):
        world.step(0.01)
        happened += scenario.step(world, 100.0 + step * 0.01)
    return happened


def a_world():
    static, where = corridor(2.4), site(2.4)
    world = World(static.geometry, static.cells, where.robots[0], seed=1)
    world.set_wheels(0.3, 0.3)
    return world


def test_an_event_comes_true_after_its_way_and_its_time_and_only_once():
    world = a_world()
    by_way = Event(name="by way", place=(person_at(10.0, 2.0),), at_distance=0.6)
    by_time = Event(name="by time", remove=("person",), at_time=4.0)
    scenario = Scenario([by_way, by_time], start=100.0)
    happened = drive(scenario, world, 6.0)
    assert [event.name for event in happened] == ["by way", "by time"]
    assert happened[0].distance == pytest.approx(0.6, abs=0.01)
    assert happened[1].time == pytest.approx(4.0, abs=0.011)
    assert world.obstacles == []
    assert scenario.waiting == []


def test_nothing_appears_beside_the_robot_and_a_word_is_waited_for():
    world = a_world()
    near = Event(name="near", place=(person_at(3.0, 2.2),))
    told = Event(name="told", place=(person_at(11.0, 2.2, name="late"),), on_word="now")
    scenario = Scenario([near, told], start=100.0)
    assert drive(scenario, world, 1.0) == []
    scenario.say("now")
    assert [event.name for event in drive(scenario, world, 0.1)] == ["told"]
    assert [event.name for event in scenario.waiting] == ["near"]
