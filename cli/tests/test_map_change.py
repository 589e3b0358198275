"""`fognav map change`: what does not fit a site's new map is named and refused, and each change has a way back."""

import json
import math
import re
from pathlib import Path

import msgspec
import numpy as np
import pytest
from typer.testing import CliRunner

from fog_contracts.grid import GridGeometry, StaticMap
from fog_contracts.messages import CircleShape, Place, Pose, Zone
from fog_contracts.resampling import resampled
from fog_contracts.site import AreaSite, MarkerSite, NodeSite, RobotSite, Site, Sonar
from fog_kernels.sonar import heard_on_map
from fog_mapping.another_map import agreement, findings
from fog_runtime.configuration.maps import load_map, save_map
from fog_runtime.configuration.site import load_site
from fognav.__main__ import app
from fognav.nodes.placing import heard
from fognav.site_files import check_site, to_toml
from fognav_sim.floor import Floor

GEOMETRY = GridGeometry(240, 160, 0.05, 0.0, 0.0)


def office(*walls: tuple[float, float, float, float]) -> StaticMap:
    """12 m x 8 m: a room in the west, a corridor to the east with a niche; and walls: left, bottom, right, top."""
    cells = np.full(GEOMETRY.shape, 254, np.uint8)
    for left, bottom, right, top in ((0.5, 0.5, 4.0, 7.5), (4.0, 2.0, 11.5, 4.0), (9.0, 4.0, 10.5, 5.5)):
        cells[round(bottom * 20) : round(top * 20), round(left * 20) : round(right * 20)] = 0
    for left, bottom, right, top in walls:
        cells[round(bottom * 20) : round(top * 20), round(left * 20) : round(right * 20)] = 254
    return StaticMap(GEOMETRY, cells)


SITE = Site(
    id="office",
    places={"a": Place(x=2.0, y=2.0), "b": Place(x=11.0, y=3.0), "niche": Place(x=9.8, y=4.9)},
    areas=[AreaSite(id="z1", polygon=[(6.0, 2.0), (7.5, 2.0), (7.5, 4.0), (6.0, 4.0)])],
    nodes=[
        NodeSite(
            id="n1", area="z1", x=6.75, y=2.07, theta=math.pi / 2,
            sonars=[Sonar(angle=angle, range_limit=1.6, range_max=2.3) for angle in (-0.2, 0.2)],
        )
    ],
    markers=[MarkerSite(id=7, x=5.1, y=2.0, theta=math.pi / 2)],
    robots=[
        RobotSite(id="r1", start=Pose(x=2.0, y=6.0, theta=0.0), dock=Pose(x=0.8, y=6.0, theta=math.pi), radius=0.17)
    ],
)  # fmt: skip


@pytest.mark.parametrize(
    ("wall", "named"),
    [
        ((10.9, 2.9, 11.1, 3.1), {"place b lies in a wall"}),
        ((11.1, 2.0, 11.5, 4.0), {"place b is 0.10 m from a wall"}),
        ((9.0, 4.0, 10.5, 4.1), {"place niche can't be reached any more from the start of r1"}),
        ((1.9, 5.9, 2.1, 6.1), {"start of robot r1 lies in a wall"}),
        ((0.5, 5.8, 0.9, 6.2), {"dock of robot r1 lies in a wall"}),
        ((6.7, 2.0, 6.8, 2.1), {"node n1 lies in a wall"}),
        ((6.0, 3.0, 7.5, 3.2), {"node n1 would report blocked with nothing there"}),
        (
            (2.9, 4.4, 3.4, 4.9),
            {"zone wet lies in a wall", "robot r7 lies in a wall", "goal of robot r7 lies in a wall"},
        ),
        ((5.0, 2.1, 5.2, 2.4), {"marker 7 looks into a wall"}),
        ((2.3, 4.5, 2.7, 4.9), {"operators' place sofa lies in a wall"}),
        ((0.6, 0.6, 0.8, 0.8), set()),
    ],
)
def test_each_thing_that_does_not_fit_the_new_map_is_named(wall, named):
    zones = [Zone(id="wet", kind="BLOCKED", shape=CircleShape(centre=(3.15, 4.65), radius=0.1))]
    robot = {"r7": (3.2, 4.6)}
    found = findings(SITE, office(), office(wall), zones, robot, {"sofa": Place(x=2.5, y=4.7)}, robot)
    told = [re.sub(r" at \(.*?\)", "", str(one)) for one in found]
    assert len(told) == len(named), told
    assert all(any(one.startswith(name) for one in told) for name in named), told


