"""`fognav map clean`: commands are kept beside a map, undone by deleting their lines, and clean the next recording."""

import numpy as np
import pytest
from small_floors import OFFICE, ROOMS, floor
from typer.testing import CliRunner

from fog_contracts.costs import FREE, LETHAL
from fog_contracts.resampling import resampled
from fog_runtime.configuration.maps import load_map, read_provenance, save_map
from fognav.__main__ import app


def clean(*arguments: object):
    return CliRunner().invoke(app, ["map", "clean", *map(str, arguments)])


def value(file, x: float, y: float) -> int:
    static = load_map(file)
    return int(static.geometry.sample(static.cells, np.array([(x, y)]), 255)[0])


@pytest.fixture
def map_file(tmp_path):
    save_map(tmp_path / "floor", OFFICE, {"command": "fognav map from-log a.mcap"})
    return tmp_path / "floor.yaml"


def test_command_is_added_to_a_file_and_undone_by_deleting_its_line(map_file, tmp_path):
    before = map_file.with_suffix(".pgm").read_bytes()
    assert clean(map_file, "wall", 5, 1, 5, 3).exit_code == 0
    assert clean(map_file, "free", 8, 6, 8, 5, 7, 5).exit_code == 0
    result, commands = tmp_path / "floor-clean.yaml", tmp_path / "floor.clean"
    assert (value(result, 5.0, 2.0), value(result, 7.7, 5.2)) == (LETHAL, FREE)
    assert read_provenance(result)["by"] == ["wall 5 1 5 3", "free 8 6 8 5 7 5"]
    assert read_provenance(result)["command"] == "fognav map from-log a.mcap"
    commands.write_text(commands.read_text().replace("wall 5 1 5 3\n", ""))
    assert clean(map_file).exit_code == 0
    assert (value(result, 5.0, 2.0), value(result, 7.7, 5.2)) == (FREE, FREE)
    assert map_file.with_suffix(".pgm").read_bytes() == before


def test_same_commands_give_the_same_image(map_file, tmp_path):
    images = []
    for _ in range(2):
        assert clean(map_file, *([] if images else ["straighten"])).exit_code == 0
        images.append((tmp_path / "floor-clean.pgm").read_bytes())
    assert images[0] == images[1]


def test_next_recording_is_cleaned_by_the_same_file_in_the_frame_of_the_first(map_file, tmp_path):
    assert clean(map_file, "wall", 5, 1, 5, 3).exit_code == 0
    save_map(tmp_path / "second", resampled(floor(*ROOMS, boxes=((11, 1, 12, 1.2),)), 0.4, (-20.0, 7.0)))
    said = clean(tmp_path / "second.yaml", "--commands", tmp_path / "floor.clean")
    assert said.exit_code == 0, said.output
    assert "laid onto floor.yaml at (" in said.stdout
    result = tmp_path / "second-clean.yaml"
    assert (value(result, 5.0, 2.0), value(result, 11.5, 1.1), value(result, 7.0, 2.0)) == (LETHAL, LETHAL, FREE)


def test_another_floor_and_another_first_map_are_refused(map_file, tmp_path):
    assert clean(map_file, "wall", 5, 1, 5, 3).exit_code == 0
    save_map(tmp_path / "other", floor((1, 1, 6, 9), (8, 1, 10, 9), (5, 4, 9, 4.8)))
    refused = clean(tmp_path / "other.yaml", "--commands", tmp_path / "floor.clean")
    assert refused.exit_code == 1
    assert "the maps do not fit" in refused.output
    save_map(tmp_path / "floor", floor(*ROOMS, boxes=((11, 1, 12, 1.2),)))
    refused = clean(map_file)
    assert refused.exit_code == 2
    assert "was made for another floor.yaml" in refused.output


def test_map_that_the_commands_begin_with_is_never_replaced(map_file, tmp_path):
    before = map_file.read_text(), map_file.with_suffix(".pgm").read_bytes()
    save_map(tmp_path / "second", OFFICE)
    assert clean(map_file, "wall", 5, 1, 5, 3, "--out", tmp_path / "floor").exit_code == 2
    assert clean(map_file, "wall", 5, 1, 5, 3).exit_code == 0
    replaced = clean(tmp_path / "second.yaml", "--commands", tmp_path / "floor.clean", "--out", tmp_path / "floor")
    assert (replaced.exit_code, "Name another --out" in replaced.output) == (2, True)
    assert (map_file.read_text(), map_file.with_suffix(".pgm").read_bytes()) == before


@pytest.mark.parametrize("words", [["brush", "1"], ["erase", "1", "2", "3"], ["erase", "90", "90", "91", "91"]])
def test_command_that_is_wrong_is_refused_with_its_line_and_not_kept(map_file, words):
    assert clean(map_file, "wall", 5, 1, 5, 3).exit_code == 0
    kept = map_file.with_suffix(".clean").read_text()
    refused = clean(map_file, *words)
    assert refused.exit_code == 2
    assert "floor.clean, line 5: " in refused.output
    assert map_file.with_suffix(".clean").read_text() == kept


def test_no_file_of_commands_is_made_for_a_map_elsewhere(map_file, tmp_path):
    refused = clean(map_file, "straighten", "--commands", tmp_path / "gone" / "f.clean")
    assert refused.exit_code == 2
    assert clean(map_file).exit_code == 2
