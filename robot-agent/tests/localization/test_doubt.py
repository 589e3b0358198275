"""Doubt in a pose that scans fit: what casts it, and what ends it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_agent.localization.doubt import Doubt
from robot_agent.localization.fit import Fit
from robot_agent.localization.pose import Pose2


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
