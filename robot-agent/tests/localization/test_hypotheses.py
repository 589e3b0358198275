"""Places that look alike are kept, moved with the odometry, and decided between by later scans."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from little_world import grid_of

from robot_agent.config import LocalizationConfig
from robot_agent.localization.hypotheses import Hypotheses, Hypothesis, Near, weighed
from robot_agent.localization.map_fields import map_fields
from robot_agent.localization.pose import Pose2
from robot_agent.localization.relocalization import Relocalization
from robot_agent.localization.scans import DeskewedScan

CONFIG = LocalizationConfig()
# Two equal rooms; only one of them has a niche behind its corner, which is seen from its upper half.
ROOMS = [(1, 1, 4, 5), (6, 1, 9, 5), (9, 4.2, 9.9, 5)]
FIELDS = map_fields(*grid_of(ROOMS, 11.0, 6.0), CONFIG)
ORIGIN = Pose2(0.0, 0.0, 0.0)
TRUE, TWIN = Pose2(7.2, 1.6, 1.2), Pose2(2.2, 1.6, 1.2)


def scan_at(pose: Pose2, odom: Pose2) -> DeskewedScan:
    angles = np.linspace(-math.pi, math.pi, 180, endpoint=False)
    ranges = FIELDS.ranges(pose.x, pose.y, angles + pose.theta, 12.0)
    hit = np.isfinite(ranges)
    return DeskewedScan(
        np.column_stack((ranges[hit] * np.cos(angles[hit]), ranges[hit] * np.sin(angles[hit]))), odom, 0.0
    )


def search(one: Relocalization) -> None:
    """Carry out the search to its end, a step for each part of the map and some more."""
    for _ in range(10_000):
        if not one.searching:
            return
        one.advance(FIELDS)
    raise AssertionError("the search has not ended after 10,000 steps")


def twins() -> Hypotheses:
    return Hypotheses([Hypothesis(TWIN, -0.1), Hypothesis(TRUE, -0.15)], ORIGIN)


def test_places_that_explain_a_scan_alike_leave_it_undecided_and_a_single_one_decides():
    assert twins().decided is None
    assert Hypotheses([Hypothesis(TRUE, -0.1), Hypothesis(TWIN, -0.9)], ORIGIN).decided == TRUE
    assert Hypotheses([Hypothesis(TRUE, -0.1)], ORIGIN).decided == TRUE
    assert Hypotheses([], ORIGIN).decided is None


def test_place_near_the_last_good_pose_is_excluded_only_by_what_explains_the_scans_far_better():
    """A wheel was held beside furniture, and the other end of the corridor explained the scans a little better."""
    near = Hypothesis(TRUE, -3.0, near=True)
    assert Hypotheses([Hypothesis(TWIN, -0.1), near], ORIGIN).decided is None
    assert Hypotheses([Hypothesis(TWIN, -0.1), near], ORIGIN).contenders[1] == near
    assert Hypotheses([Hypothesis(TWIN, -0.1), replace(near, log_quality=-4.0)], ORIGIN).decided == TWIN
    assert Hypotheses([Hypothesis(TWIN, -0.9), replace(near, log_quality=-0.1)], ORIGIN).decided == TRUE


def test_of_the_places_near_the_last_good_pose_only_those_are_left_that_explain_the_scans_nearly_as_well():
    near = [Hypothesis(Pose2(x, 1.6, 1.2), quality, near=True) for x, quality in ((7.2, -1.0), (8.2, -2.0))]
    assert Hypotheses([Hypothesis(TWIN, -0.1), *near], ORIGIN).contenders == [Hypothesis(TWIN, -0.1), near[0]]


def test_place_near_the_last_good_pose_counts_no_more_than_others_once_two_scans_do_not_confirm_it():
    here, odom = Pose2(7.2, 1.6, 1.2), ORIGIN
    place = Hypothesis(Pose2(7.2, 2.2, 1.2), -0.1, near=True)
    for near in (True, False):
        place = weighed(place, Pose2(7.2, 2.2, 1.2), scan_at(here, odom), FIELDS, 12.0)
        assert place.near is near


def test_places_that_no_scan_fits_any_more_are_looked_for_anew_near_the_last_good_pose():
    """A wheel that is held turns the robot unnoticed: the places that were followed by its wheels are all wrong."""
    one, near = Relocalization(CONFIG), Near(7.2, 1.6, 2.5)
    assert one.begin(scan_at(TRUE, ORIGIN), FIELDS, near)
    search(one)
    assert any(place.near for place in one.places)
    true, odom = Pose2(TRUE.x, TRUE.y, TRUE.theta - 1.2), Pose2(0.0, 0.0, 0.3)
    one.on_scan(scan_at(true, odom), FIELDS, near, shaken=True)
    search(one)
    assert any(place.near and math.dist(place.pose, true) < 0.15 for place in one.places)


def test_scans_from_one_spot_are_no_news():
    hypotheses = twins()
    before = hypotheses.places
    hypotheses.add(scan_at(TRUE, Pose2(0.05, 0.0, 0.05)), FIELDS, 12.0)
    assert hypotheses.places == before


def test_scans_along_a_drive_decide_for_the_place_that_explains_them():
    hypotheses, step = twins(), Pose2(0.3, 0.0, 0.05)
    true, odom = TRUE, ORIGIN
    for _ in range(8):
        true, odom = true.compose(step), odom.compose(step)
        hypotheses.add(scan_at(true, odom), FIELDS, 12.0)
        if hypotheses.decided is not None:
            break
    found = hypotheses.decided
    assert found is not None
    assert math.hypot(found.x - true.x, found.y - true.y) < 0.1


def test_twin_rooms_are_kept_as_hypotheses_by_a_search_until_the_drive_decides():
    one, step = Relocalization(CONFIG), Pose2(0.3, 0.0, 0.05)
    true, odom = TRUE, ORIGIN
    assert one.begin(scan_at(true, odom), FIELDS)
    search(one)
    first = one.outcome(0.0)
    assert first.pose is None
    assert "places of the map look like this one" in first.detail
    places = one.places
    for twin in (TRUE, TWIN):
        assert any(math.hypot(place.pose.x - twin.x, place.pose.y - twin.y) < 0.2 for place in places)
    for _ in range(8):
        true, odom = true.compose(step), odom.compose(step)
        one.on_scan(scan_at(true, odom), FIELDS)
        search(one)
        outcome = one.outcome(1.0)
        if outcome.pose is not None:
            break
    assert (outcome.pose.x, outcome.pose.y) == pytest.approx((true.x, true.y), abs=0.1)
    assert not one.active


@pytest.mark.parametrize("step", [0.07, 0.11, 0.21, 0.25])
def test_robot_that_turns_on_is_found_by_the_search_that_confirms_its_place(step):
    """Each scan does one share of the search. One that both ended it and counted let it begin anew, again and again."""
    one, true, odom = Relocalization(CONFIG), TRUE, ORIGIN
    assert one.begin(scan_at(true, odom), FIELDS)
    search(one)
    for _ in range(8):
        true, odom = true.compose(Pose2(0.3, 0.0, 0.05)), odom.compose(Pose2(0.3, 0.0, 0.05))
        one.on_scan(scan_at(true, odom), FIELDS)
        if one.searching:
            break
    assert "one place is left" in one.outcome(0.0).detail
    for _ in range(6):
        true, odom = true.compose(Pose2(0.0, 0.0, step)), odom.compose(Pose2(0.0, 0.0, step))
        one.on_scan(scan_at(true, odom), FIELDS)
        outcome = one.outcome(0.0)
        if outcome.pose is not None:
            break
    assert outcome.pose is not None
    found = outcome.pose.compose(odom.relative_to(outcome.odom))
    assert math.dist(found[:2], true[:2]) < 0.1
    assert math.remainder(found.theta - true.theta, math.tau) == pytest.approx(0.0, abs=0.05)


def test_single_place_that_the_last_scan_contradicts_is_not_called_several_that_look_alike(monkeypatch):
    one = Relocalization(CONFIG)
    monkeypatch.setattr(one, "_hypotheses", Hypotheses([Hypothesis(TRUE, -0.1, misfits=1)], ORIGIN))
    outcome = one.outcome(0.0)
    assert outcome.pose is None
    assert "the last scan does not confirm the only place of the map that is left" in outcome.detail
    assert "fognav robot turn" in outcome.detail


def test_search_without_any_place_may_begin_again_after_ten_seconds_or_from_another_spot():
    one = Relocalization(CONFIG)
    rng = np.random.default_rng(1)
    angles, ranges = rng.uniform(-math.pi, math.pi, 100), rng.uniform(5.0, 9.0, 100)
    assert one.begin(
        DeskewedScan(np.column_stack((ranges * np.cos(angles), ranges * np.sin(angles))), ORIGIN, 0.0), FIELDS
    )
    search(one)
    outcome = one.outcome(5.0)
    assert outcome.pose is None
    assert "fits no place" in outcome.detail
    assert not one.active
    assert not one.may_begin(14.9)
    assert one.may_begin(15.0)
    assert not one.may_begin(5.1, Pose2(0.45, 0.0, 0.45))
    assert one.may_begin(5.1, Pose2(0.4, -0.4, 0.0))
    assert one.may_begin(5.1, Pose2(0.0, 0.0, -0.55))
