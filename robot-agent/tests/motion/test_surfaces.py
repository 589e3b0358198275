"""Noise of single beams is averaged along a surface; what is thin, alone or an edge stays where it is."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_agent.motion.surfaces import smoothed


def test_noise_of_a_wall_shrinks_as_that_of_a_mean_of_three():
    rng = np.random.default_rng(1)
    wall = np.column_stack((np.arange(0.0, 20.0, 0.01), np.full(2000, 0.2)))
    noisy = wall + np.column_stack((np.zeros(2000), rng.normal(0.0, 0.01, 2000)))
    found = smoothed(noisy)[1:-1]
    assert found[:, 0] == pytest.approx(wall[1:-1, 0])
    assert found[:, 1].std() == pytest.approx(0.01 / math.sqrt(3.0), rel=0.1)
    assert found[:, 1].min() > noisy[:, 1].min() + 0.01


def test_each_point_is_the_mean_of_itself_and_its_neighbours_on_the_surface():
    points = np.array([(1.0, 0.0), (1.0, 0.05), (1.03, 0.1), (1.0, 0.2), (2.0, 0.2)])
    assert smoothed(points) == pytest.approx(
        np.array([(1.0, 0.025), (1.01, 0.05), (1.015, 0.075), (1.0, 0.2), (2.0, 0.2)])
    )


def test_last_and_first_point_of_a_whole_turn_are_neighbours():
    ring = [(math.cos(angle), math.sin(angle)) for angle in np.arange(180) * math.tau / 180]
    found = smoothed(np.array(ring))
    assert np.hypot(*found.T) == pytest.approx(np.full(180, np.hypot(*found[7])))


@given(st.lists(st.tuples(st.floats(-5.0, 5.0), st.floats(-5.0, 5.0)), max_size=20))
def test_no_point_moves_by_more_than_the_distance_of_neighbours_and_single_ones_stay(places):
    points = np.array(places, np.float64).reshape(-1, 2)
    moved = np.hypot(*(smoothed(points) - points).T)
    assert (moved <= 0.06).all()
    for index, place in enumerate(places):
        if len(places) == 1 or all(
            math.dist(place, places[beside]) >= 0.06 for beside in (index - 1, (index + 1) % len(places))
        ):
            assert moved[index] == 0.0
