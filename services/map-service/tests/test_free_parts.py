"""Which cells of a blocked area are free: never one that no outline covers, nor without a living aggregator."""

import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from msgspec import structs

from fog_contracts import channels as ch
from fog_contracts.costs import DEGRADED_SPEED, LETHAL
from fog_contracts.geometry import contains_point
from fog_contracts.grid import GridGeometry, StaticMap, Window
from fog_contracts.handlers import Moment
from fog_contracts.messages import AggregatorHeartbeat, AreaDefinition, AreaHazard, hazards_digest
from fog_contracts.shapes import rasterize
from map_service.layers.free_parts import free_cells
from map_service.layers.hazards import HazardsLayer

GEOMETRY = GridGeometry(80, 60, 0.05, 0.0, 0.0)
SQUARE = [(0.5, 0.5), (2.5, 0.5), (2.5, 2.5), (0.5, 2.5)]
LOWER = [(0.3, 0.4), (2.7, 0.4), (2.7, 1.3), (0.3, 1.3)]
NARROW = [(0.3, 1.6), (2.7, 1.6), (2.7, 1.9), (0.3, 1.9)]
WINDOW = Window(0, 0, 80, 60)
FLOOR = StaticMap(GEOMETRY, np.zeros(GEOMETRY.shape, np.uint8))
WALLED = StaticMap(GEOMETRY, np.zeros(GEOMETRY.shape, np.uint8))
"""With a wall along the area's lower side."""
WALLED.cells[:10] = 254


def cone(x: float, y: float, theta: float, reach: float) -> list[tuple[float, float]]:
    angles = np.linspace(theta - 0.13, theta + 0.13, 9)
    return [(x, y), *((x + reach * math.cos(a), y + reach * math.sin(a)) for a in angles)]


outlines = st.lists(
    st.builds(cone, st.floats(0.0, 4.0), st.floats(0.0, 3.0), st.floats(-math.pi, math.pi), st.floats(0.3, 3.5))
    | st.lists(st.tuples(st.floats(0.0, 4.0), st.floats(0.0, 3.0)), min_size=3, max_size=6),
    max_size=4,
)


@settings(deadline=None, max_examples=60)
@given(rings=outlines, width=st.floats(0.2, 0.8), static=st.sampled_from([FLOOR, WALLED]))
@example(rings=[LOWER, NARROW], width=0.5, static=WALLED)
@example(rings=[[(0.0, 0.0), (0.0, 0.0), (2.0, 2.2250738585072014e-308)]], width=0.5, static=FLOOR)
def test_no_cell_is_free_that_no_outline_covers_or_where_the_strip_is_too_narrow(rings, width, static):
    area = rasterize(SQUARE, GEOMETRY)
    free = free_cells(area, rings, width, static)
    assert not (free & ~area.mask).any()
    covered = np.zeros_like(free)
    for row, column in zip(*np.nonzero(area.mask), strict=True):
        x, y = (area.window.x + column) * 0.05, (area.window.y + row) * 0.05
        corners = [(x + dx, y + dy) for dx in (0.001, 0.049) for dy in (0.001, 0.049)]
        covered[row, column] = any(all(contains_point(ring, *corner) for corner in corners) for ring in rings)
    assert not (free & ~covered).any()
    passable = np.pad(static.cells == 0, 40)
    inside = passable[40 + area.window.y :, 40 + area.window.x :][: area.window.height, : area.window.width]
    inside[...] = np.where(area.mask, covered, inside)
    reach = width / 2.0 / 0.05
    disc = [(j, i) for j in range(-8, 9) for i in range(-8, 9) if i * i + j * j <= reach * reach]
    for row, column in zip(*np.nonzero(free), strict=True):
        centres = ((row + area.window.y + 40 + j, column + area.window.x + 40 + i) for j, i in disc)
        assert any(all(passable[r + j, c + i] for j, i in disc) for r, c in centres), "no robot fits there"


