"""Noise of single beams is averaged along a surface; what is thin or an edge moves by no more than noise, if at all."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_agent.localization.scans import SHIFT_MAX_M, smoothed


def test_noise_of_a_wall_shrinks_as_that_of_a_mean_of_three():
    rng = np.random.default_rng(1)
    wall = np.column_stack((np.arange(0.0, 20.0, 0.01), np.full(2000, 0.2)))
    noisy = wall + np.column_stack((np.zeros(2000), rng.normal(0.0, 0.01, 2000)))
    found = smoothed(noisy)[1:-1]
    assert found[:, 0] == pytest.approx(wall[1:-1, 0])
    assert found[:, 1].std() == pytest.approx(0.01 / math.sqrt(3.0), rel=0.1)
    assert found[:, 1].min() >= noisy[:, 1].min() + 0.9 * SHIFT_MAX_M


def test_each_point_is_the_mean_of_itself_and_its_neighbours_on_the_surface():
    points = np.array([(1.0, 0.0), (1.0, 0.02), (1.015, 0.04), (1.0, 0.2), (2.0, 0.2)])
    assert smoothed(points) == pytest.approx(
        np.array([(1.0, 0.01), (1.005, 0.02), points[2] + _within_limit(-0.0075, -0.01), (1.0, 0.2), (2.0, 0.2)])
    )


def _within_limit(x, y):
    return np.array([x, y]) * SHIFT_MAX_M / math.hypot(x, y)


def test_last_and_first_point_of_a_whole_turn_are_neighbours():
    ring = [(math.cos(angle), math.sin(angle)) for angle in np.arange(180) * math.tau / 180]
    found = smoothed(np.array(ring))
    assert np.hypot(*found.T) == pytest.approx(np.full(180, np.hypot(*found[7])))


def test_thin_leg_close_before_a_wall_does_not_vanish_into_the_wall():
    bearings = np.radians(np.arange(-20.0, 21.0))
    ranges = 0.40 / np.cos(bearings)
    ranges[20] = 0.355  # one beam meets a leg 4.5 cm before the wall; its neighbours, 7 mm apart, pass it
    scan = ranges[:, None] * np.column_stack((np.cos(bearings), np.sin(bearings)))
    assert smoothed(scan)[20, 0] <= 0.355 + SHIFT_MAX_M + 1e-12


PLACES = st.one_of(
    st.lists(st.tuples(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0)), max_size=20),
    st.lists(st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1)), max_size=20),
)
"""Scans, and such whose points are all near to one another."""


@given(PLACES, st.tuples(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0)))
def test_nearest_distance_grows_by_no_more_than_the_largest_shift(places, body):
    points = np.array(places, np.float64).reshape(-1, 2)
    nearest, raw = (np.hypot(*(seen - body).T).min(initial=math.inf) for seen in (smoothed(points), points))
    assert not nearest > raw + SHIFT_MAX_M + 1e-12


@given(PLACES)
def test_no_point_moves_by_more_than_noise_and_single_ones_stay(places):
    points = np.array(places, np.float64).reshape(-1, 2)
    moved = np.hypot(*(smoothed(points) - points).T)
    assert (moved <= SHIFT_MAX_M + 1e-12).all()
    for index, place in enumerate(places):
        if len(places) == 1 or all(
            math.dist(place, places[beside]) >= 0.06 for beside in (index - 1, (index + 1) % len(places))
        ):
            assert moved[index] == 0.0
