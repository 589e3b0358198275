"""Dead ends: what is left out is on no cheapest path between places outside of them, and they are worth finding."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
from compiler import COMPILED, examples, guard_kernels
from hypothesis import given, settings
from hypothesis import strategies as st
from shortest_paths import cell_of, dijkstra, floors

from fog_kernels import components
from fog_kernels import dead_ends as module
from fog_kernels.dead_ends import NEAR_GATE, DeadEnds
from fog_kernels.steps import DEFAULT_WEIGHTS, SEALED

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fog_kernels.dead_ends import SealedEnds

    Cell = tuple[int, int]

guard_kernels(module)
guard_kernels(components)


def raise_some(costmap: NDArray[np.uint8], data: st.DataObject) -> NDArray[np.uint8]:
    """Return the costmap with rectangles of higher costs."""
    raised = costmap.copy()
    for _ in range(data.draw(st.integers(0, 2))):
        x, y = cell_of(data, costmap)
        patch = raised[y : y + data.draw(st.integers(1, 4)), x : x + data.draw(st.integers(1, 4))]
        np.maximum(patch, data.draw(st.sampled_from([30, 200, 254])), out=patch)
    return raised


def flat(cells: list[Cell], width: int) -> NDArray[np.int32]:
    return np.array([row * width + column for column, row in cells], np.int32)


def sealed_cells(sealed: SealedEnds, costmap: NDArray[np.uint8]) -> NDArray[np.bool_]:
    label = np.zeros(costmap.size, np.int32)
    sealed.paint(label)
    return label.reshape(costmap.shape) == SEALED


@settings(max_examples=examples(120), deadline=None)
@given(floors(), st.data())
def test_no_path_between_places_outside_gets_cheaper_through_what_is_sealed(
    bound: NDArray[np.uint8], data: st.DataObject
) -> None:
    costmap = raise_some(bound, data)
    raised = np.flatnonzero((costmap > bound).ravel()).astype(np.int32)
    places = [cell_of(data, bound) for _ in range(data.draw(st.integers(0, 3)))]
    sealed = DeadEnds(bound, DEFAULT_WEIGHTS).seal(costmap, raised, flat(places, bound.shape[1]))
    left_out = sealed_cells(sealed, costmap)
    inside = {cell for cell in np.ndindex(costmap.shape[::-1]) if sealed.contains(cell)}
    label = np.zeros(costmap.size, np.int32)
    sealed.paint(label)
    assert {(int(x), int(y)) for y, x in np.argwhere(label.reshape(costmap.shape) != 0)} == inside
    assert set(label[~left_out.ravel()].tolist()) <= {0, NEAR_GATE}
    assert not inside.intersection(places)
    assert sealed.hold(costmap)
    later = raise_some(costmap, data)
    starts = [*places, cell_of(data, bound), cell_of(data, bound)]
    for now in (costmap, later) if sealed.hold(later) else (costmap,):
        without = np.where(left_out, np.uint8(254), now)
        for start in starts:
            if start in inside:
                continue
            everywhere = {cell: cost for cell, cost in dijkstra(now, start).items() if cell not in inside}
            assert {cell: cost for cell, cost in dijkstra(without, start).items() if cell not in inside} == everywhere


def room_beside_a_corridor(*, turned: bool) -> NDArray[np.uint8]:
    """Two corridors that form a ring, and a room of 20 x 20 cells behind a door of 3 cells; not turned, above them."""
    costmap = np.full((40, 30), 254, np.uint8)
    costmap[1:12, 1:29] = 0
    costmap[5:8, 5:25] = 254
    costmap[12, 10:13] = 0
    costmap[13:33, 5:25] = 0
    return np.ascontiguousarray(costmap.T) if turned else costmap


@pytest.mark.parametrize("turned", [False, True])
def test_a_room_behind_a_door_is_left_out_but_for_what_is_beside_the_door(*, turned: bool) -> None:
    costmap = room_beside_a_corridor(turned=turned)
    places = [cell[:: -1 if turned else 1] for cell in ((2, 2), (27, 10))]
    sealed = DeadEnds(costmap, DEFAULT_WEIGHTS).seal(costmap, np.empty(0, np.int32), flat(places, costmap.shape[1]))
    left_out = sealed_cells(sealed, costmap)
    left_out = left_out.T if turned else left_out
    assert left_out[14:33, 5:25].all()  # one row is as far as a way from one end of the door to the other may lead
    assert not left_out[13, 8:15].any()
    assert not left_out[:13].any()
    assert sealed.contains((8, 13)[:: -1 if turned else 1])
    assert not sealed.contains((2, 2))


@pytest.mark.parametrize("turned", [False, True])
def test_a_room_with_a_place_in_it_is_not_left_out(*, turned: bool) -> None:
    costmap = room_beside_a_corridor(turned=turned)
    place = (15, 30)[:: -1 if turned else 1]
    sealed = DeadEnds(costmap, DEFAULT_WEIGHTS).seal(
        costmap, np.empty(0, np.int32), flat([place, (2, 2)], costmap.shape[1])
    )
    assert not sealed_cells(sealed, costmap)[place[::-1]]
    assert not sealed.contains(place)


def test_a_room_is_not_left_out_once_its_door_is_raised() -> None:
    bound = room_beside_a_corridor(turned=False)
    dead_ends, nothing = DeadEnds(bound, DEFAULT_WEIGHTS), np.empty(0, np.int32)
    places = flat([(2, 2), (27, 10)], bound.shape[1])
    sealed = dead_ends.seal(bound, nothing, places)
    elsewhere, door = bound.copy(), bound.copy()
    elsewhere[2:4, 2:4] = elsewhere[30, 20] = door[12, 11] = 254
    assert sealed.hold(elsewhere)
    assert not sealed.hold(door)
    raised = flat([(11, 12)], bound.shape[1])
    assert not sealed_cells(dead_ends.seal(door, raised, places), door)[14, 8:15].any()


def test_a_costmap_of_another_shape_is_refused() -> None:
    dead_ends, nothing = DeadEnds(np.zeros((4, 5), np.uint8), DEFAULT_WEIGHTS), np.empty(0, np.int32)
    with pytest.raises(ValueError, match="shape"):
        dead_ends.seal(np.zeros((5, 4), np.uint8), nothing, nothing)


@pytest.mark.skipif(not COMPILED, reason="too slow without the compiler")
def test_a_long_chain_of_rooms_takes_no_recursion() -> None:
    costmap = np.full((5, 20_001), 254, np.uint8)
    costmap[1:4] = 0
    costmap[1::2, ::4] = 254
    sealed = DeadEnds(costmap, DEFAULT_WEIGHTS).seal(
        costmap, np.empty(0, np.int32), flat([(1, 2), (9, 2)], costmap.shape[1])
    )
    left_out = sealed_cells(sealed, costmap)
    assert left_out[2, 100:].all()
    assert not left_out[2, :9].any()
