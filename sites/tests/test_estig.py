"""The floor has what the experiment needs: two routes between all places, and a detour for an unwarned robot."""

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
from fog_contracts.geometry import contains_point, distance_to_polygon
from fog_contracts.shapes import rasterize
from fog_contracts.site import AreaSite, Site
from fog_kernels.astar import Planner
from fog_kernels.inflation import inflate, inflation_table

if TYPE_CHECKING:
    from fog_contracts.grid import GridGeometry

HERE = Path(__file__).parents[1] / "estig"
LIDAR_RANGE_M = 12.0
"""Range of the robot's lidar: it certainly sees a barrier ahead that is nearer than this."""


def _generator() -> ModuleType:
    spec = importlib.util.spec_from_file_location("estig_generate", HERE / "generate.py")
    assert spec
    assert spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


generate = _generator()


class PlannedPath:
    """A path's points (m), 5 or 7 cm apart, with their distances from its start."""

    def __init__(self, points: NDArray[np.float64]) -> None:
        self.points = points
        steps = np.hypot(*np.diff(points, axis=0).T)
        self.distances = np.concatenate(([0.0], np.cumsum(steps)))
        self.length = float(self.distances[-1])

    def crosses(self, area: AreaSite) -> bool:
        return any(contains_point(area.polygon, x, y) for x, y in self.points)

    def crossed_areas(self, areas: dict[str, AreaSite]) -> set[str]:
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
        self._paths: dict[tuple[object, ...], PlannedPath | None] = {}

    def plan_path(self, start: tuple[float, float], goal: tuple[float, float], *blocked: str) -> PlannedPath | None:
        key = (start, goal, *sorted(blocked))
        if key not in self._paths:
            raw = self.raw.copy()
            for name in blocked:
                window, mask = rasterize(self.areas[name].polygon, self.geometry)
                raw[window.rows, window.columns][mask] = 254
            costs = inflate(raw, self.table)
            result = self.planner.plan(costs, self.geometry.cell(*start), self.geometry.cell(*goal))
            points = (result.cells.astype(np.float64) + 0.5) * self.geometry.resolution
            points += (self.geometry.origin_x, self.geometry.origin_y)
            self._paths[key] = PlannedPath(points) if result.found else None
        return self._paths[key]

    def route(self, names: str, *blocked: str) -> PlannedPath:
        a, b = (self.site.places[name] for name in names)
        path = self.plan_path((a.x, a.y), (b.x, b.y), *blocked)
        assert path, f"no path {names} with {blocked} blocked"
        return path


@pytest.fixture(scope="module")
def floor() -> Floor:
    return Floor()


ROUTES = {"ab": ("z1", "z4"), "bc": ("z4", "z7"), "cd": ("z5", "z1", "z3")}


def test_committed_map_matches_its_description() -> None:
    for name, data in generate.generate().items():
        assert (HERE / name).read_bytes() == data, f"{name}: run generate.py"


def test_generated_files_are_repeatable() -> None:
    assert generate.generate() == generate.generate()


def test_range_limit_that_reaches_the_wall_is_refused(floor: Floor, tmp_path: Path) -> None:
    text = (HERE / "site.toml").read_text("utf-8").replace("range_limit = 2.65", "range_limit = 2.99", 1)
    (tmp_path / "site.toml").write_text(text, "utf-8")
    site = generate.load_site_file(tmp_path / "site.toml")
    with pytest.raises(generate.FloorError, match=r"node n1.*range_limit should be about 2\.6"):
        generate.check_site(site, floor.image, floor.geometry)


def test_site_has_the_seven_areas_of_the_thesis_each_with_one_node_of_two_sonars(floor: Floor) -> None:
    assert {area.id: area.number for area in floor.site.areas} == {f"z{n}": n for n in range(1, 8)}
    assert sorted(node.area for node in floor.site.nodes) == [f"z{n}" for n in range(1, 8)]
    assert all(len(node.sonars) == 2 for node in floor.site.nodes)
    assert set(floor.site.places) == {"a", "b", "c", "d"}


@pytest.mark.parametrize("names", ROUTES)
def test_shortest_path_crosses_one_area_of_its_route_and_no_other(floor: Floor, names: str) -> None:
    crossed = floor.route(names).crossed_areas(floor.areas)
    assert len(crossed) == 1
    assert crossed <= set(ROUTES[names])


