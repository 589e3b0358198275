"""A site as files: proposed on any map, checked, and written as text that is read as the same site."""

import math
import shutil
import tomllib
from itertools import combinations
from pathlib import Path

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from fog_contracts.costs import DEFAULT_INFLATION, FREE, LETHAL
from fog_contracts.grid import GridGeometry, StaticMap
from fog_contracts.messages import Place, SimObstacle
from fog_contracts.shapes import rasterize
from fog_contracts.site import AreaSite, Site
from fog_kernels.astar import Planner
from fog_kernels.inflation import inflate, inflation_table
from fog_kernels.raycast import cast
from fog_kernels.sonar import classify, default_config
from fog_runtime.configuration.maps import load_map, save_map
from fog_runtime.configuration.site import load_site
from fognav.output import WrongUseError
from fognav.site_files import check_site, identifier, new_site, seen_shares, to_toml
from fognav.site_proposal import NoSiteError, propose
from fognav_sim.barrier import barrier_across
from fognav_sim.drive.hazard import draw_hazard
from fognav_sim.floor import Floor
from fognav_sim.sensors import Noise, Robot, Sonars

SQUARE = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0)]


@pytest.mark.parametrize("text", ["Hall", 'the "blue" door', "C:\\new", "two\nlines\tand\x00\x7f", "Büro 🏢"])
@pytest.mark.parametrize("number", [None, 0, 4])
def test_name_labels_and_number_of_a_written_site_are_read_as_they_were(text, number):
    area = AreaSite(id="z1", label=text, polygon=SQUARE, number=number)
    site = Site(id="office", name=text, map="map.yaml", places={"a": Place(x=1.0, y=2.0, label=text)}, areas=[area])
    assert msgspec.convert(tomllib.loads(to_toml(site)), Site) == site


RESOLUTION = 0.05


