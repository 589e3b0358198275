"""Commands that clean a map: what each does, lines that can't be used, and the same again on a new recording."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from small_floors import OFFICE, floor

from fog_contracts.costs import FREE, LETHAL, UNKNOWN
from fog_contracts.grid import StaticMap
from fog_contracts.resampling import resampled
from fog_mapping.alignment import MisfitError
from fog_mapping.cleaning import Command, CommandError, clean, fingerprint, read, wall_angle


def cleaned(text: str, static: StaticMap = OFFICE, first: StaticMap | None = None) -> StaticMap:
    return clean(read(text).commands, static, first).map


def at(static: StaticMap, *points: tuple[float, float]) -> list[int]:
    return static.geometry.sample(static.cells, np.array(points), UNKNOWN).tolist()


def test_each_command_changes_what_it_says_and_nothing_else():
    assert at(OFFICE, (3.5, 0.9), (7.0, 2.0), (13.0, 2.0)) == [LETHAL, FREE, FREE]
    assert at(cleaned("erase 3 0 4 0.95"), (3.5, 0.9), (3.5, 0.97), (3.5, 0.5)) == [FREE, LETHAL, UNKNOWN]
    assert at(cleaned("block 6.5 1.5 7.5 2.5"), (7.0, 2.0), (6.0, 2.0)) == [LETHAL, FREE]
    assert at(cleaned("free 8 6 8 5 7 5"), (7.7, 5.2), (7.3, 5.8)) == [FREE, UNKNOWN]
    assert at(cleaned("unknown 12 1 14 1 14 3 12 3"), (13.0, 2.0), (11.9, 2.0)) == [UNKNOWN, FREE]
    cropped = cleaned("crop 1 1 7 6")
    assert cropped.geometry.bounds == pytest.approx((1, 1, 7, 6))
    assert at(cropped, (2.0, 2.0)) == [FREE]
    assert cleaned("freeze 0 0 5 5").cells.tolist() == OFFICE.cells.tolist()


@pytest.mark.parametrize("way", ["5 1 5 3", "5 1 7.3 3", "5 1 5.1 1.9 4.2 3"])
def test_no_step_leads_through_a_drawn_wall(way):
    drawn = cleaned(f"wall {way}\nblock 5 2.8 6 3.4")
    labels, _ = ndimage.label(drawn.cells == FREE, np.ones((3, 3)))
    left, right = (labels[drawn.geometry.cell(x, 2.0)[::-1]] for x in (4.0, 10.0))
    assert left != right


@pytest.mark.parametrize("turned", [3.2, -7.0, 30.0])
def test_straightened_map_has_its_walls_along_the_axes(turned):
    crooked = resampled(OFFICE, math.radians(turned))
    assert math.degrees(wall_angle(crooked)) == pytest.approx(turned, abs=0.1)
    assert abs(math.degrees(wall_angle(cleaned("straighten", crooked)))) < 0.1
    # Turned twice, long walls have steps of a cell.
    assert abs(math.degrees(wall_angle(cleaned(f"straighten {turned}", crooked)))) < 0.25


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("erase 1 2 3 4\nbrush 1 2", 2, "'brush' is no command. Use one of straighten, crop"),
        ("\n# note\nerase 1 2 3", 3, "4 numbers, not 3. Write: erase left bottom right top"),
        ("erase 4 2 3 4", 1, "empty: left and bottom come first"),
        ("wall 1 2 three 4", 1, "are not all numbers"),
        ("wall 1 2 3", 1, "no 2 points or more"),
        ("erase 1 2 nan 4", 1, "a number is none"),
        ("free 0 0 1 1", 1, "no 3 points or more"),
        ("free 0 0 1 1 1 0 0 1", 1, "the polygon is none"),
        ("straighten 1 2", 1, "2 numbers, and at most 1 is of use"),
        ("speckles 1", 1, "at most 0 is of use. Write: speckles"),
        ("erase 1 2 3 4\nmap a.yaml 0123", 2, "named once, before all"),
        ("crop 1 1 7 6\nerase 8 8 9 9", 2, "meets no cell of the map, which reaches from (1.00, 1.00) to (7.00, 6.00)"),
    ],
)
def test_line_that_can_not_be_used_is_named_with_its_number_and_the_remedy(text, line, words):
    with pytest.raises(CommandError) as refused:
        cleaned(text)
    assert str(refused.value).startswith(f"line {line}: ")
    assert words in str(refused.value)


COMMANDS = "straighten\nblock 6.5 1.5 7.5 2.5\nfreeze 8 4 13 9\nwall 3 1 3 3\ncrop 0.5 0.5 14.5 9.5\n"


@pytest.mark.parametrize("yaw", [0.0, 0.4, -2.0])
def test_new_recording_in_another_frame_gets_the_same_commands_in_the_first_ones_frame(yaw):
    """A cupboard has come, which the commands don't know, and a room is shut that is frozen open."""
    changed = floor(
        (1, 1, 14, 3), (1, 1, 3, 9), (4, 3.2, 7, 6), (5, 2.8, 6, 3.4), boxes=((11, 1, 12, 1.6),)
    )  # fmt: skip
    recorded = resampled(changed, yaw, (-20.0, 7.0))
    again, before = cleaned(COMMANDS, recorded, OFFICE), cleaned(COMMANDS)
    assert again.geometry.bounds == pytest.approx(before.geometry.bounds)
    assert again.cells.shape == before.cells.shape
    places = ((7.0, 2.0), (3.0, 2.0), (10.0, 6.0), (2.0, 5.0), (11.5, 1.5))
    assert at(before, *places) == [LETHAL, LETHAL, FREE, FREE, FREE]
    assert at(again, *places) == [LETHAL, LETHAL, FREE, FREE, LETHAL]


def test_recording_of_another_floor_is_refused():
    with pytest.raises(MisfitError):
        cleaned(COMMANDS, floor((1, 1, 6, 9), (8, 1, 10, 9), (5, 4, 9, 4.8)), OFFICE)


numbers = st.floats(0.5, 9.0).map(lambda value: round(value, 2))
rectangles = st.tuples(numbers, numbers, st.floats(0.1, 3.0), st.floats(0.1, 3.0)).map(
    lambda r: (r[0], r[1], r[0] + r[2], r[1] + r[3])
)
boxed = st.builds(Command, st.just(1), st.sampled_from(["erase", "block", "freeze"]), rectangles)
walls = st.builds(Command, st.just(1), st.just("wall"), st.tuples(numbers, numbers, numbers, numbers))
polygons = st.builds(
    lambda word, r: Command(1, word, (r[0], r[1], r[2], r[1], r[2], r[3])),
    st.sampled_from(["free", "unknown"]),
    rectangles,
)


@settings(max_examples=30, deadline=None)
@given(commands=st.lists(st.one_of(boxed, walls, polygons), max_size=5))
def test_same_commands_give_the_same_cells_and_a_second_time_changes_nothing(commands):
    drawing = [one for one in commands if one.word != "freeze"]
    text = "\n".join(map(str, drawing))
    assert [one._replace(line=1) for one in read(text).commands] == [
        one._replace(numbers=tuple(float(f"{value:g}") for value in one.numbers)) for one in drawing
    ]
    once, again = cleaned(text), cleaned(text)
    assert fingerprint(once) == fingerprint(again)
    assert fingerprint(cleaned(text, once)) == fingerprint(once)
    replayed = clean(commands, OFFICE, OFFICE)
    assert np.array_equal(replayed.map.cells, clean(commands, OFFICE).map.cells)
