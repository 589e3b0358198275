"""Which places a robot's free view reaches beyond, compared with a plain loop over the sectors of each."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fog_contracts.messages import REACH_UNIT_M, VIEW_SECTORS, View
from map_service.layers.obstacles import CELL_HALF_WIDTH_M, MARGIN_M, RANGE_M, sees_beyond


def expected(units: list[int], dx: float, dy: float) -> bool:
    distance, bearing = math.hypot(dx, dy), math.atan2(dy, dx)
    half = math.asin(CELL_HALF_WIDTH_M / distance)
    per_radian = VIEW_SECTORS / math.tau
    sectors = range(math.floor((bearing - half) * per_radian), math.floor((bearing + half) * per_radian) + 1)
    measured = [units[sector % VIEW_SECTORS] for sector in sectors if units[sector % VIEW_SECTORS] > 0]
    return bool(measured) and REACH_UNIT_M * min(measured) > distance + MARGIN_M


RUNS = st.lists(st.tuples(st.integers(1, 60), st.sampled_from([0, 20, 60, 255])), min_size=1, max_size=12)
PLACES = st.lists(st.tuples(st.floats(2.01 * CELL_HALF_WIDTH_M, RANGE_M), st.floats(-4.0, 4.0)), max_size=20)


@given(runs=RUNS, places=PLACES)
def test_view_reaches_beyond_a_place_in_every_measured_direction_or_not_at_all(runs, places):
    units = [unit for length, unit in runs for _ in range(length)]
    units = (units * VIEW_SECTORS)[:VIEW_SECTORS]
    offsets = [(distance * math.cos(bearing), distance * math.sin(bearing)) for distance, bearing in places]
    view = View(x=0.0, y=0.0, reach=bytes(units))
    found = sees_beyond(view, np.array(offsets).reshape(-1, 2))
    assert found.tolist() == [expected(units, dx, dy) for dx, dy in offsets]
