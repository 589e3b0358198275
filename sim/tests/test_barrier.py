"""Barriers close corridors, and nodes see them."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fog_contracts.costs import Inflation
from fog_contracts.grid import GridGeometry, StaticMap
from fog_contracts.messages import Pose
from fog_contracts.shapes import rasterize
from fog_contracts.site import AreaSite, NodeSite, RobotSite, Site, Sonar
from fog_kernels.astar import Planner
from fog_kernels.inflation import inflate, inflation_table
from fognav_sim.barrier import BarrierError, barrier_across
from fognav_sim.floor import Floor
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
    return Site(
        id="s", areas=[area], nodes=[node] if node_at else [], robots=[RobotSite(id="r1", start=start, radius=0.17)]
    )


def can_pass(static, obstacle):
    cells = static.cells.copy()
    window, mask = rasterize([(x, y) for x, y in obstacle.polygon], static.geometry)
    cells[window.rows, window.columns][mask] = 254
    # A little narrower than the robot, so that a gap of just its width is found.
    table = inflation_table(RES, Inflation(inscribed_radius=0.16, inflation_radius=0.2))
    cost = inflate((cells == 254).astype(np.uint8) * 254, table)
    y = static.geometry.cell(1.0, 2.0)[1]
    return Planner(static.geometry.width, static.geometry.height).plan(cost, (20, y), (220, y)).found


@settings(max_examples=30, deadline=None)
@given(width=st.sampled_from([1.6, 2.0, 2.4, 3.2]), door=st.sampled_from([0.0, 0.1, 0.25]), seed=st.integers(0, 10_000),
       watched=st.booleans())  # fmt: skip
def test_barrier_closes_the_corridor_inside_its_area_without_entering_a_wall(width, door, seed, watched):
    static, floor = corridor(width, door=door), site(width, 6.0 if watched else 0.0)
    barrier = barrier_across(floor.areas[0], floor, static, seed)
    assert not can_pass(static, barrier)
    xs, ys = zip(*barrier.polygon, strict=True)
    assert all(4.0 <= x <= 8.0 for x in xs)
    assert min(ys) >= 1.0
    assert all(static.cells[static.geometry.cell(x, y)[::-1]] == 0 for x, y in barrier.polygon)


def test_node_of_the_area_gets_an_echo_from_the_barrier():
    static, floor = corridor(2.4), site(2.4)
    world = World(Floor(static.geometry, static.cells), floor.robots[0], seed=1, axle_m=0.3)
    free = [world.sonar(floor.nodes[0], index) for index in (0, 1)]
    world.place(barrier_across(floor.areas[0], floor, static, seed=5))
    blocked = [world.sonar(floor.nodes[0], index) for index in (0, 1)]
    limits = [sonar.range_limit for sonar in floor.nodes[0].sonars]
    assert all(r > limit for r, limit in zip(free, limits, strict=True))
    assert any(r is not None and r < limit for r, limit in zip(blocked, limits, strict=True))


def test_same_seed_places_the_same_barrier():
    static, floor = corridor(2.4), site(2.4)
    first, again, other = (barrier_across(floor.areas[0], floor, static, seed) for seed in (1, 1, 2))
    assert first == again
    assert first != other


def test_barrier_is_found_by_every_seed_where_few_drawn_places_fit():
    """Between deep recesses the wall is 0.5 m wide: the barrier must be thin, and stand nearly before the node."""
    static, floor = corridor(2.4, door=0.6), site(2.4)
    columns = np.arange(108, 130)
    static.cells[68:80, columns[np.abs((columns + 0.5) * RES - 6.0) < 0.25]] = 254
    for seed in range(40):
        assert not can_pass(static, barrier_across(floor.areas[0], floor, static, seed))


def test_area_without_room_for_a_barrier_is_named_in_the_error():
    static, floor = corridor(2.4, door=1.5), site(2.4)
    with pytest.raises(BarrierError, match="area z1: no barrier fits"):
        barrier_across(floor.areas[0], floor, static, seed=1)
