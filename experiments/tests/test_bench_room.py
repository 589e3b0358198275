"""Blind robots are kept apart by the planner's leases alone; FOGNAV_ROOM_SEEDS sets how many floors are driven."""

from __future__ import annotations

import os
from pathlib import Path

import pytest
from typer.testing import CliRunner

from fog_contracts.costs import INSCRIBED
from fog_runtime.configuration.maps import save_map
from fognav.output import WRONG_USE
from fognav_experiments.bench import room, room_blocks
from fognav_experiments.commands.bench import bench_app
from fognav_sim.barrier import barrier_across

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
    run = room.Floor(room.ChangingMap(room.floor_named("narrow", SITES)), 10, 1)
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


def test_nodes_tell_a_fleet_of_a_block_that_its_lidars_see_later_and_both_meet_the_same(tmp_path):
    runs = list(room_blocks.play_all("aisles", SITES, 1, [3], 120.0, tmp_path, "c"))
    assert [run.eyes for run in runs] == ["nodes", "lidars"]
    assert len({(run.blocked, run.blocked_s) for run in runs}) == 1
    assert all((run.run.contacts, run.entered) == (0, 0) for run in runs)
    assert room_blocks.read(tmp_path) == sorted(runs, key=lambda run: run.name)
    assert list(room_blocks.play_all("aisles", SITES, 1, [3], 120.0, tmp_path, "later")) == runs


@pytest.mark.parametrize(("eyes", "known"), [("nodes", True), ("lidars", False)])
def test_what_no_lidar_can_see_is_on_the_map_only_of_nodes_and_leaves_it_with_the_block(eyes, known):
    site, map_ = room_blocks.watched_floor("aisles", SITES)
    area = site.areas[5]
    block = room_blocks.Block(area.id, barrier_across(area, site, map_, 1), 5.0, 20.0)
    run = room.Floor(room_blocks.WatchedMap(site, map_, eyes, [block]), 1, 1)
    robot = run.robots[0]
    robot.x, robot.y, middle = 15.0, 1.0, map_.geometry.cell(16.2, 16.1)
    run.core.set_goal = lambda *_, **__: None  # it stays in another aisle

    def blocked():
        return run.core._map.current.cost[middle[1], middle[0]] >= INSCRIBED

    run.run(4.0)
    assert not blocked()
    run.run(6.0)
    assert blocked() == known
    run.run(12.0)
    assert not blocked()


def test_published_fleets_are_what_their_runs_give(tmp_path):
    published = SITES.parent / "docs" / "results" / "fleets"
    room_blocks.publish(room_blocks.read(published), tmp_path)
    for name in ("README.md", "missions.svg"):
        assert (tmp_path / name).read_text("utf-8") == (published / name).read_text("utf-8"), name
