"""How scans fit the map, what status of the pose follows, and what casts doubt on a pose that fits, and ends it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from little_world import L_ROOMS, grid_of

from robot_agent.config import LocalizationConfig
from robot_agent.localization.fit import Doubt, Fit, FitMonitor, casts_doubt, evaluate_fit, grade_fit
from robot_agent.localization.map_fields import map_fields
from robot_agent.localization.pose import Pose2, Uncertainty

FIELDS = map_fields(*grid_of(L_ROOMS, 15.0, 12.0), LocalizationConfig())
PLACE = Pose2(5.0, 2.0, 1.0)
GOOD = Fit(agree=0.95, explained=0.9, contradict=0.02, informative=80)
FAIR = Fit(agree=0.9, explained=0.8, contradict=0.12, informative=80)
COVERED = Fit(agree=0.0, explained=0.0, contradict=1.0, informative=2)
VAGUE = Fit(agree=0.9, explained=0.1, contradict=0.0, informative=4)
OPENED_DOOR = Fit(agree=0.85, explained=0.8, contradict=0.1, informative=80)
CROWDED = Fit(agree=0.5, explained=0.4, contradict=0.01, informative=50)
OCCUPIED_ELSEWHERE = Fit(agree=0.7, explained=0.6, contradict=0.1, informative=80)
BLURRED = Fit(agree=0.95, explained=0.9, contradict=0.02, informative=80, blurred=0.2)
CONTRADICTED = Fit(agree=0.6, explained=0.5, contradict=0.3, informative=80)
WRONG = Fit(agree=0.2, explained=0.2, contradict=0.6, informative=80)
SURE = Uncertainty(0.05, 0.03, 0.02)


def points_at(pose: Pose2, *, shorten: float = 0.0, fields=FIELDS):
    angles = np.linspace(-math.pi, math.pi, 120, endpoint=False)
    ranges = fields.ranges(pose.x, pose.y, angles + pose.theta, 12.0) - shorten
    hit = np.isfinite(ranges)
    return np.column_stack((ranges[hit] * np.cos(angles[hit]), ranges[hit] * np.sin(angles[hit])))


def monitor_after(*fits: Fit, trial: int = 0) -> FitMonitor:
    monitor = FitMonitor()
    monitor.begin("checking", trial)
    for fit in fits:
        monitor.add(fit, SURE)
    return monitor


def test_scan_of_the_map_itself_agrees_and_contradicts_nothing():
    fit = evaluate_fit(FIELDS, PLACE, points_at(PLACE), 12.0)
    assert fit.agree > 0.95
    assert fit.explained > 0.95
    assert fit.contradict < 0.05


def test_beams_through_walls_contradict_and_objects_before_walls_do_not():
    through = evaluate_fit(FIELDS, PLACE, points_at(PLACE, shorten=-0.6), 12.0)
    assert through.contradict > 0.5
    before = evaluate_fit(FIELDS, PLACE, points_at(PLACE, shorten=0.45), 12.0)
    assert before.contradict < 0.2
    assert before.explained < 0.5


def test_scan_of_which_all_beams_end_before_walls_contradicts_nothing_and_speaks_for_no_new_pose():
    surrounded = evaluate_fit(FIELDS, PLACE, 0.3 * points_at(PLACE), 12.0)
    assert (surrounded.informative, surrounded.contradict) == (0, 0.0)
    assert monitor_after(GOOD, GOOD, *[surrounded] * 40).status == "weak"
    assert monitor_after(*[surrounded] * 40).status == "none"


def test_scan_without_beams_counts_as_contradiction():
    fit = evaluate_fit(FIELDS, PLACE, np.zeros((0, 2)), 12.0)
    assert (fit.informative, fit.contradict) == (0, 1.0)


@pytest.mark.parametrize(
    ("fit", "spread", "grade", "reason"),
    [
        (GOOD, SURE, "good", ""),
        (CONTRADICTED, SURE, "weak", "pass through walls"),
        (WRONG, SURE, "lost", "pass through walls"),
        (VAGUE, SURE, "weak", "too few beams"),
        (CROWDED, SURE, "good", ""),
        (OPENED_DOOR, SURE, "weak", "10% of the beams pass through walls of the map, and 85% end at them"),
        (BLURRED, SURE, "weak", "20% of the beams end beside the walls"),
        (GOOD, Uncertainty(2.0, 1.2, 0.1), "lost", "uncertain by 1.2 m in every direction"),
        (GOOD, Uncertainty(9.0, 0.1, 0.1), "weak", "9.00 m in one direction"),
        (GOOD, Uncertainty(0.4, 0.3, 0.1), "weak", "0.40 m"),
        (GOOD, Uncertainty(0.1, 0.1, 0.4), "weak", "0.40 rad"),
    ],
)
def test_grade_and_reason(fit, spread, grade, reason):
    found = grade_fit(fit, spread)
    assert found[0] == grade
    assert reason in found[1]


def test_two_good_scans_make_a_good_pose():
    assert monitor_after(GOOD).status == "none"
    assert monitor_after(GOOD, GOOD).status == "good"
    assert monitor_after(GOOD, GOOD).detail == ""


def test_pose_that_has_not_proved_itself_needs_a_better_fit():
    assert monitor_after(FAIR, FAIR).status == "none"
    assert monitor_after(GOOD, GOOD, FAIR, FAIR, FAIR).status == "good"


@pytest.mark.parametrize("fit", [WRONG, CONTRADICTED, OCCUPIED_ELSEWHERE, BLURRED, COVERED, VAGUE])
def test_pose_is_good_no_longer_than_the_newest_scan_confirms_it(fit):
    monitor = monitor_after(GOOD, GOOD, fit)
    assert monitor.status == "weak"
    monitor.add(GOOD, SURE)
    assert monitor.status == "weak"
    monitor.add(GOOD, SURE)
    assert monitor.status == "good"


def test_opened_door_leaves_a_pose_good_that_was_good_before_it():
    assert monitor_after(GOOD, GOOD, OPENED_DOOR).status == "good"
    assert monitor_after(GOOD, GOOD, BLURRED, OPENED_DOOR, OPENED_DOOR).status == "weak"


@pytest.mark.parametrize(
    ("fit", "expected"),
    [(GOOD, False), (CROWDED, False), (OPENED_DOOR, False), (COVERED, False), (CONTRADICTED, True), (WRONG, True),
     (Fit(agree=0.9, explained=0.9, contradict=0.0, informative=80, blurred=0.4), True)],
)  # fmt: skip
def test_doubt_is_cast_by_what_no_right_pose_shows(fit, expected):
    assert casts_doubt(fit) is expected


def test_walls_that_lie_beside_those_of_the_map_blur_the_scan():
    moved = Pose2(PLACE.x + 0.17, PLACE.y + 0.17, PLACE.theta)
    assert evaluate_fit(FIELDS, PLACE, points_at(PLACE), 12.0).blurred < 0.05
    assert evaluate_fit(FIELDS, moved, points_at(PLACE), 12.0).blurred > 0.5


def test_pose_that_is_a_little_off_blurs_no_scan_of_a_wide_hall():
    hall = map_fields(*grid_of([(0.5, 0.5, 16.5, 12.5), (3.0, 0.4, 3.6, 0.5)], 17.0, 13.0), LocalizationConfig())
    place = Pose2(8.0, 6.5, 0.3)
    off = Pose2(place.x + 0.05, place.y + 0.05, place.theta + math.radians(1.6))
    fit = evaluate_fit(hall, off, points_at(place, fields=hall), 12.0)
    assert fit.agree > 0.9
    assert fit.blurred < 0.15


def test_single_bad_scan_does_not_lose_the_pose_and_five_of_nine_do():
    assert monitor_after(GOOD, GOOD, WRONG).status == "weak"
    assert monitor_after(GOOD, GOOD, WRONG, WRONG, WRONG).status == "weak"
    assert monitor_after(GOOD, GOOD, *[WRONG] * 5).status == "lost"


def test_lasting_contradiction_loses_the_pose():
    assert monitor_after(GOOD, GOOD, *[CONTRADICTED] * 24).status == "weak"
    assert monitor_after(GOOD, GOOD, *[CONTRADICTED] * 25).status == "lost"


def test_doubtful_pose_is_weak_until_two_scans_fit_well():
    monitor = monitor_after(GOOD, GOOD)
    monitor.doubt("the encoders jumped")
    assert (monitor.status, monitor.detail) == ("weak", "the encoders jumped")
    monitor.add(FAIR, SURE)
    monitor.add(FAIR, SURE)
    assert monitor.status == "weak"
    monitor.add(GOOD, SURE)
    monitor.add(GOOD, SURE)
    assert (monitor.status, monitor.detail) == ("good", "")


def test_four_weak_scans_make_a_new_pose_weak_but_not_one_on_trial():
    assert monitor_after(*[VAGUE] * 3).status == "none"
    assert monitor_after(*[VAGUE] * 4).status == "weak"
    assert monitor_after(*[VAGUE] * 4, trial=8).status == "none"


def test_trial_ends_with_a_good_pose_or_fails_when_its_scans_are_used_up():
    passed = monitor_after(FAIR, GOOD, GOOD, *[WRONG] * 3, trial=5)
    assert not passed.trial_failed
    monitor = monitor_after(*[FAIR] * 4, trial=5)
    assert not monitor.trial_failed
    monitor.add(FAIR, SURE)
    assert monitor.trial_failed
    monitor.add(FAIR, SURE)
    assert not monitor.trial_failed


def test_lost_pose_stays_lost_while_the_map_is_searched():
    monitor = monitor_after(GOOD, GOOD, *[WRONG] * 5)
    monitor.begin_search()
    assert monitor.status == "lost"
    monitor.restart()
    monitor.add(GOOD, SURE)
    assert monitor.status == "lost"
    monitor.add(GOOD, SURE)
    assert monitor.status == "good"


@given(st.lists(st.sampled_from([GOOD, FAIR, VAGUE, BLURRED, CONTRADICTED, WRONG]), max_size=60))
def test_any_status_but_good_has_a_reason(fits):
    monitor = FitMonitor()
    for fit in fits:
        monitor.add(fit, SURE)
        assert bool(monitor.detail) == (monitor.status != "good")


def fit(agree: float, *, contradict: float = 0.0, blurred: float = 0.0) -> Fit:
    return Fit(agree, agree, contradict, 80, blurred)


def doubt_after(*agreements: float, step: float = 0.5) -> Doubt:
    doubt = Doubt()
    for number, agree in enumerate(agreements):
        doubt.add(fit(agree), Pose2(number * step, 0.0, 0.0), jumped=False)
    return doubt


def test_pose_that_scans_fit_alike_is_not_doubted():
    doubt = doubt_after(0.98, 0.95, 0.97, 0.93, 0.99)
    assert doubt.reason == ""
    assert not doubt.to_verify


def test_sudden_loss_of_agreement_makes_a_pose_suspect_until_the_beams_agree_again():
    assert "suddenly fewer beams" in doubt_after(0.98, 0.98, 0.8).reason
    assert doubt_after(0.98, 0.98, 0.8, 0.97).reason == ""


def test_slow_loss_of_agreement_is_a_crowd_that_gathers():
    assert doubt_after(*[1.0 - 0.02 * number for number in range(30)]).reason == ""


def test_lower_agreement_is_usual_after_a_drive():
    assert doubt_after(0.98, 0.98, *[0.7] * 4).reason
    assert doubt_after(0.98, 0.98, *[0.7] * 7).reason == ""


def test_share_that_verifies_no_pose_is_in_doubt_after_the_drive_on_which_it_would_become_usual():
    """A robot that was carried along a corridor sees half of its beams agree, and none pass through a wall."""
    doubt = doubt_after(0.98, 0.98, *[0.52] * 6)
    assert doubt.to_verify
    assert "other places may look like this one" in doubt.reason
    doubt.verify()
    assert doubt.reason == ""
    assert doubt_after(0.98, 0.98, *[0.52] * 100).to_verify, "half of a scan verifies nothing, however far it is driven"
    assert not doubt_after(0.98, 0.98, *[0.52] * 6, *[0.75] * 12).to_verify


def test_lower_agreement_is_usual_after_a_drive_in_a_small_room():
    doubt = doubt_after(0.98, 0.98)
    suspect = []
    for number in range(9):
        doubt.add(fit(0.7), Pose2(0.5 + 0.3 * (number % 2), 0.0, 0.0), jumped=False)
        suspect.append(bool(doubt.reason))
    assert suspect == [True] * 7 + [False] * 2


def test_robot_that_stands_stays_suspect_as_long_as_something_stands_before_it():
    assert doubt_after(0.98, 0.98, *[0.7] * 100, step=0.0).reason
    assert doubt_after(0.98, 0.98, *[0.7] * 100, 0.98, step=0.0).reason == ""


@pytest.mark.parametrize(
    ("newest", "jumped"), [(fit(0.9, contradict=0.2), False), (fit(0.9, blurred=0.4), False), (fit(0.95), True)]
)
def test_what_no_right_pose_shows_is_verified_on_the_whole_map_or_by_five_metres(newest, jumped):
    doubt = doubt_after(0.95)
    doubt.add(newest, Pose2(0.0, 0.0, 0.0), jumped=jumped)
    assert doubt.to_verify
    assert "other places may look like this one" in doubt.reason
    doubt.add(fit(0.95), Pose2(4.9, 0.0, 0.0), jumped=False)
    assert doubt.to_verify
    doubt.add(fit(0.95), Pose2(5.1, 0.0, 0.0), jumped=False)
    assert doubt.reason == ""


def test_drive_along_which_half_of_the_beams_agree_verifies_nothing():
    doubt = Doubt()
    doubt.begin(Pose2(0.0, 0.0, 0.0))
    for number in range(100):
        doubt.add(fit(0.5), Pose2(0.5 * number, 0.0, 0.0), jumped=False)
    assert doubt.to_verify
    doubt.verify()
    assert doubt.reason == ""


def test_another_pose_is_not_doubted_for_what_an_earlier_one_showed():
    doubt = doubt_after(0.98, 0.98, 0.6)
    doubt.begin(Pose2(0.0, 0.0, 0.0))
    doubt.restart()
    doubt.add(fit(0.6), Pose2(0.0, 0.0, 0.0), jumped=False)
    assert doubt.reason == ""


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=40), st.floats(0.71, 1.0))
def test_whatever_was_seen_a_drive_on_which_all_scans_fit_alike_ends_every_doubt(before, after):
    doubt = doubt_after(*before)
    for number in range(20):
        doubt.add(fit(after), Pose2(30.0 + 0.5 * number, 0.0, 0.0), jumped=number == 0)
    assert doubt.reason == ""


def test_no_drive_verifies_a_pose_while_other_places_explain_the_scans_as_well():
    doubt = Doubt()
    doubt.begin(Pose2(0.0, 0.0, 0.0))
    for number in range(20):
        doubt.add(fit(0.98), Pose2(0.5 * number, 0.0, 0.0), jumped=False, rivalled=True)
    assert doubt.to_verify
    for number in range(20, 32):
        doubt.add(fit(0.98), Pose2(0.5 * number, 0.0, 0.0), jumped=False)
    assert not doubt.to_verify
