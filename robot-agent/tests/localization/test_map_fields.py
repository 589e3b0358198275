"""Tables over the static map: distances to the faces of walls, likelihoods, places where a robot fits."""

from __future__ import annotations

import numpy as np
import pytest
from little_world import L_ROOMS, grid_of

from fog_contracts.grid import GridGeometry
from robot_agent.config import LocalizationConfig
from robot_agent.localization.map_fields import map_fields

CONFIG = LocalizationConfig()
STATIC, GEOMETRY = grid_of(L_ROOMS, 15.0, 12.0)
FIELDS = map_fields(STATIC, GEOMETRY, CONFIG)


def test_inside_of_a_solid_block_attracts_no_beam():
    static = np.zeros((40, 40), np.uint8)
    static[10:30, 10:30] = 254
    fields = map_fields(static, GridGeometry(40, 40, 0.1, 0.0, 0.0), CONFIG)
    assert fields.wall_distance[10, 20] == 0.0
    assert fields.wall_distance[20, 20] == pytest.approx(0.9)
    assert fields.fine[20, 20] < 0.01 * fields.fine[10, 20]


def test_coarse_field_reaches_further_than_the_fine_one_and_neither_exceeds_the_best():
    assert (FIELDS.coarse >= FIELDS.fine - 1e-7).all()
    assert FIELDS.coarse.sum() > 1.5 * FIELDS.fine.sum()
    assert FIELDS.fine.max() == pytest.approx(FIELDS.best_likelihood)


def test_wall_distance_is_one_metre_off_the_map_and_far_from_walls():
    points = np.array([(-5.0, -5.0), (1e6, 0.0)])
    assert FIELDS.wall_distances(points).tolist() == [1.0, 1.0]
    assert FIELDS.wall_distance.max() <= 1.0


def test_free_places_are_free_and_clear_of_walls():
    assert len(FIELDS.free_places)
    assert (GEOMETRY.sample(STATIC, FIELDS.free_places, 255) == 0).all()
    assert FIELDS.wall_distances(FIELDS.free_places).min() >= 0.15 - 1e-6


def test_fields_match_only_their_own_map():
    assert FIELDS.matches(STATIC, GEOMETRY)
    other = STATIC.copy()
    other[50, 50] = 254 - other[50, 50]
    assert not FIELDS.matches(other, GEOMETRY)
    assert not FIELDS.matches(STATIC, GridGeometry(GEOMETRY.width, GEOMETRY.height, 0.1, 0.0, 0.0))
