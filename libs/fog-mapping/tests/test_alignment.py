"""Maps that are laid onto others: right to a fraction of a cell, or refused."""

import math

import numpy as np
import pytest
from small_floors import OFFICE, floor

from fog_contracts.costs import FREE, UNKNOWN
from fog_contracts.grid import GridGeometry, StaticMap
from fog_contracts.resampling import resampled
from fog_mapping.alignment import MisfitError, align, laid_onto
from fog_mapping.poses import place


@pytest.mark.parametrize("yaw", [0.0, 0.31, 2.5, -1.57])
def test_map_in_another_frame_is_found_and_laid_onto_the_cells_of_the_first(yaw):
    other = resampled(OFFICE, yaw, (-6.0, 30.0))
    found = align(other, OFFICE)
    back = place(np.array(found.pose), np.array(((-6.0, 30.0),)))[0]
    assert np.abs(back).max() < 0.03
    assert math.remainder(found.pose[2] + yaw, math.tau) == pytest.approx(0.0, abs=0.003)
    laid = laid_onto(other, OFFICE, found.pose)
    walls = OFFICE.geometry.centres(np.argwhere(OFFICE.cells == FREE)[:, ::-1])
    assert (laid.geometry.sample(laid.cells, walls, UNKNOWN) == FREE).mean() > 0.93
    assert (laid.geometry.origin_x / 0.05) % 1.0 == pytest.approx(0.0, abs=1e-6) or (
        laid.geometry.origin_x / 0.05
    ) % 1.0 == pytest.approx(1.0, abs=1e-6)


def test_part_of_a_floor_is_found_in_the_whole_of_it():
    part = StaticMap(GridGeometry(150, 200, 0.05, 3.0, 4.0), np.ascontiguousarray(OFFICE.cells[:, :150]))
    assert align(part, OFFICE).pose == pytest.approx((-3.0, -4.0, 0.0), abs=0.02)


def test_another_floor_is_refused_with_what_did_not_fit():
    with pytest.raises(MisfitError, match=r"do not fit: .* of the walls lie on each other"):
        align(floor((1, 1, 6, 9), (8, 1, 10, 9), (5, 4, 9, 4.8)), OFFICE)


def test_room_that_looks_alike_from_both_ends_is_refused():
    with pytest.raises(MisfitError, match="fit in two ways"):
        align(floor((2, 2, 12, 6)), floor((3, 3, 13, 7)))
