"""Options of `fognav experiment` that contradict each other, or leave nothing to do."""

from __future__ import annotations

import re
import shutil
import tomllib

import msgspec
import pytest
from typer.testing import CliRunner

from fog_contracts.messages import Place
from fognav import checkout, kernels, system
from fognav.__main__ import app
from fognav_experiments.commands import experiment
from fognav_experiments.comparison import hardware_drive, records, runner, sensitivity
from fognav_experiments.comparison.drives import ComparedDrive, MeasuredDrive
from fognav_experiments.comparison.records import Folder
from fognav_experiments.scenarios import play as playing
from fognav_sim import nodes

OUT = ["--out", "unused"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--live", "--cpu-quota", "0.2", "--speed", "4", *OUT], "--cpu-quota 0.2 is a share of real time"),
        (["--hardware", "--robot-file", "r.toml", *OUT], "--robot-file is of a simulated robot"),
        (["--hardware", "--draws", "floor", *OUT], "--draws floor has stops that are no places"),
        (["--draws", "all", *OUT], "choose of thesis, floor"),
        (["sensitivity", "--readings", "none", "--areas", "none", *OUT], "leaves nothing to sweep"),
    ],
)
def test_options_that_exclude_each_other_are_refused(tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(experiment.experiment_app, arguments)
    assert result.exit_code == 2
    assert words in " ".join(result.output.split())
    assert list(tmp_path.iterdir()) == []


def test_area_that_no_barrier_closes_is_named_before_the_first_drive(tmp_path, monkeypatch):
    place = tmp_path / "site"
    shutil.copytree(checkout.site_folder(None), place)
    text = (place / "site.toml").read_text("utf-8")
    spec = tomllib.loads((place / "experiment.toml").read_text("utf-8"))
    for area in tomllib.loads(text)["areas"]:
        (x, y), *_ = area["polygon"]
        corner = [[x, y], [x + 0.1, y], [x + 0.1, y + 0.1], [x, y + 0.1]]  # smaller than any barrier
        text = re.sub(rf'(id = "{area["id"]}"\n(?:.+\n)*?polygon = )\[\[.*\]\]', rf"\g<1>{corner}", text)
    (place / "site.toml").write_text(text, "utf-8")
    monkeypatch.setattr(runner, "run", lambda *_: pytest.fail("a drive was begun"))
    arguments = ["--site", str(place), "--runs", "3", "--out", str(tmp_path / "drives")]
    result = CliRunner().invoke(experiment.experiment_app, arguments)
    assert result.exit_code == 2
    first = spec["routes"][0]
    told = " ".join(result.output.split())
    assert f"experiment.toml: run 1, route {first['start']}{first['goal']}: area " in told
    assert "no barrier fits" in told


def test_a_sweep_of_one_plane_drives_no_other_and_its_page_names_that_command(tmp_path, monkeypatch):
    monkeypatch.setattr(kernels, "warm_cache", lambda _: None)
    monkeypatch.setattr(sensitivity, "sweep", lambda *_: iter(()))
    arguments = ["sensitivity", "--areas", "none", "--routes", "1", "--out", str(tmp_path)]
    result = CliRunner().invoke(experiment.experiment_app, arguments, catch_exceptions=False)
    assert "no record of 0002-ab-default-" in result.output
    page = (tmp_path / "README.md").read_text("utf-8")
    command = (
        "fognav experiment sensitivity --readings 2,5,20 --pause 50,500 --areas none --routes 1 --seed 1 --out DIR"
    )
    assert command in page
    assert "## readings and pause_ms" in page
    assert "## areas" not in page


def test_a_drive_that_was_skipped_is_named_and_is_no_success(tmp_path, monkeypatch):
    monkeypatch.setattr(experiment, "find_fog", lambda _address: None)
    monkeypatch.setattr(hardware_drive, "drive_hardware", lambda *_: None)  # each drive is skipped
    arguments = ["--hardware", "--only", "1", "--setups", "fog", "--out", str(tmp_path / "drives")]
    result = CliRunner().invoke(experiment.experiment_app, arguments, catch_exceptions=False)
    assert result.exit_code == 1, result.output
    told = " ".join(result.output.split())
    assert re.search(r"no record of 0001-\w+-fog, .*: repeat the command to drive them", told)
    assert re.search(r"\b0 of [1-9]\d* drives succeeded", told)


def test_a_report_of_an_archive_needs_a_folder_of_its_own(tmp_path):
    (tmp_path / "drives.jsonl.xz").write_bytes(b"")
    result = CliRunner().invoke(experiment.experiment_app, ["report", str(tmp_path / "drives.jsonl.xz")])
    assert result.exit_code == 2
    assert "name a folder for the report with --out DIR" in " ".join(result.output.split())


def test_a_report_shows_the_live_drives_of_another_folder_and_its_archive_keeps_them(tmp_path):
    """Its own folder stays as it was; another experiment's drives are refused."""
    packed = checkout.root() / "docs" / "results" / "estig" / "drives.jsonl.xz"
    driven, lockstep, live = (Folder(tmp_path / name) for name in ("driven", "lockstep", "live"))
    records.unpack_archive(packed, driven)
    for folder in (lockstep, live):
        folder.adopt(driven.description())
    asked = [record for record in driven.drives.read() if record.run == 1]
    for record in asked:
        lockstep.drives.write(record)
        shared = {name: getattr(record, name) for name in ComparedDrive.__struct_fields__}
        live.measured("live").write(MeasuredDrive(kind="live", plans=1, peak_mb={"robot-agent": 200.0}, **shared))
    before = sorted((tmp_path / "lockstep").rglob("*"))
    report = ["report", str(tmp_path / "lockstep"), "--out", str(tmp_path / "report"), "--with-live"]
    result = CliRunner().invoke(experiment.experiment_app, [*report, str(tmp_path / "live")], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert sorted((tmp_path / "lockstep").rglob("*")) == before
    for name in ("live-memory.svg", "live-distance.svg", "live-time.svg"):
        assert (tmp_path / "report" / name).is_file()
    again = Folder(tmp_path / "again")
    records.unpack_archive(tmp_path / "report" / records.ARCHIVE, again)
    assert len(again.measured("live").read()) == len(asked) > 0
    description = live.description()
    description["asked"]["seed"] += 1
    other = Folder(tmp_path / "other")
    other.adopt(description)
    refused = CliRunner().invoke(experiment.experiment_app, [*report, str(tmp_path / "other")])
    assert refused.exit_code == 2
    assert "holds drives of another experiment" in " ".join(refused.output.split())
    elsewhere = [*report, str(tmp_path / "live"), "--site", str(checkout.root() / "experiments" / "floors" / "intel")]
    refused = CliRunner().invoke(experiment.experiment_app, elsewhere)
    assert refused.exit_code == 2
    assert "name the site of these drives" in " ".join(refused.output.split())


def test_scenarios_that_are_ended_early_leave_the_table_of_those_that_were_played(tmp_path, monkeypatch):
    def play(scenario, _sites):
        if scenario.title.startswith("No Wi-Fi for 5 s"):
            raise KeyboardInterrupt
        result = playing.FleetResult(
            contacts=0, reason="", distance_m=9.9, time_s=37.0, arrived=1, gap_m=1.0, plans=1, planner_percent=0.1
        )
        return playing.Played(scenario, result, "reached", [])

    monkeypatch.setattr(playing, "play", play)
    monkeypatch.setattr(system, "prepare_node_code", lambda _inform: None)
    monkeypatch.setattr(kernels, "warm_cache", lambda _inform: None)
    table = tmp_path / "table.md"
    arguments = ["scenarios", "wifi-gap-1s", "wifi-gap-5s", "--table", str(table)]
    result = CliRunner().invoke(experiment.experiment_app, arguments)
    assert result.exit_code != 0
    page = table.read_text("utf-8")
    assert "| reached | 9.9 | 37 | yes" in page
    assert "wifi-gap-5s" not in page


class ReachedError(Exception):
    """The command went on to its work."""


@pytest.mark.parametrize(
    "arguments", [["--runs", "1"], ["sensitivity", "--areas", "none", "--routes", "1"]], ids=["drives", "sensitivity"]
)
def test_drives_say_in_one_line_that_nodes_run_a_model_and_why(arguments, tmp_path, monkeypatch):
    def reached(*_, **__):
        raise ReachedError

    monkeypatch.setattr(kernels, "warm_cache", lambda _: None)
    for module, name in ((runner, "run"), (sensitivity, "sweep")):
        monkeypatch.setattr(module, name, reached)
    for folder, lines in ((tmp_path, 1), (nodes.find_firmware(), 0)):
        monkeypatch.setenv("FOGNAV_FIRMWARE_DIR", str(folder))
        done = CliRunner().invoke(app, ["experiment", *arguments, "--out", str(tmp_path / "out")])
        assert isinstance(done.exception, ReachedError), done.output
        said = " ".join(done.output.split())
        reason = "simulated sensor nodes run a model in Python, not the firmware: there are no sources"
        assert said.count(reason) == lines


@pytest.mark.drive
def test_another_robot_drives_the_same_routes_and_its_drives_are_another_experiment(tmp_path, monkeypatch):
    file = tmp_path / "robot.toml"
    file.write_text('[base]\ndriver = "diffdrive"\n[lidar]\ndriver = "ld19"\nx_m = -0.03\n')
    out, spec = tmp_path / "drives", runner.drawer
    near = Place(x=31.0, y=28.4)
    monkeypatch.setattr(
        runner, "drawer",
        lambda *arguments: lambda run: [
            msgspec.structs.replace(drawn, ends=(Place(x=34.0, y=28.4, theta=3.14), near), area="z5",
                                    moment="before", trigger_m=0.0)
            for drawn in spec(*arguments)(run)[:1]
        ],
    )  # fmt: skip
    arguments = ["--setups", "fog", "--only", "1", "--out", str(out)]
    run = CliRunner()
    result = run.invoke(experiment.experiment_app, [*arguments, "--robot-file", str(file)], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert Folder(out).description()["asked"]["robot"].startswith("diffdrive, ld19 (")
    (record,) = Folder(out).drives.read()
    assert record.success
    result = run.invoke(experiment.experiment_app, arguments)
    assert result.exit_code == 2
    assert "holds drives of another experiment" in " ".join(result.output.split())
