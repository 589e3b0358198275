"""What a node's sonars see, as a polygon: within limits, walls and cones, whatever the node."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from fog_contracts.cones import SONAR_HALF_CONE, ConeError, node_cone, node_cones, sonar_cone
from fog_contracts.geometry import contains_point, normalized_polygon, signed_area
from fog_contracts.grid import GridGeometry, StaticMap
from fog_contracts.site import NodeSite, Sonar

GRID = GridGeometry(160, 160, 0.05, -4.0, -4.0)
OPEN = StaticMap(GRID, np.zeros(GRID.shape, dtype=np.uint8))
LIMITS = st.floats(0.3, 3.9)
SONARS = st.lists(st.builds(Sonar, angle=st.floats(-math.pi, math.pi), range_limit=LIMITS), min_size=1, max_size=8)


def mounted(sonars: list[Sonar], theta: float = 0.0, x: float = 0.0, y: float = 0.0) -> NodeSite:
    return NodeSite(id="n1", area="hall", x=x, y=y, theta=theta, sonars=sonars)


def two(limit: float, angle: float = 0.22) -> list[Sonar]:
    return [Sonar(angle=-angle, range_limit=limit), Sonar(angle=angle, range_limit=limit)]


@settings(deadline=None, max_examples=25)
@given(SONARS, st.floats(-7.0, 7.0), st.floats(0.05, 1.0))
def test_outline_is_simple_and_holds_what_each_sonar_sees_and_nothing_beyond_its_limit(sonars, theta, share):
    node = mounted(sonars, theta)
    outline = node_cone(node, OPEN)
    assert normalized_polygon(outline) == outline
    for sonar in sonars:
        for turned in (-0.9, 0.0, 0.9):
            angle = theta + sonar.angle + turned * SONAR_HALF_CONE
            seen = 0.98 * share * sonar.range_limit
            assert contains_point(outline, seen * math.cos(angle), seen * math.sin(angle))
    farthest = max(sonar.range_limit for sonar in sonars)
    assert all(math.hypot(x, y) <= farthest + 1e-3 for x, y in outline)


@settings(deadline=None, max_examples=25)
@given(SONARS, st.floats(-7.0, 7.0), st.floats(0.0, 2 * math.pi))
def test_outline_is_empty_where_no_sonar_looks(sonars, theta, direction):
    away = [abs(math.remainder(direction - theta - sonar.angle, math.tau)) for sonar in sonars]
    assume(min(away) > 4 * SONAR_HALF_CONE)
    outline = node_cone(mounted(sonars, theta), OPEN)
    assert not contains_point(outline, 0.2 * math.cos(direction), 0.2 * math.sin(direction))


def test_neighbouring_cones_are_one_and_distant_ones_are_not():
    ahead = (1.5, 0.0)
    assert contains_point(node_cone(mounted(two(2.0)), OPEN), *ahead)
    assert not contains_point(node_cone(mounted(two(2.0, angle=0.6)), OPEN), *ahead)


def test_area_of_two_separate_cones_is_the_sum_of_their_sectors():
    outline = node_cone(mounted(two(2.0, angle=0.8)), OPEN)
    sectors = 2 * 0.5 * 2.0**2 * (2 * SONAR_HALF_CONE)
    assert signed_area(outline) == pytest.approx(sectors, rel=0.03)


def test_outline_ends_before_the_first_wall_and_at_the_border_of_the_map():
    walled = StaticMap(GRID, OPEN.cells.copy())
    walled.cells[:, 100:102] = 254  # x from 1.0 to 1.1
    outline = node_cone(mounted(two(3.0)), walled)
    assert 0.95 < max(x for x, _ in outline) <= 1.0
    assert max(x for x, _ in sonar_cone(mounted(two(3.0)), 0, walled)) <= 1.0
    assert max(x for x, _ in node_cone(mounted(two(3.0), x=3.0), OPEN)) <= 4.0


@pytest.mark.parametrize("angle", [1.8, 2.5])
def test_sonar_that_looks_at_a_pillar_leaves_what_the_others_see(angle):
    walled = StaticMap(GRID, OPEN.cells.copy())
    walled.cells[79:82, 80:82] = 254
    sonars = [Sonar(angle=turned, range_limit=2.0) for turned in (-angle, 0.0, angle)]
    outline = node_cone(mounted(sonars, x=-0.003), walled)
    assert normalized_polygon(outline) == outline
    for turned in (-angle, angle):
        towards = turned + math.copysign(0.1, turned)
        assert contains_point(outline, math.cos(towards), math.sin(towards))
    assert not contains_point(outline, 0.1, 0.0)


def test_node_in_a_wall_or_before_one_is_refused_with_its_place_and_a_remedy():
    walled = StaticMap(GRID, OPEN.cells.copy())
    walled.cells[:, 80:] = 254
    for x in (0.02, -0.002):
        with pytest.raises(ConeError, match=r"node n1 at .* sees nothing: .*[Mm]ove or turn it"):
            node_cone(mounted(two(3.0), x=x), walled)
    assert node_cones([mounted(two(3.0), x=0.02)], walled) == {}
    assert list(node_cones([mounted(two(3.0), theta=math.pi, x=-0.02)], walled)) == ["n1"]
