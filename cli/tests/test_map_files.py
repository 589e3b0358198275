"""`fognav map check, info, convert` on files as map_server and others write them."""

import json

import numpy as np
import pytest
import yaml
from PIL import Image
from typer.testing import CliRunner

from fog_contracts.costs import FREE, LETHAL, UNKNOWN
from fog_contracts.grid import GridGeometry, StaticMap
from fog_runtime.configuration.maps import load_map, load_occupancy, read_map_text, read_provenance, save_map
from fognav.__main__ import app


def run(*arguments: object):
    return CliRunner().invoke(app, ["map", *map(str, arguments)])


def room() -> StaticMap:
    cells = np.full((80, 100), UNKNOWN, np.uint8)
    cells[8:72, 8:92] = LETHAL
    cells[10:70, 10:90] = FREE
    return StaticMap(GridGeometry(100, 80, 0.05, -1.0, 2.0), cells)


@pytest.fixture
def floor(tmp_path):
    save_map(tmp_path / "floor", room(), {"command": "fognav map from-log drive.mcap", "version": "1"})
    return tmp_path / "floor.yaml"


def test_map_in_order_passes_and_is_described_with_where_it_came_from(floor):
    checked = run("check", floor)
    assert (checked.exit_code, checked.stdout) == (0, "nothing found\n")
    info = json.loads(run("info", floor, "--json").stdout)
    keys = ("width", "height", "resolution", "origin", "free", "occupied", "unknown")
    assert [info[key] for key in keys] == [100, 80, 0.05, [-1.0, 2.0, 0.0], 4800, 576, 2624]
    assert info["provenance"]["command"] == "fognav map from-log drive.mcap"


def test_yaw_of_a_map_is_told_beside_the_cells_that_are_turned_by_it(floor):
    floor.write_text(floor.read_text().replace("2.0, 0.0]", "2.0, 1.0]"))
    info = json.loads(run("info", floor, "--json").stdout)
    assert (info["yaw"], info["width"] > 100) == (1.0, True)
    assert "1 rad in the file" in run("info", floor).stdout


@pytest.mark.parametrize(
    ("change", "kind"),
    [
        (("free_thresh: 0.196", "free_thresh: 0.25"), "thresholds"),
        (("free_thresh:", "free_tresh: 0.1\nfree_thresh:"), "key"),
        ((", 0.0]", ", 0.4]"), "yaw"),
        (("resolution: 0.05", "resolution: 0.0504"), "resolution"),
        (("resolution: 0.05", "resolution: 1.0"), "resolution"),
        (("- 100", "- 90"), "image-size"),
        (("image: floor.pgm", "image: gone.pgm"), "file"),
        (("negate: 0", "negate: 2"), "file"),
        (("occupied_thresh: 0.65", "occupied_thresh: 0.1"), "file"),
    ],
)
def test_each_key_that_misleads_a_robot_is_named(floor, change, kind):
    assert change[0] in floor.read_text()
    floor.write_text(floor.read_text().replace(*change))
    result = run("check", floor, "--json")
    assert result.exit_code == 1
    assert kind in {one["kind"] for one in json.loads(result.stdout)["findings"]}


def test_negated_map_of_a_plain_one_is_named(floor):
    image = floor.with_suffix(".pgm")
    Image.fromarray(np.where(np.asarray(Image.open(image)) == 205, 0, 254).astype(np.uint8)).save(image)
    floor.write_text(floor.read_text().replace("negate: 0", "negate: 1"))
    result = run("check", floor)
    assert result.exit_code == 1
    assert "negate: 1 makes the map's edge free" in result.stdout


def test_provenance_is_a_key_that_other_readers_do_not_ask_for(floor):
    written = yaml.safe_load(floor.read_text())
    assert read_provenance(floor)["image_size"] == [100, 80]
    del written["fognav"]
    floor.write_text(yaml.safe_dump(written))
    assert np.array_equal(load_map(floor).cells, room().cells)
    assert read_provenance(floor) == {}


def test_map_goes_to_png_and_back_with_its_cells_and_provenance(floor, tmp_path):
    assert run("convert", floor, tmp_path / "a.png").exit_code == 0
    assert run("convert", tmp_path / "a.yaml", tmp_path / "b.pgm").exit_code == 0
    back = load_map(tmp_path / "b.yaml")
    assert (back.geometry, back.cells.tolist()) == (room().geometry, room().cells.tolist())
    assert read_provenance(tmp_path / "b.yaml")["command"] == "fognav map from-log drive.mcap"


def test_grades_and_yaw_of_another_maker_survive_in_another_image(tmp_path):
    Image.fromarray(np.array([[0, 255, 128, 100]], np.uint8)).save(tmp_path / "grey.png")
    (tmp_path / "grey.yaml").write_text(
        "image: grey.png\nmode: scale\nresolution: 0.05\norigin: [1, 2, 0.5]\nnegate: 0\noccupied_thresh: 0.9\n"
        "free_thresh: 0.1\n"
    )
    before = load_occupancy(tmp_path / "grey.yaml")
    assert run("convert", tmp_path / "grey.yaml", tmp_path / "b.pgm").exit_code == 0
    after = load_occupancy(tmp_path / "b.yaml")
    assert (after.values.tolist(), after.yaw) == (before.values.tolist(), before.yaw)
    assert load_map(tmp_path / "b.yaml").cells.tolist() == load_map(tmp_path / "grey.yaml").cells.tolist()


def test_map_of_the_benchmarks_comes_back_and_what_it_cannot_hold_is_said(floor, tmp_path):
    said = json.loads(run("convert", floor, tmp_path / "a.map", "--json").stdout)["lost"]
    assert said[0] == "2624 unknown cells are obstacles now"
    assert "(-1, 2)" in said[1]
    raw = read_map_text(tmp_path / "a.map")
    assert np.array_equal(raw[::-1] == FREE, room().cells == FREE)
    assert run("convert", tmp_path / "a.map", tmp_path / "b.yaml", "--resolution", "0.05").exit_code == 0
    assert np.array_equal(load_map(tmp_path / "b.yaml").cells == FREE, room().cells == FREE)


@pytest.mark.parametrize("resolution", [0.1, 0.13, 0.02])
def test_no_wall_gets_a_hole_in_another_resolution(floor, tmp_path, resolution):
    assert run("convert", floor, tmp_path / "a.pgm", "--resolution", resolution).exit_code == 0
    old, new = room(), load_map(tmp_path / "a.yaml")
    walls = old.geometry.centres(np.argwhere(old.cells == LETHAL)[:, ::-1])
    assert (new.geometry.sample(new.cells, walls, UNKNOWN) == LETHAL).all()


def test_target_that_would_replace_its_source_or_has_no_format_is_refused(floor):
    for target in (floor, floor.with_suffix(".png"), floor.with_suffix(".bmp")):
        assert run("convert", floor, target).exit_code == 2
    assert run("check", floor.with_suffix(".gone")).exit_code == 2
