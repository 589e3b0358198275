"""`fognav map diff`: a cupboard has come, a door is open, a person walks by; and what three drives agree on is kept."""

import json

import numpy as np
import pytest
from PIL import Image
from small_floors import ROOMS, floor, log_of_drive
from typer.testing import CliRunner

from fog_contracts.costs import FREE, LETHAL
from fog_runtime.configuration.maps import load_map, save_map
from fognav.__main__ import app

pytestmark = pytest.mark.drive

WAY = [(2.0, 2.0), (13.3, 2.0), (9.5, 2.0), (9.5, 6.0), (12.0, 7.0), (9.5, 5.0), (9.5, 2.0), (2.0, 2.0), (2.0, 8.0)]
SHUT = tuple(room for room in ROOMS if room != (5, 2.8, 6, 3.4))
CUPBOARD = (11.0, 1.0, 12.0, 1.5)
MAP = floor(*SHUT, (4.9, 2.8, 5.0, 2.9))
NOW = floor(*ROOMS, boxes=(CUPBOARD,))
PERSON = (3.0, 1.6, 8.5, 2.6)


def run(*arguments: object):
    return CliRunner().invoke(app, ["map", *map(str, arguments)])


def drive(folder, name, seed, world=NOW):
    file = folder / f"{name}.jsonl"
    file.write_text("\n".join(log_of_drive(world, WAY, seed, PERSON)) + "\n")
    return file


def at(file, x: float, y: float) -> int:
    static = load_map(file)
    return int(static.geometry.sample(static.cells, np.array([(x, y)]), 255)[0])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("diff")
    save_map(folder / "floor", MAP)
    return folder


@pytest.fixture(scope="module")
def logs(folder):
    return [drive(folder, f"day{seed}", seed) for seed in (1, 2, 3)]


def test_cupboard_and_open_door_are_found_and_taken_over_after_three_drives_and_a_person_never(folder, logs):
    map_file = folder / "floor.yaml"
    first = run("diff", map_file, logs[0], "--take-over", "--png", folder / "changes.png", "--json")
    assert first.exit_code == 0, first.output
    said = json.loads(first.stdout)
    assert said["taken_over"] == []
    assert sorted(one["kind"] for one in said["changes"]) == ["gone", "new"]
    for one in said["changes"]:
        left, bottom, right, top = one["box"]
        expected = CUPBOARD if one["kind"] == "new" else (5.0, 3.0, 6.0, 3.2)
        assert left == pytest.approx(expected[0], abs=0.3)
        assert right == pytest.approx(expected[2], abs=0.3)
        assert expected[1] - 0.1 < bottom < top < expected[3] + 0.1
    with Image.open(folder / "changes.png") as picture:
        assert {(220, 40, 40), (40, 90, 230), (250, 235, 170)} <= {colour for _, colour in picture.getcolors(65536)}

    again = json.loads(run("diff", map_file, logs[0], logs[1], "--take-over", "--json").stdout)
    assert [one["drives"] for one in again["changes"]] == [2, 2]
    assert again["taken_over"] == []
    third = json.loads(run("diff", map_file, logs[2], "--take-over", "--json").stdout)
    assert {line.split()[0] for line in third["taken_over"]} == {"block", "erase"}
    assert run("clean", map_file).exit_code == 0
    cleaned = folder / "floor-clean.yaml"
    assert (at(map_file, 11.5, 1.45), at(cleaned, 11.5, 1.45)) == (FREE, LETHAL)
    assert (at(map_file, 5.5, 3.1), at(cleaned, 5.5, 3.1)) == (LETHAL, FREE)
    assert at(cleaned, 5.5, 2.0) == at(cleaned, 8.0, 2.4) == FREE

    settled = json.loads(run("diff", cleaned, logs[2], "--json").stdout)
    assert settled["changes"] == []


def test_what_a_later_drive_no_longer_sees_is_forgotten(folder, logs):
    save_map(folder / "other", MAP)
    run("diff", folder / "other.yaml", logs[0])
    back = json.loads(run("diff", folder / "other.yaml", drive(folder, "back", 4, MAP), "--json").stdout)
    assert back["changes"] == []


def test_map_that_others_were_laid_onto_takes_over_what_has_stood(folder, logs):
    save_map(folder / "plan", MAP)
    save_map(folder / "recorded", NOW)
    assert run("clean", folder / "recorded.yaml", "--onto", folder / "plan.yaml").exit_code == 0
    taken = run("diff", folder / "plan.yaml", logs[0], "--take-over", "--drives", 1)
    assert (taken.exit_code, "to " + str(folder / "plan.clean") in taken.output) == (0, True), taken.output
    # From then on the map that the commands make is the one to compare with.
    assert run("diff", folder / "plan.yaml", logs[0], "--take-over").exit_code == 2


def test_drive_through_another_building_is_refused(folder):
    elsewhere = drive(folder, "elsewhere", 5, floor((1, 1, 14.6, 4.2), (1, 1, 3, 9.5), (8.4, 1, 14.6, 8)))
    refused = run("diff", folder / "floor.yaml", elsewhere)
    assert refused.exit_code == 1
    assert "can't be compared with" in refused.output