def ring_of_corridors(width: float = 2.0) -> tuple[GridGeometry, NDArray[np.uint8]]:
    """24 m x 16 m of corridors around two blocks: every path has an alternative."""
    geometry = GridGeometry(480, 320, RESOLUTION, -3.0, 4.0)
    cells = np.full(geometry.shape, 254, dtype=np.uint8)
    wide = round(width / RESOLUTION)
    cells[4:-4, 4:-4] = 0
    cells[4 + wide : -4 - wide, 4 + wide : 240 - wide // 2] = 254
    cells[4 + wide : -4 - wide, 240 + wide // 2 : -4 - wide] = 254
    return geometry, cells


@pytest.mark.parametrize("seed", range(4))
def test_proposed_site_has_a_path_and_a_detour_around_each_area(seed: int) -> None:
    geometry, cells = ring_of_corridors()
    site = propose("ring", "map.yaml", geometry, cells, seed).site
    assert site.demo is not None
    assert site.demo.areas
    planner = Planner(geometry.width, geometry.height)
    table = inflation_table(RESOLUTION, DEFAULT_INFLATION)
    start, goal = site.robots[0].start, site.places["b"]
    ends = geometry.cell(start.x, start.y), geometry.cell(goal.x, goal.y)
    free = planner.plan(inflate(cells, table), *ends)
    path = [geometry.centre(int(c), int(r)) for c, r in free.cells]
    for area in site.areas:
        raw = cells.copy()
        window, mask = rasterize(area.polygon, geometry)
        raw[window.rows, window.columns][mask] = 254
        assert planner.plan(inflate(raw, table), *ends).found, f"{area.id} leaves no path"

    def make_barrier(area: AreaSite) -> SimObstacle:
        return barrier_across(area, site, StaticMap(geometry, cells), seed)

    assert draw_hazard(site, path, seed, make_barrier).area.id in site.demo.areas


@pytest.mark.parametrize("seed", range(4))
def test_nodes_see_their_areas_from_a_wall_and_their_limits_end_before_the_opposite_one(seed: int) -> None:
    geometry, cells = ring_of_corridors()
    site = propose("ring", "map.yaml", geometry, cells, seed).site
    walls = (cells == 254).astype(np.uint8)
    for node in site.nodes:
        column, row = geometry.cell(node.x, node.y)
        assert cells[row, column] == 0
        behind = cast(
            walls, RESOLUTION, geometry.origin_x, geometry.origin_y, node.x, node.y, [node.theta + math.pi], 1.0
        )
        assert behind[0] < 0.15
        for sonar in node.sonars:
            cone = node.theta + sonar.angle + np.linspace(-0.13, 0.13, 9)
            echoes = cast(walls, RESOLUTION, geometry.origin_x, geometry.origin_y, node.x, node.y, cone, 9.0)
            assert sonar.range_limit < echoes.min()
    assert min(seen_shares(site, StaticMap(geometry, cells)).values()) > 0.8


def random_floor(seed: int) -> tuple[GridGeometry, NDArray[np.uint8]]:
    """A building of 24 m x 18 m as a robot might map it: corridors, shut rooms, furniture, and what it never saw."""
    dice = np.random.default_rng(seed)
    resolution = float(dice.choice([0.05, 0.1]))
    geometry = GridGeometry(
        round(24 / resolution), round(18 / resolution), resolution, *dice.uniform(-9, 9, 2).tolist()
    )
    cells = np.full(geometry.shape, dice.choice([254, 255]), dtype=np.uint8)

    def fill(x: float, y: float, width: float, height: float, value: int) -> None:
        left, bottom, right, top = (round(side / resolution) for side in (x, y, x + width, y + height))
        cells[max(bottom, 2) : min(top, geometry.height - 2), max(left, 2) : min(right, geometry.width - 2)] = value

    for y in (1.0, dice.uniform(5, 9), dice.uniform(12, 15)):
        fill(1.0, y, 22.0, dice.uniform(1.2, 2.6), 0)
    for x in (1.0, dice.uniform(8, 14), 20.0):
        fill(x, 1.0, dice.uniform(1.2, 2.6), 15.0, 0)
    for value in (0, 0, 0, 254, 254, 254, 255):
        fill(*dice.uniform(1, [22, 16]).tolist(), *dice.uniform(0.2, 1.5 + 1.5 * (value == 0), 2).tolist(), value)
    return geometry, cells


@pytest.mark.parametrize("seed", range(12))
def test_nothing_proposed_on_a_random_floor_lies_in_a_wall(tmp_path: Path, seed: int) -> None:
    geometry, cells = random_floor(seed)
    save_map(tmp_path / "floor", StaticMap(geometry, cells))
    new_site(tmp_path / "floor.yaml", tmp_path / "site", seed, whole_floor=True)
    assert check_site(tmp_path / "site")["ok"] is True
    site, floor = load_site(tmp_path / "site").site, Floor(geometry, np.where(cells == 0, cells, np.uint8(254)))
    assert len(site.places) >= 3
    for place in (*site.places.values(), *(robot.start for robot in site.robots)):
        assert floor.nearest(place.x, place.y)[0] > 0.4
    for node in site.nodes:
        column, row = geometry.cell(node.x, node.y)
        assert cells[row, column] == 0
    for area in site.areas:
        window, mask = rasterize(area.polygon, geometry)
        assert (cells[window.rows, window.columns][mask] == 0).mean() > 0.8
    assert set(states(site, cells, geometry)) <= {"clear"}


def test_places_and_nodes_are_proposed_all_over_the_floor() -> None:
    geometry, cells = ring_of_corridors()
    little = propose("ring", "map.yaml", geometry, cells).site
    site = propose("ring", "map.yaml", geometry, cells, whole_floor=True).site
    assert len(site.places) > len(little.places) == 2
    assert len(site.nodes) > len(little.nodes)
    assert site.demo == little.demo
    left, bottom, right, top = geometry.bounds
    quarters = {(place.x > (left + right) / 2, place.y > (bottom + top) / 2) for place in site.places.values()}
    assert len(quarters) == 4
    assert len({area.number for area in site.areas}) == len(site.areas) == len(site.nodes)


@pytest.mark.drive
def test_map_without_a_second_path_gets_a_demo_without_areas() -> None:
    geometry = GridGeometry(600, 48, RESOLUTION, 0.0, 0.0)
    cells = np.full(geometry.shape, 254, dtype=np.uint8)
    cells[4:-4, 4:-4] = 0
    site, why = propose("corridor", "map.yaml", geometry, cells)
    assert site.demo is not None
    assert site.demo.areas == []
    assert "have no other way to the goal" in why
    assert "Write areas and nodes of your own" in why


def test_areas_are_found_on_a_floor_most_of_which_is_closed_rooms() -> None:
    """Nearly all pairs of ends have no path between them: paths are counted, not pairs."""
    small, ring = ring_of_corridors()
    geometry = GridGeometry(960, 960, RESOLUTION, 0.0, 0.0)
    cells = np.zeros(geometry.shape, dtype=np.uint8)
    cells[::60, :] = cells[:, ::60] = 254
    cells[: small.height, : small.width] = ring
    cells[small.height, : small.width + 1] = cells[: small.height + 1, small.width] = 254
    for seed in range(4):
        assert propose("ring", "map.yaml", geometry, cells, seed).site.areas, f"seed {seed}"


def test_map_without_free_floor_is_refused() -> None:
    geometry = GridGeometry(100, 100, RESOLUTION, 0.0, 0.0)
    with pytest.raises(NoSiteError, match="no path of 4 m"):
        propose("dark", "map.yaml", geometry, np.full(geometry.shape, 255, dtype=np.uint8))


def test_written_site_is_valid_and_equals_the_proposal(tmp_path: Path) -> None:
    geometry, cells = ring_of_corridors()
    save_map(tmp_path / "maps" / "floor", StaticMap(geometry, cells))
    made = new_site(tmp_path / "maps" / "floor.yaml", tmp_path / "sites" / "My Floor (2)", seed=1)
    shutil.rmtree(tmp_path / "maps")  # a site is complete without the files that it was made from
    loaded = load_site(tmp_path / "sites" / "My Floor (2)")
    assert loaded.site.id == made["site"] == "my-floor-2"
    assert loaded.site.map == "map.yaml"
    assert loaded.map.geometry == geometry
    assert (loaded.map.cells == cells).all()
    proposed = propose("my-floor-2", loaded.site.map, geometry, loaded.map.cells, seed=1).site
    assert loaded.site.areas == proposed.areas
    assert loaded.site.nodes == proposed.nodes
    assert check_site(tmp_path / "sites" / "My Floor (2)")["ok"] is True


def test_map_that_is_in_the_site_s_folder_already_is_used_as_it_is(tmp_path: Path) -> None:
    geometry, cells = ring_of_corridors()
    save_map(tmp_path / "floor", StaticMap(geometry, cells))
    before = (tmp_path / "floor.yaml").stat().st_mtime_ns
    new_site(tmp_path / "floor.yaml", tmp_path, seed=1)
    assert load_site(tmp_path).site.map == "floor.yaml"
    assert (tmp_path / "floor.yaml").stat().st_mtime_ns == before
    assert not (tmp_path / "map.yaml").exists()


def test_another_map_in_the_site_s_folder_is_not_overwritten(tmp_path: Path) -> None:
    geometry, cells = ring_of_corridors()
    save_map(tmp_path / "floor", StaticMap(geometry, cells))
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "map.yaml").write_text("# mine\n")
    with pytest.raises(WrongUseError, match=r"map\.yaml already exists"):
        new_site(tmp_path / "floor.yaml", tmp_path / "site", seed=1)
    assert (tmp_path / "site" / "map.yaml").read_text() == "# mine\n"


def states(site: Site, cells: NDArray[np.uint8], geometry: GridGeometry) -> list[str]:
    """What each node reports on the floor, over a hundred noisy measurements."""
    floor, generator = Floor(geometry, cells), np.random.default_rng(3)
    robot, noise = Robot(x=-1e3, y=-1e3, radius=0.17, height=0.1), Noise(sonar_spike=0.0)
    return [
        classify(
            [Sonars(floor).measure(robot, node, index, noise, generator) for index in range(len(node.sonars))],
            default_config(node),
        )
        for node in site.nodes
        for _ in range(100)
    ]


@pytest.mark.parametrize("seed", range(4))
def test_every_proposed_node_reports_clear_on_the_empty_floor(seed: int) -> None:
    geometry, cells = ring_of_corridors()
    # One block's sides are known as not free only, as in a recorded map: nothing echoes there.
    cells[44:-44, 44:220][cells[44:-44, 44:220] == 254] = 255
    site = propose("ring", "map.yaml", geometry, cells, seed).site
    assert set(states(site, cells, geometry)) <= {"clear"}


def test_no_node_is_proposed_where_no_wall_echoes() -> None:
    geometry, cells = ring_of_corridors()
    cells[cells == 254] = 255
    assert propose("ring", "map.yaml", geometry, cells, 1).site.nodes == []


@pytest.mark.data
@pytest.mark.parametrize("name", ["ipa/Freiburg52_scan.yaml", "ipa/NLB.yaml", "ipa/lab_intel.yaml", "utexas/2.yaml"])
@pytest.mark.drive
def test_every_node_proposed_on_a_recorded_floor_reports_clear(maps_dir: Path, name: str) -> None:
    static = load_map(maps_dir / name)
    site = propose("floor", "map.yaml", static.geometry, static.cells, 1).site
    assert set(states(site, static.cells, static.geometry)) <= {"clear"}


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "areas", "reason"),
    [("mit/stata_basement.yaml", 2, ""), ("ipa/Freiburg52_scan.yaml", 0, "are not as wide all along")],
)
def test_a_floor_without_areas_is_told_with_the_reason(maps_dir: Path, name: str, areas: int, reason: str) -> None:
    static = load_map(maps_dir / name)
    site, why = propose("floor", "map.yaml", static.geometry, static.cells, 1)
    assert len(site.areas) == areas
    assert reason in why
    assert bool(why) is not bool(areas)


