"""Blind robots are kept apart by the planner's leases alone; FOGNAV_ROOM_SEEDS sets how many floors are driven."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from fognav_experiments.bench import room

SITES = Path(__file__).parents[2] / "sites"
SEEDS = int(os.environ.get("FOGNAV_ROOM_SEEDS", "1"))


@pytest.mark.parametrize(("floor", "robots"), [("aisles", 4), ("narrow", 4), ("aisles", 10), ("estig", 5)])
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


def test_a_floor_that_is_not_there_is_named():
    with pytest.raises(ValueError, match=r"no floor 'nowhere': take aisles, narrow or a site of"):
        room.floor_named("nowhere", SITES)