def test_node_hears_of_a_map_what_its_simulated_sonars_do():
    loaded = load_site(Path(__file__).parents[2] / "sites" / "estig")
    floor = Floor(loaded.map.geometry, loaded.map.cells)
    for node in loaded.site.nodes:
        assert heard_on_map(loaded.map, node) == pytest.approx(heard(floor, node))


def test_walls_of_one_floor_agree_and_those_of_another_do_not():
    other = StaticMap(GEOMETRY, np.ascontiguousarray(office().cells[:, ::-1]))
    assert agreement(office(), office((0.6, 0.6, 0.8, 0.8))) > 0.95
    assert agreement(office(), other) < 0.6


def run(*words: object) -> tuple[int, dict]:
    done = CliRunner().invoke(app, ["map", "change", *map(str, words), "--json"])
    assert done.stdout, done.output
    return done.exit_code, json.loads(done.stdout)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "site").mkdir()
    save_map(tmp_path / "site" / "map", office())
    (tmp_path / "site" / "site.toml").write_text(to_toml(SITE))
    assert check_site(tmp_path / "site")["ok"]
    return tmp_path


def files(folder: Path) -> dict[str, bytes]:
    return {file.name: file.read_bytes() for file in folder.iterdir()}


@pytest.mark.parametrize("option", ["--preview", "--accept", "--as-it-is"])
def test_place_in_a_wall_is_refused_whatever_is_said_and_nothing_is_changed(folder, option):
    save_map(folder / "new", office((10.9, 2.9, 11.1, 3.1)))
    before = files(folder / "site")
    code, told = run(folder / "new.yaml", "--site", folder / "site", option)
    assert (code, told["changed"]) == (1, False)
    assert [(one["kind"], one["id"], one["refused"]) for one in told["findings"]] == [("place", "b", True)]
    assert files(folder / "site") == before


def test_accepted_change_keeps_the_map_before_and_back_restores_it(folder):
    site, words = folder / "site", (folder / "new.yaml", "--site", folder / "site")
    save_map(folder / "new", office((6.0, 3.0, 7.5, 3.2)), {"command": "fognav map from-log a.mcap"})
    before = (site / "site.toml").read_text()
    assert run(*words)[0] == 1
    assert run(*words, "--preview", "--accept")[1]["changed"] is False
    code, told = run(*words, "--accept")
    assert (code, told["changed"], told["map"], told["previous"]) == (0, True, "map-2.yaml", "map.yaml")
    assert told["floor_to_wall_m2"] == pytest.approx(0.3)
    assert (site / "site.toml").read_text() == before.replace('map = "map.yaml"', 'map = "map-2.yaml"')
    assert (load_site(site).map.cells == load_map(folder / "new.yaml").cells).all()
    code, told = run("--back", "--site", site)
    assert (code, told["map"], told["wall_to_floor_m2"]) == (0, "map.yaml", pytest.approx(0.3))
    assert (site / "site.toml").read_text() == before
    assert (load_site(site).map.cells == office().cells).all()
    done = CliRunner().invoke(app, ["map", "change", "--back", "--site", str(site)])
    assert (done.exit_code, "does not say which map was before it" in done.output) == (2, True)


def test_new_recording_with_another_frame_is_laid_onto_the_present_map(folder):
    wall = (9.0, 5.0, 9.4, 5.5)
    turned = resampled(office(wall), 0.4, (-20.0, 7.0))
    save_map(folder / "new", turned)
    code, told = run(folder / "new.yaml", "--site", folder / "site")
    assert (code, told["findings"]) == (0, [])
    assert told["alignment"]["share"] > 0.9
    site = load_site(folder / "site")
    here = site.map.geometry.sample(site.map.cells, np.array([[2.0, 2.0], [9.2, 5.25], [9.9, 4.7], [7.0, 5.0]]), 255)
    assert here.tolist() == [0, 254, 0, 254]


def test_map_of_another_building_is_refused(folder):
    other = office().cells[:, ::-1].copy()
    other[20:150, 100:140] = 0
    save_map(folder / "new", StaticMap(msgspec.structs.replace(GEOMETRY, origin_x=3.0), other))
    done = CliRunner().invoke(app, ["map", "change", str(folder / "new.yaml"), "--site", str(folder / "site")])
    assert (done.exit_code, "can't be laid onto" in done.output) == (1, True)