@pytest.mark.parametrize("names", ROUTES)
def test_path_around_a_blocked_area_crosses_another_area_of_its_route(floor: Floor, names: str) -> None:
    shortest = floor.route(names)
    (area,) = shortest.crossed_areas(floor.areas)
    other = floor.route(names, area)
    assert other.crossed_areas(floor.areas) & set(ROUTES[names]) - {area}
    assert 5.0 <= other.length - shortest.length <= 30.0


def test_with_all_other_areas_blocked_the_path_from_c_to_d_crosses_z3(floor: Floor) -> None:
    assert floor.route("cd", "z5", "z1", "z4", "z7").crossed_areas(floor.areas) == {"z3"}


@pytest.mark.parametrize("names", ["".join(pair) for pair in itertools.permutations("abcd", 2)])
def test_one_blocked_area_leaves_a_path_between_any_two_places(floor: Floor, names: str) -> None:
    for area in floor.route(names).crossed_areas(floor.areas):
        assert not floor.route(names, area).crosses(floor.areas[area])


def test_demo_route_is_45_to_75_metres_long(floor: Floor) -> None:
    demo = floor.site.demo
    assert demo
    assert set(demo.areas) == set(ROUTES["ab"])
    assert 45.0 <= floor.route(demo.start + demo.goal).length <= 75.0


@pytest.mark.parametrize("names", ROUTES)
def test_detour_without_a_warning_is_30_to_70_metres_longer(floor: Floor, names: str) -> None:
    shortest = floor.route(names)
    (area,) = shortest.crossed_areas(floor.areas)
    centre = tuple(np.mean(floor.areas[area].polygon, axis=0))
    distances = np.hypot(*(shortest.points - centre).T)
    seen = int(np.argmax(distances < LIDAR_RANGE_M))
    x, y = (float(v) for v in shortest.points[seen])
    end = floor.site.places[names[1]]
    back = floor.plan_path((x, y), (end.x, end.y), area)
    assert back
    unwarned = float(shortest.distances[seen]) + back.length
    assert 30.0 <= unwarned - floor.route(names, area).length <= 70.0


@pytest.mark.parametrize("names", ROUTES)
def test_area_lies_23_to_45_metres_beyond_the_branching(floor: Floor, names: str) -> None:
    shortest = floor.route(names)
    (area,) = shortest.crossed_areas(floor.areas)
    other = floor.route(names, area)
    count = min(len(shortest.points), len(other.points))
    apart = np.hypot(*(shortest.points[:count] - other.points[:count]).T) > 2.0
    branching = float(shortest.distances[int(np.argmax(apart))])
    inside = [contains_point(floor.areas[area].polygon, x, y) for x, y in shortest.points]
    assert 23.0 <= float(shortest.distances[int(np.argmax(inside))]) - branching <= 45.0


def test_scans_at_different_places_of_the_corridors_differ(floor: Floor) -> None:
    # A scan that fits a wrong place as well as the right one misleads any particle filter.
    angles = np.linspace(-math.pi, math.pi, 72, endpoint=False)
    spots = [(x, y) for y in (4.2, 15.0, 28.4, 39.4, 50.6) for x in np.arange(12.0, 53.0, 5.0)]
    scans = [
        np.array([generate.ray(floor.image, floor.geometry, x, y, float(a), 12.0) for a in angles]) for x, y in spots
    ]
    for (i, one), (j, two) in itertools.combinations(enumerate(scans), 2):
        for seen in (two, np.roll(two[::-1], 1), np.roll(two, 36)):
            assert float(np.mean(np.abs(one - seen) > 0.3)) > 0.05, f"{spots[i]} looks like {spots[j]}"


def test_every_area_is_four_metres_long_and_its_node_faces_it(floor: Floor) -> None:
    for node in floor.site.nodes:
        polygon = floor.areas[node.area].polygon
        (left, bottom), (right, top) = np.min(polygon, axis=0), np.max(polygon, axis=0)
        assert max(right - left, top - bottom) == pytest.approx(4.0)
        assert distance_to_polygon(polygon, node.x + math.cos(node.theta), node.y + math.sin(node.theta)) == 0.0