def test_existing_site_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "site.toml").write_text("# mine\n")
    with pytest.raises(WrongUseError, match="already exists"):
        new_site(tmp_path / "map.yaml", tmp_path, seed=1)
    assert (tmp_path / "site.toml").read_text() == "# mine\n"


def test_unreadable_map_is_named_in_the_error(tmp_path: Path) -> None:
    with pytest.raises(WrongUseError, match=r"nowhere\.yaml"):
        new_site(tmp_path / "nowhere.yaml", tmp_path / "site", seed=1)
    assert not (tmp_path / "site").exists()


def test_problem_of_an_invalid_site_names_its_field(tmp_path: Path) -> None:
    (tmp_path / "site.toml").write_text('id = "x"\n[[areas]]\nid = "z1"\npolygon = [[0, 0], [1, 0]]\n')
    found = check_site(tmp_path)
    assert found["ok"] is False
    assert "areas" in str(found["problem"])


@pytest.mark.parametrize(
    ("name", "expected"), [("Level 2", "level-2"), ("__", "site"), ("Ä" + "x" * 50, "x" * 32), ("a--b", "a-b")]
)
def test_any_folder_name_gives_a_valid_id(name: str, expected: str) -> None:
    assert identifier(name) == expected


def test_a_flat_without_a_way_of_15_m_gets_a_site_with_nearer_places() -> None:
    cells = np.full((100, 140), LETHAL, np.uint8)
    cells[10:90, 10:130] = FREE
    cells[45:55, 10:90] = LETHAL
    made, _ = propose("flat", "map.yaml", GridGeometry(140, 100, 0.05, 0.0, 0.0), cells, whole_floor=True)
    spots = [(place.x, place.y) for place in made.places.values()]
    assert len(spots) >= 3
    assert min(math.dist(a, b) for a, b in combinations(spots, 2)) >= 1.5
