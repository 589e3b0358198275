"""Blind robots are kept apart by the planner's leases alone; FOGNAV_ROOM_SEEDS sets how many floors are driven."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fog_runtime.configuration.maps import save_map
from fognav.output import WRONG_USE
from fognav_experiments.bench import room
from fognav_experiments.commands.bench import bench_app

SITES = Path(__file__).parents[2] / "sites"
SEEDS = int(os.environ.get("FOGNAV_ROOM_SEEDS", "1"))


@pytest.mark.parametrize(("floor", "robots"), [("narrow", 4), ("aisles", 10), ("estig", 5)])
@pytest.mark.drive
def test_blind_robots_touch_no_other_one_and_none_waits_for_ever(floor, robots):
    floor_map = room.floor_named(floor, SITES)
    runs = [room.play(floor_map, robots, seed, 240.0) for seed in range(1, 1 + SEEDS)]
    figures = room.summary(runs)
    assert figures["contacts"] == 0, figures
    assert figures["deadlocks"] == 0, figures
    assert all(run.took for run in runs), "some arrived"


def test_bodies_can_touch():
    """Without leases they do: nothing else keeps these robots apart."""
    run = room.Floor(room.floor_named("narrow", SITES), 10, 1)
    run.core.leases.release = lambda *_: float("inf")
    run.run(120.0)
    assert run.contacts > 0


def test_a_recorded_floor_is_driven_and_a_floor_or_map_that_is_not_there_is_wrong_use(tmp_path):
    small = room.aisles(1.8, number=2, length=6.0)
    save_map(tmp_path / "small", small)
    asked = ["room", "--robots", "2", "--seeds", "1", "--seconds", "10", "--json"]
    found = CliRunner().invoke(bench_app, [*asked, "--map", str(tmp_path / "small.yaml")])
    assert found.exit_code == 0, found.output
    assert '"contacts": 0' in found.stdout
    for wrong in (["--floor", "nowhere"], ["--map", str(tmp_path / "nowhere.yaml")]):
        refused = CliRunner().invoke(bench_app, [*asked, *wrong])
        assert refused.exit_code == WRONG_USE, refused.output
        assert "nowhere" in refused.output


def test_a_floor_that_is_not_there_is_named():
    with pytest.raises(ValueError, match=r"no floor 'nowhere': take aisles, narrow or a site of"):
        room.floor_named("nowhere", SITES)
