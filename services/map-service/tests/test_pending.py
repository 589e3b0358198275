"""Large changes reach the map in portions, completely, and without holding up small ones."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fog_contracts import channels as ch
from fog_contracts.grid import GridGeometry, StaticMap, Window
from fog_contracts.handlers import Moment
from fog_contracts.messages import (
    AreaDefinition,
    AreaHazard,
    Cause,
    CorridorShape,
    MapDelta,
    PolygonShape,
    RectangleShape,
    Zone,
    ZoneSet,
)
from fog_contracts.replica import Applied, Replica
from map_service.core import COMMIT_CELLS, MapCore
from map_service.costmap import TILE, PendingUpdates
from map_service.layers.base import UpdatedBounds
from map_service.registry import make_layers
from map_service.zones import MAX_COVERAGE, MAX_ZONES, ZoneError, check_room, prepare_zone

GEOMETRY = GridGeometry(500, 300, 0.05, 0.0, 0.0)
windows = st.builds(
    lambda x, y, w, h: GEOMETRY.clip(Window(x, y, w, h)),
    st.integers(0, 480), st.integers(0, 280), st.integers(1, 500), st.integers(1, 300),
)  # fmt: skip


@settings(deadline=None)
@given(st.lists(st.lists(windows, max_size=80), min_size=1, max_size=4), st.integers(TILE * TILE, 90_000))
def test_portions_are_limited_and_cover_every_window_with_its_cause(batches, cells):
    pending = PendingUpdates(GEOMETRY)
    changed, done = (np.zeros(GEOMETRY.shape, dtype=bool) for _ in range(2))
    named = set()
    for number, batch in enumerate([*batches, *([[]] * 200)]):
        bounds = [UpdatedBounds(w, Cause(kind="zone", id=f"{number}-{i}", state="")) for i, w in enumerate(batch)]
        for window in batch:
            changed[window.rows, window.columns] = True
            done[window.rows, window.columns] = False
        portion = pending.take(bounds, cells)
        # Windows that overlap are merged, so exact ones may hold cells besides.
        assert sum(w.width * w.height for w in portion.windows) <= cells or len(batch) > 1
        named |= {b.cause.id for b in portion.bounds}
        for window in portion.windows:
            done[window.rows, window.columns] = True
        if number >= len(batches) and not pending.waiting:
            break
    assert not pending.waiting
    assert done[changed].all()
    assert named == {f"{n}-{i}" for n, batch in enumerate(batches) for i in range(len(batch))}


def floor(width: int, height: int) -> StaticMap:
    cells = np.zeros((height, width), dtype=np.uint8)
    cells[[0, -1], :] = 254
    cells[:, [0, -1]] = 254
    return StaticMap(GridGeometry(width, height, 0.05, 0.0, 0.0), cells)


def serving_core(plan: StaticMap) -> MapCore:
    core = MapCore("test", plan, 3, layers=make_layers(plan))
    core.load_zones([], Moment(0.0, 0.0))
    core.tick(Moment(0.0, 0.0))
    return core


def area_hazard(state: str, penalty: int) -> AreaHazard:
    return AreaHazard(
        area="hall", state=state, severity=3, penalty=penalty, since=0, seq=penalty, epoch=1, cause="test"
    )


def messages(publications, kind):
    return [p.message for p in publications if isinstance(p.message, kind)]


def test_hazard_is_on_the_map_before_the_rest_of_a_zone_over_the_whole_floor():
    plan = floor(1600, 1100)
    core = serving_core(plan)
    replica = Replica()
    replica.load(core.costmap.snapshot())
    ring = [(60.0, 50.0), (61.0, 50.0), (61.0, 51.0), (60.0, 51.0)]
    at = Moment(1.0, 1.0)
    handlers = core.handlers()
    first = handlers[ch.AREA_DEFINITION]({"area": "hall"}, AreaDefinition(id="hall", polygon=ring), at)
    whole = RectangleShape(corner=(0.0, 0.0), opposite=(80.0, 55.0))
    first += core.put_zone(Zone(id="all", kind="PENALTY", factor=2.0, shape=whole), at)
    assert core.pending
    assert not messages(first, ZoneSet)
    second = handlers[ch.AREA_HAZARD]({"area": "hall"}, area_hazard("blocked", 254), at)
    column, row = plan.geometry.cell(60.5, 50.5)
    assert core.costmap.cost[row, column] == 254
    assert core.costmap.cost[plan.geometry.height - 30, 100] == 0, "the zone's last rows wait"
    published = [*first, *second]
    portions = 0
    while core.pending:
        portion = core.continue_commit(at)
        published += portion
        portions += 1
        rewritten = sum(delta.w * delta.h for delta in messages(portion, MapDelta) if delta.layer == "cost")
        assert rewritten <= 1.2 * COMMIT_CELLS, "with the inflation around the portion"
    assert portions >= 2
    assert len(messages(published, ZoneSet)) == 1
    applied = [replica.apply(delta) for delta in messages(published, MapDelta)]
    assert isinstance(applied[-1], Applied)
    assert replica.version == core.costmap.version
    cost, speed = core.costmap.recompute()
    assert np.array_equal(core.costmap.cost, cost)
    assert np.array_equal(core.costmap.speed, speed)


def test_thousands_of_stored_zones_make_one_version():
    plan = floor(800, 600)
    core = MapCore("test", plan, 3, layers=make_layers(plan))
    corners = [(number % 76 / 2, number // 76 / 3) for number in range(2_000)]
    shapes = [RectangleShape(corner=(x, y), opposite=(x + 1.5, y + 2.0)) for x, y in corners]
    zones = [
        Zone(id=f"z{number}", kind="PENALTY", factor=1.1 + number % 30 / 10, shape=shape)
        for number, shape in enumerate(shapes)
    ]
    before = core.costmap.version.seq
    core.load_zones(zones, Moment(0.0, 0.0))
    assert core.costmap.version.seq == before + 1
    assert not core.pending
    cost, _ = core.costmap.recompute()
    assert np.array_equal(core.costmap.cost, cost)
    assert messages(core.tick(Moment(0.0, 0.0)), ZoneSet)[0].zones == sorted(zones, key=lambda zone: zone.id)


def test_many_changed_zones_are_published_at_most_twice_a_second_and_the_last_change_always():
    plan = floor(100, 100)
    core = serving_core(plan)
    published = []
    for number in range(300):
        shape = RectangleShape(corner=(1.0, 1.0), opposite=(2.0, 2.0))
        at = Moment(1.0 + number / 1000, 1.0)
        published += messages(core.put_zone(Zone(id=f"z{number}", kind="BLOCKED", shape=shape), at), ZoneSet)
    assert [len(zones.zones) for zones in published] == [*range(1, 201)]
    assert messages(core.tick(Moment(1.4, 1.0)), ZoneSet) == []
    assert len(messages(core.tick(Moment(2.0, 1.0)), ZoneSet)[0].zones) == 300
    assert messages(core.tick(Moment(3.0, 1.0)), ZoneSet) == []


@pytest.mark.parametrize(
    ("shape", "field"),
    [
        (CorridorShape(line=[(1.0 + i % 2 * 90, 1.0 + i % 2 * 58) for i in range(499)], width=0.3), "shape.line"),
        (
            PolygonShape(points=[*((0.2 * i, 59.0 if i % 2 else 2.0) for i in range(498)), (99.4, 1.0), (0.0, 1.0)]),
            "shape.points",
        ),
    ],
)
def test_shape_with_too_long_an_outline_is_refused_with_the_remedy(shape, field):
    geometry = GridGeometry(2000, 1200, 0.05, 0.0, 0.0)
    with pytest.raises(ZoneError, match="draw fewer or shorter sides") as caught:
        prepare_zone(Zone(id="z", kind="BLOCKED", shape=shape), geometry, 0.0)
    assert caught.value.field == field


def test_zone_beyond_the_number_of_zones_or_their_area_is_refused():
    shape = RectangleShape(corner=(0.0, 0.0), opposite=(25.0, 15.0))
    prepared = prepare_zone(Zone(id="z", kind="BLOCKED", shape=shape), GEOMETRY, 0.0)
    floor_cells = GEOMETRY.width * GEOMETRY.height
    check_room(prepared, MAX_ZONES - 1, (MAX_COVERAGE - 1) * floor_cells, GEOMETRY)
    with pytest.raises(ZoneError, match="5000 zones already"):
        check_room(prepared, 5_000, 0, GEOMETRY)
    with pytest.raises(ZoneError, match="more than 64 times"):
        check_room(prepared, 1, 63 * floor_cells + 1, GEOMETRY)
