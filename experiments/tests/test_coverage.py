import json
import math
import os
import subprocess
from pathlib import Path

import numpy as np
import programs
import pytest
from PIL import Image

from fog_contracts.cones import SEEN_BESIDE_M, SONAR_HALF_CONE
from fog_contracts.messages import Place, SimObstacle
from fog_contracts.site import Site
from fog_kernels.sonar import classify, default_config
from fog_runtime.configuration.maps import save_map
from fog_runtime.configuration.site import LoadedSite, load_site
from fognav_experiments.coverage import Coverage, coverage
from fognav_sim.floor import Floor
from fognav_sim.sensors import Noise, Robot, Sonars

ROOT = Path(__file__).parents[2]
ESTIG = ROOT / "sites" / "estig"
SILENT_WORLD = Noise(sonar_sigma=0.0, sonar_spike=0.0)
NOWHERE = Robot(x=-1e6, y=-1e6, radius=0.1, height=0.1)


@pytest.fixture(scope="module")
def estig() -> LoadedSite:
    return load_site(ESTIG)


@pytest.fixture(scope="module")
def found(estig: LoadedSite) -> Coverage:
    return coverage(estig.site, estig.map)


def state_with_a_person(estig: LoadedSite, node, x: float, y: float) -> str:
    """What the simulated node says when a person stands at a point."""
    floor = Floor(estig.map.geometry, estig.map.cells)
    ring = [
        (x + SEEN_BESIDE_M * math.cos(a), y + SEEN_BESIDE_M * math.sin(a))
        for a in np.linspace(0.0, math.tau, 16, endpoint=False)
    ]
    floor.place(SimObstacle(id="person", polygon=ring, height=1.7))
    generator = np.random.default_rng(0)
    ranges = [Sonars(floor).measure(NOWHERE, node, sonar, SILENT_WORLD, generator) for sonar in range(len(node.sonars))]
    return classify(ranges, default_config(node))


def test_simulated_node_reports_a_person_on_the_axis_of_a_cone_and_not_one_beside_all_cones(estig, found) -> None:
    node = next(node for node in estig.site.nodes if node.area == "z4")
    sonar = node.sonars[0]
    axis = node.theta + sonar.angle
    for distance in (0.8, sonar.range_limit - 0.1):
        x, y = node.x + distance * math.cos(axis), node.y + distance * math.sin(axis)
        assert state_with_a_person(estig, node, x, y) == "blocked"
    beside = node.theta + sonar.angle - SONAR_HALF_CONE - math.asin(SEEN_BESIDE_M / 1.2) - 0.15
    x, y = node.x + 1.2 * math.cos(beside), node.y + 1.2 * math.sin(beside)
    assert state_with_a_person(estig, node, x, y) == "clear"
    assert 0.2 < next(area for area in found.areas if area.area == "z4").share < 0.6


def test_cone_ends_at_the_limit_of_its_sonar(estig, found) -> None:
    for area in found.areas:
        node = next(node for node in estig.site.nodes if node.area == area.area)
        for sonar, ring in zip(node.sonars, area.cones, strict=True):
            longest = max(math.dist((node.x, node.y), point) for point in ring)
            assert longest == pytest.approx(sonar.range_limit, abs=1e-6)


def test_route_is_blind_everywhere_but_in_front_of_nodes(estig, found) -> None:
    route = next(route for route in found.routes if (route.start, route.goal) == ("a", "b"))
    assert [lead.area for lead in route.leads] == ["z4"]
    node = next(node for node in estig.site.nodes if node.area == "z4")
    crossing = route.travelled[np.argmin(np.hypot(*(route.points - (node.x, node.y)).T))]
    assert not any(begin <= crossing <= end for begin, end in route.blind)
    assert route.length_m - 3.0 < route.blind_m < route.length_m
    assert all(begin <= end for begin, end in route.blind)


def test_lidar_sees_no_farther_than_its_range_and_the_fog_knows_earlier(found) -> None:
    leads = [lead for route in found.routes for lead in route.leads]
    assert leads
    for lead in leads:
        assert 0.0 <= lead.lidar_m <= 12.0 + 0.5
        assert lead.lead_s == pytest.approx((lead.entry_m - lead.lidar_m) / 0.3, abs=15.0)


def test_without_nodes_everything_is_blind(estig) -> None:
    bare = Site(
        id="bare", places={"a": estig.site.places["a"], "b": estig.site.places["b"]}, areas=estig.site.areas, nodes=[]
    )
    found = coverage(bare, estig.map)
    assert {area.share for area in found.areas} == {0.0}
    assert found.routes[0].blind == [(0.0, found.routes[0].length_m)]


def test_places_without_a_way_between_them_are_said(tmp_path: Path, estig) -> None:
    cells = estig.map.cells.copy()
    cells[:, 1000:1010] = 254  # a wall through the whole building
    closed = type(estig.map)(estig.map.geometry, cells)
    site = Site(id="split", places={"a": Place(x=5.0, y=25.4), "b": Place(x=59.0, y=44.0)})
    assert coverage(site, closed).unreachable == [("a", "b")]
    save_map(tmp_path / "map", closed)
    (tmp_path / "site.toml").write_text(
        'id = "split"\n[places.a]\nx = 5.0\ny = 25.4\n[places.b]\nx = 59.0\ny = 44.0\n', "utf-8"
    )
    shown = run("site", "coverage", str(tmp_path))
    assert shown.returncode == 0, shown.stderr
    assert "route a to b: there is no way" in shown.stdout


def run(*command: str) -> subprocess.CompletedProcess[str]:
    return programs.run(command, os.environ, ROOT, 120.0)


def test_command_prints_json_and_draws_a_picture(tmp_path: Path) -> None:
    picture = tmp_path / "coverage.png"
    shown = run("site", "coverage", "estig", "--png", str(picture), "--json")
    assert shown.returncode == 0, shown.stderr
    report = json.loads(shown.stdout)
    assert [area["id"] for area in report["areas"]] == [f"z{n}" for n in range(1, 8)]
    assert {(route["from"], route["to"]) for route in report["routes"]} >= {("a", "b"), ("c", "d")}
    colours = {colour for _, colour in Image.open(picture).convert("RGB").getcolors(1 << 24)}
    assert {(150, 215, 160), (60, 110, 230), (210, 60, 40), (0, 140, 60)} <= colours


def test_unknown_site_and_unwritable_picture_are_wrong_use(tmp_path: Path) -> None:
    assert run("site", "coverage", str(tmp_path / "none")).returncode == 2
    refused = run("site", "coverage", "estig", "--png", str(tmp_path / "none" / "c.png"))
    assert refused.returncode == 2
    assert "c.png" in refused.stderr