class Fog:
    """A layer with one area, and an aggregator's messages; heartbeats come every 0.2 s."""

    def __init__(self, free_width: float | None = 0.5, static: StaticMap = FLOOR) -> None:
        self.layer = HazardsLayer(static)
        self.now = 100.0
        self.layer.define(AreaDefinition(id="hall", polygon=SQUARE, free_width=free_width), self.at)

    @property
    def at(self) -> Moment:
        return Moment(self.now, self.now + 1e6)

    def hear(self, seq: int, *free: list[tuple[float, float]], state: str = "blocked") -> AreaHazard:
        penalty = {"blocked": LETHAL, "clear": 0}[state]
        hazard = AreaHazard(
            area="hall", state=state, severity=0, penalty=penalty, since=0, seq=seq, epoch=5, cause="", free=list(free)
        )
        self.layer.handlers()[ch.AREA_HAZARD]({"area": "hall"}, hazard, self.at)
        return hazard

    def run(self, seconds: float, *announced: AreaHazard) -> None:
        for _ in range(round(seconds / 0.2)):
            self.now += 0.2
            if announced:
                beat = AggregatorHeartbeat(
                    epoch=5, areas={h.area: h.seq for h in announced}, complete=True, stamp=0.0,
                    digest=hazards_digest(announced), uptime=self.now,
                )  # fmt: skip
                self.layer.handlers()[ch.AGGREGATOR_HEARTBEAT]({}, beat, self.at)
            self.layer.tick(self.at)

    def at_height(self, y: float) -> tuple[int, int]:
        """Return cost and speed limit in the middle of the area, so high (m)."""
        cost, speed = np.zeros(GEOMETRY.shape, np.uint8), np.zeros(GEOMETRY.shape, np.uint8)
        self.layer.update_costs(WINDOW, cost, speed)
        return int(cost[int(y / 0.05), 30]), int(speed[int(y / 0.05), 30])


SLOW, CLOSED = (0, DEGRADED_SPEED), (LETHAL, 0)


def test_free_part_is_slow_and_the_rest_closed_while_the_aggregator_confirms_it():
    fog = Fog()
    blocked = fog.hear(1)
    fog.run(1.0, blocked)
    assert fog.at_height(0.9) == CLOSED
    freed = fog.hear(2, LOWER)
    assert fog.at_height(0.9) == CLOSED, "a relief waits for the heartbeat that lists it"
    fog.run(0.2, freed)
    assert (fog.at_height(0.9), fog.at_height(1.5)) == (SLOW, CLOSED)
    fog.run(2.0)
    assert fog.at_height(0.9) == CLOSED, "no aggregator lives"
    assert fog.layer.hazard("hall").hazard.free == [], "nor is it told to anybody"


def test_part_that_is_not_free_any_more_is_closed_at_once():
    fog = Fog()
    fog.run(1.0, fog.hear(1))
    fog.run(0.4, fog.hear(2, LOWER))
    assert fog.at_height(0.9) == SLOW
    fog.hear(3)
    assert fog.at_height(0.9) == CLOSED


def test_area_that_is_blocked_with_a_free_part_is_closed_before_that_is_confirmed():
    fog = Fog()
    fog.run(1.0, fog.hear(1, state="clear"))
    assert fog.at_height(0.9) == (0, 0)
    freed = fog.hear(3, LOWER)
    assert (fog.at_height(0.9), fog.at_height(1.5)) == (CLOSED, CLOSED)
    fog.run(0.4, freed)
    assert (fog.at_height(0.9), fog.at_height(1.5)) == (SLOW, CLOSED)


@pytest.mark.parametrize(("free_width", "part"), [(None, LOWER), (0.5, NARROW), (1.0, LOWER)])
def test_whole_area_is_closed_without_a_width_and_where_the_part_is_narrower(free_width, part):
    fog = Fog(free_width, WALLED)
    fog.run(1.0, fog.hear(1))
    fog.run(0.4, fog.hear(2, part))
    assert {fog.at_height(y) for y in (0.6, 0.9, 1.5, 1.75, 2.4)} == {CLOSED}


def test_area_that_is_defined_anew_has_the_free_part_of_its_new_polygon():
    fog = Fog()
    fog.run(1.0, fog.hear(1))
    freed = fog.hear(2, LOWER)
    fog.run(0.4, freed)
    wider = [(0.5, 0.5), (2.5, 0.5), (2.5, 2.8), (0.5, 2.8)]
    fog.layer.define(AreaDefinition(id="hall", polygon=wider, free_width=0.5, version=1), fog.at)
    fog.run(0.2, freed)
    assert (fog.at_height(0.9), fog.at_height(1.5), fog.at_height(2.7)) == (SLOW, CLOSED, CLOSED)


def test_dangers_and_free_parts_are_part_of_what_the_digest_covers():
    hazard = Fog().hear(1, LOWER)
    assert hazards_digest([hazard]) != hazards_digest([structs.replace(hazard, free=[])])
