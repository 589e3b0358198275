"""What `map check` finds in the cells of a map, and where."""

import math

import numpy as np
import pytest

from fog_contracts.costs import FREE, LETHAL, UNKNOWN
from fog_contracts.grid import GridGeometry, StaticMap
from fog_mapping.checking import check_cells
from fog_mapping.cleaning import clean, read

CELL = 0.05


def cells(low: float, high: float) -> slice:
    return slice(round(low / CELL), round(high / CELL))


def two_rooms(door: float) -> StaticMap:
    """Return two rooms of 4 x 4 m in 10 x 6 m; the door from (5, 3) upwards has a width."""
    grid = np.full((120, 200), UNKNOWN, np.uint8)
    grid[cells(0.9, 5.1), cells(0.9, 9.1)] = LETHAL
    grid[cells(1, 5), cells(1, 4.9)] = FREE
    grid[cells(1, 5), cells(5.1, 9)] = FREE
    grid[cells(3, 3 + door), cells(4.9, 5.1)] = FREE
    return StaticMap(GridGeometry(200, 120, CELL, 0.0, 0.0), grid)


def found(static: StaticMap, radius: float = 0.17) -> dict[str, tuple[tuple[float, float], ...]]:
    return {one.kind: tuple(one.places) for one in check_cells(static, radius)}


def test_two_rooms_with_a_wide_door_are_in_order():
    assert found(two_rooms(0.9)) == {}


def test_opening_that_is_too_narrow_for_the_robot_is_named_with_its_width_and_place():
    (one,) = check_cells(two_rooms(0.3), 0.17)
    assert one.kind == "narrow"
    assert one.places[0] == pytest.approx((5.0, 3.15), abs=0.2)
    assert "0.3" in one.text
    assert found(two_rooms(0.3), radius=0.1) == {}


def test_rooms_without_a_door_are_islands():
    places = found(two_rooms(0.0))["island"]
    assert len(places) == 1
    assert min(math.dist(places[0], room) for room in ((2.95, 3.0), (7.05, 3.0))) < 2.9


def test_hole_in_an_outer_wall_is_found_where_free_floor_leaks_through_it():
    static = two_rooms(0.9)
    static.cells[cells(0, 0.9), cells(6, 9)] = FREE
    static.cells[cells(0.9, 1), cells(7, 7.2)] = FREE
    (place,) = found(static)["leak"]
    assert place == pytest.approx((7.1, 0.95), abs=0.2)


def test_specks_on_free_floor_are_counted_and_a_leg_of_a_table_is_none():
    static = two_rooms(0.9)
    static.cells[40, 60] = static.cells[70, 150] = LETHAL
    static.cells[80:82, 80:82] = LETHAL
    (one,) = check_cells(static, 0.17)
    assert one.kind == "speckles"
    assert one.places == [pytest.approx(place, abs=0.01) for place in ((3.025, 2.025), (7.525, 3.525))]


def test_cleaning_by_the_words_that_are_found_leaves_nothing_to_find_and_changes_nothing_else():
    static = two_rooms(0.9)
    static.cells[40, 60] = static.cells[70, 150] = LETHAL
    static.cells[cells(5.2, 5.8), cells(1, 2)] = FREE
    assert set(found(static)) == {"island", "speckles"}
    cleaned = clean(read("speckles\nislands").commands, static).map
    assert np.array_equal(cleaned.cells, two_rooms(0.9).cells)


@pytest.mark.parametrize(("value", "name"), [(FREE, "free"), (LETHAL, "occupied"), (UNKNOWN, "unknown")])
def test_map_that_lacks_a_kind_of_cells_is_named(value, name):
    static = two_rooms(0.9)
    static.cells[static.cells == value] = LETHAL if value != LETHAL else UNKNOWN
    assert f"no-{name}" in found(static)
