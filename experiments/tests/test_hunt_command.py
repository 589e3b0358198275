"""`fognav hunt`: a world of a file is driven again, records are summed up, and the exit code says what was broken."""

from __future__ import annotations

import msgspec
from typer.testing import CliRunner

from fognav.__main__ import app
from fognav_experiments.hunt.play import write_world
from fognav_experiments.hunt.world import HuntWorld
from fognav_experiments.scenarios.description import Obstacle

CORRIDOR = HuntWorld(
    title="a short corridor", start=(1.5, 1.5, 0.0), goal=(5.0, 1.5), size=(7.0, 3.0), free=[(0.5, 0.5, 6.5, 2.5)],
    seconds=20.0,
)  # fmt: skip


def run(*arguments: object):
    return CliRunner().invoke(app, ["hunt", *map(str, arguments)])


def test_replay_tells_which_rule_was_broken_and_where(tmp_path):
    kind, unfair = tmp_path / "kind.json", tmp_path / "unfair.json"
    kind.write_bytes(write_world(CORRIDOR))
    wall = Obstacle(at_m=1.5, polygon=[(3.19, 0.5), (3.6, 0.5), (3.6, 2.5), (3.19, 2.5)])  # 2 cm before the robot
    unfair.write_bytes(write_world(msgspec.structs.replace(CORRIDOR, events=[wall])))
    assert run("--replay", kind).exit_code == 0
    told = run("--replay", kind, "--replay", unfair)
    assert told.exit_code == 1
    assert "kind.json: reached" in told.output
    assert "contact at" in told.output


def test_records_are_summed_up_without_a_drive(tmp_path):
    told = run("--minutes", 0, "--out", tmp_path)
    assert told.exit_code == 0
    assert "0 drives, 0.00 simulated hours" in told.output


def test_damaged_file_is_named(tmp_path):
    file = tmp_path / "world.json"
    file.write_text("{}")
    told = run("--replay", file)
    assert told.exit_code == 2
    assert "world.json" in told.output
