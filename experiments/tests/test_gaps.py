"""Narrow places that only the lidar sees: the robot never touches anything, and passes what it fits through.

FOGNAV_GAP_SEEDS sets the number of drives at each place.
"""

import os

import numpy as np
import pytest
from gaps import door_ajar, drive, series

from robot_agent.motion.recovery import Recoveries

SEEDS = int(os.environ.get("FOGNAV_GAP_SEEDS", "2"))

pytestmark = pytest.mark.timeout(900)


@pytest.mark.parametrize("stop_field", [False, True])
@pytest.mark.parametrize(
    ("kind", "gap"), [("doorway", 0.42), ("door ajar", 0.42), ("chair legs", 0.42), ("corner", 0.52)]
)
def test_robot_passes_a_gap_8_cm_wider_than_itself_without_contact(kind, gap, stop_field):
    row = series(kind, gap, SEEDS, stop_field=stop_field)
    assert row.passable
    assert row.contacts == 0
    assert row.passed >= 0.95 * row.drives


@pytest.mark.parametrize("seed", [7, 16])
def test_robot_whose_way_goes_on_round_the_jamb_keeps_to_the_middle_of_a_door_ajar(seed):
    rng = np.random.default_rng((seed, 420, 1))
    outcome = drive(door_ajar(0.42, rng), rng, stop_field=True)
    assert outcome.passed
    assert outcome.clearance_m > 0.02


@pytest.mark.parametrize("beside", [0.28, 0.30, 0.32])
def test_robot_that_cuts_a_corner_that_its_path_passes_with_room_stays_clear_of_it(beside):
    row = series("corner", 2.0 * beside, SEEDS, stop_field=True)
    assert row.passed == row.drives
    assert row.clearance_min_m > 0.045


@pytest.mark.parametrize(("kind", "gap"), [("doorway", 0.20), ("doorway", 0.32), ("door ajar", 0.36)])
def test_robot_does_not_touch_what_it_does_not_fit_through(kind, gap):
    row = series(kind, gap, SEEDS, seconds=15.0)
    assert not row.passable
    assert (row.contacts, row.passed) == (0, 0)
    assert row.clearance_min_m > 0.0


def test_robot_that_is_stuck_in_a_gap_backs_up_and_passes(monkeypatch):
    def outcome():
        rng = np.random.default_rng((18, 410, 5))
        return drive(door_ajar(0.41, rng), rng)

    helped = outcome()
    assert helped.passed
    assert helped.clearance_m > 0.0
    monkeypatch.setattr(Recoveries, "due", lambda *_: None)
    assert not outcome().passed
