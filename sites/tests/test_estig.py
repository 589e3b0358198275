"""The floor keeps what the experiment needs: two ways everywhere, and a price for meeting a barrier unwarned."""

import importlib.util
import itertools
import math
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np
import pytest
from numpy.typing import NDArray

from fog_contracts.costs import DEFAULT_INFLATION
from fog_contracts.geometry import contains_point, distance_to_polygon, rasterize
from fog_contracts.site import AreaSite, Site
from fog_kernels.astar import Planner
from fog_kernels.inflation import inflate, inflation_table

if TYPE_CHECKING:
    from fog_contracts.grid import GridGeometry

HERE = Path(__file__).parents[1] / "estig"
SIGHT = 12.0
"""Range (m) of the robot's lidar: nearer than this a barrier on the way ahead is certainly seen."""


def _generator() -> ModuleType:
    spec = importlib.util.spec_from_file_location("estig_generate", HERE / "generate.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


generate = _generator()


class Way:
    """Points (m) 5 or 7 cm apart, and their length."""

    def __init__(self, points: NDArray[np.float64]) -> None:
        self.points = points
        steps = np.hypot(*np.diff(points, axis=0).T)
        self.along = np.concatenate(([0.0], np.cumsum(steps)))
        self.length = float(self.along[-1])

    def crosses(self, area: AreaSite) -> bool:
        return any(contains_point(area.polygon, x, y) for x, y in self.points)

    def zones(self, areas: dict[str, AreaSite]) -> set[str]:
        return {name for name, area in areas.items() if self.crosses(area)}


class Floor:
    def __init__(self) -> None:
        self.site: Site = generate.load_site_file(HERE / "site.toml")
        description = generate.load_floor(HERE / "floor.toml")
        self.geometry: GridGeometry = description.geometry
        self.image: NDArray[np.uint8] = generate.draw(description)
        self.areas = {area.id: area for area in self.site.areas}
        raw = np.where(self.image == 254, 0, np.where(self.image == 0, 254, 255)).astype(np.uint8)
        self.raw = raw
        self.table = inflation_table(self.geometry.resolution, DEFAULT_INFLATION)
        self.planner = Planner(self.geometry.width, self.geometry.height)
        self._known: dict[tuple[object, ...], Way | None] = {}

    def way(self, start: tuple[float, float], goal: tuple[float, float], *blocked: str) -> Way | None:
        key = (start, goal, *sorted(blocked))
        if key not in self._known:
            raw = self.raw.copy()
            for name in blocked:
                window, mask = rasterize(self.areas[name].polygon, self.geometry)
                raw[window.rows, window.columns][mask] = 254
            costs = inflate(raw, self.table)
            result = self.planner.plan(costs, self.geometry.cell(*start), self.geometry.cell(*goal))
            points = (result.cells.astype(np.float64) + 0.5) * self.geometry.resolution
            points += (self.geometry.origin_x, self.geometry.origin_y)
            self._known[key] = Way(points) if result.found else None
        return self._known[key]

    def route(self, names: str, *blocked: str) -> Way:
        a, b = (self.site.places[name] for name in names)
        way = self.way((a.x, a.y), (b.x, b.y), *blocked)
        assert way, f"no way {names} with {blocked} blocked"
        return way


@pytest.fixture(scope="module")
def floor() -> Floor:
    return Floor()


ROUTES = {"ab": ("z1", "z4"), "bc": ("z4", "z7"), "cd": ("z5", "z1", "z3")}


def test_the_committed_map_is_what_the_description_gives() -> None:
    for name, data in generate.generate().items():
        assert (HERE / name).read_bytes() == data, f"{name}: run generate.py"


def test_drawing_twice_gives_the_same_bytes() -> None:
    assert generate.generate() == generate.generate()


def test_a_range_limit_that_reaches_the_wall_is_refused(floor: Floor, tmp_path: Path) -> None:
    text = (HERE / "site.toml").read_text("utf-8").replace("range_limit = 2.65", "range_limit = 2.99", 1)
    (tmp_path / "site.toml").write_text(text, "utf-8")
    site = generate.load_site_file(tmp_path / "site.toml")
    with pytest.raises(generate.FloorError, match=r"node n1.*range_limit should be about 2\.6"):
        generate.check_site(site, floor.image, floor.geometry)


def test_it_has_seven_areas_numbered_as_in_the_thesis_each_with_one_node_of_two_sonars(floor: Floor) -> None:
    assert {area.id: area.number for area in floor.site.areas} == {f"z{n}": n for n in range(1, 8)}
    assert sorted(node.area for node in floor.site.nodes) == [f"z{n}" for n in range(1, 8)]
    assert all(len(node.sonars) == 2 for node in floor.site.nodes)
    assert set(floor.site.places) == {"a", "b", "c", "d"}


@pytest.mark.parametrize("names", ROUTES)
def test_the_shortest_way_crosses_one_zone_of_its_route_and_no_other(floor: Floor, names: str) -> None:
    crossed = floor.route(names).zones(floor.areas)
    assert len(crossed) == 1
    assert crossed <= set(ROUTES[names])


@pytest.mark.parametrize("names", ROUTES)
def test_with_its_zone_blocked_the_way_leads_by_another_zone_of_the_route(floor: Floor, names: str) -> None:
    shortest = floor.route(names)
    (zone,) = shortest.zones(floor.areas)
    other = floor.route(names, zone)
    assert other.zones(floor.areas) & set(ROUTES[names]) - {zone}
    assert 5.0 <= other.length - shortest.length <= 30.0


def test_z3_is_the_last_of_the_ways_from_c_to_d(floor: Floor) -> None:
    assert floor.route("cd", "z5", "z1", "z4", "z7").zones(floor.areas) == {"z3"}


@pytest.mark.parametrize("names", ["".join(pair) for pair in itertools.permutations("abcd", 2)])
def test_any_one_blocked_zone_leaves_a_way_between_any_two_places(floor: Floor, names: str) -> None:
    for zone in floor.route(names).zones(floor.areas):
        assert not floor.route(names, zone).crosses(floor.areas[zone])


def test_the_demo_route_takes_minutes_rather_than_an_hour(floor: Floor) -> None:
    demo = floor.site.demo
    assert demo
    assert set(demo.areas) == set(ROUTES["ab"])
    assert 45.0 <= floor.route(demo.start + demo.goal).length <= 75.0


@pytest.mark.parametrize("names", ROUTES)
def test_meeting_the_barrier_unwarned_costs_thirty_to_seventy_metres(floor: Floor, names: str) -> None:
    shortest = floor.route(names)
    (zone,) = shortest.zones(floor.areas)
    centre = tuple(np.mean(floor.areas[zone].polygon, axis=0))
    away = np.hypot(*(shortest.points - centre).T)
    seen = int(np.argmax(away < SIGHT))
    x, y = (float(v) for v in shortest.points[seen])
    end = floor.site.places[names[1]]
    back = floor.way((x, y), (end.x, end.y), zone)
    assert back
    unwarned = float(shortest.along[seen]) + back.length
    assert 30.0 <= unwarned - floor.route(names, zone).length <= 70.0


@pytest.mark.parametrize("names", ROUTES)
def test_the_zone_lies_25_to_45_metres_beyond_the_branching(floor: Floor, names: str) -> None:
    shortest = floor.route(names)
    (zone,) = shortest.zones(floor.areas)
    other = floor.route(names, zone)
    count = min(len(shortest.points), len(other.points))
    apart = np.hypot(*(shortest.points[:count] - other.points[:count]).T) > 2.0
    branching = float(shortest.along[int(np.argmax(apart))])
    inside = [contains_point(floor.areas[zone].polygon, x, y) for x, y in shortest.points]
    assert 23.0 <= float(shortest.along[int(np.argmax(inside))]) - branching <= 45.0


def test_no_place_in_a_corridor_looks_like_another_five_metres_along(floor: Floor) -> None:
    # A scan that fits a wrong place as well as the right one misleads any particle filter: ranges must differ.
    angles = np.linspace(-math.pi, math.pi, 72, endpoint=False)
    spots = [(x, y) for y in (4.2, 15.0, 28.4, 39.4, 50.6) for x in np.arange(12.0, 53.0, 5.0)]
    scans = [
        np.array([generate.ray(floor.image, floor.geometry, x, y, float(a), 12.0) for a in angles]) for x, y in spots
    ]
    for (i, one), (j, two) in itertools.combinations(enumerate(scans), 2):
        for seen in (two, np.roll(two[::-1], 1), np.roll(two, 36)):
            assert float(np.mean(np.abs(one - seen) > 0.3)) > 0.05, f"{spots[i]} looks like {spots[j]}"


def test_every_area_is_a_stretch_of_four_metres_and_its_node_looks_into_it(floor: Floor) -> None:
    for node in floor.site.nodes:
        polygon = floor.areas[node.area].polygon
        (left, bottom), (right, top) = np.min(polygon, axis=0), np.max(polygon, axis=0)
        assert max(right - left, top - bottom) == pytest.approx(4.0)
        assert distance_to_polygon(polygon, node.x + math.cos(node.theta), node.y + math.sin(node.theta)) == 0.0
