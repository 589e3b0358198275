"""What the master costmap is: the layers' rules, versions that replicas can follow, and never a stale cell."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fog_contracts import channels as ch
from fog_contracts.costs import INSCRIBED, LETHAL, UNKNOWN
from fog_contracts.geometry import ShapeMask
from fog_contracts.grid import GridGeometry, Window
from fog_contracts.handlers import Moment, Publication, RefusedMessageError
from fog_contracts.messages import (
    VIEW_SECTORS,
    AreaDefinition,
    AreaHazard,
    Cause,
    CircleShape,
    CorridorShape,
    HazardArea,
    MapDelta,
    MapHeartbeat,
    Message,
    PolygonShape,
    RectangleShape,
    RobotObstacles,
    RobotPose,
    Trace,
    View,
    Zone,
    ZoneSet,
)
from fog_contracts.replica import Applied, Replica
from fog_contracts.shapes import ShapeError
from map_service.core import MapCore
from map_service.costmap import merged
from map_service.layers.base import CostLayer, write_cost
from map_service.layers.zones import penalty_cost
from map_service.registry import LayersError, make_layers
from map_service.zone_validation import ZoneError, validated_zone


@dataclass
class Plan:
    geometry: GridGeometry
    cells: np.ndarray


def floor(width: int = 80, height: int = 60, *, origin: tuple[float, float] = (-1.0, -0.5)) -> Plan:
    """A floor of 5 cm cells: free inside, a wall around it, a corner nobody knows."""
    cells = np.zeros((height, width), dtype=np.uint8)
    cells[[0, -1], :] = 254
    cells[:, [0, -1]] = 254
    cells[-8:, -8:] = 255
    return Plan(GridGeometry(width, height, 0.05, *origin), cells)


@dataclass
class Change:
    """What was published after an input, by channel."""

    deltas: list[MapDelta]
    hazards: list[HazardArea]
    zones: ZoneSet | None


class Rig:
    """A core that serves its map, fed through its table of handlers."""

    def __init__(self, plan: Plan) -> None:
        self.core = MapCore("test", plan, 3, layers=make_layers(plan))
        at = Moment(0.0, 0.0)
        self.core.load_zones([], at)
        self.core.on_broker(at, connected=True)
        self.core.on_aggregator("a1", at, alive=True)
        self.core.tick(at)
        self.map = self.core.costmap
        self.geometry = self.map.geometry

    @property
    def cost(self) -> np.ndarray:
        return self.map.cost

    @property
    def speed(self) -> np.ndarray:
        return self.map.speed

    def on_definition(self, definition: AreaDefinition, stamp: float) -> Change:
        return self._feed(ch.AREA_DEFINITION, definition, stamp, stamp, area=definition.id)

    def on_hazard(self, hazard: AreaHazard, stamp: float) -> Change:
        return self._feed(ch.AREA_HAZARD, hazard, stamp, stamp, area=hazard.area)

    def on_obstacles(self, robot: str, obstacles: RobotObstacles, now: float, stamp: float) -> Change:
        return self._feed(ch.ROBOT_OBSTACLES, obstacles, now, stamp, robot=robot)

    def on_pose(self, robot: str, at: RobotPose, now: float) -> Change:
        return self._feed(ch.ROBOT_POSE, at, now, now, robot=robot)

    def on_aggregator(self, *, present: bool, stamp: float) -> Change:
        changed = self.core.on_aggregator("a1", Moment(stamp, stamp), alive=present)
        # The broker tells nothing new, but by then the aggregator has been away for too long.
        return self._change([*changed, *self.core.on_broker(Moment(stamp + 3.1, stamp), connected=True)])

    def put_zone(self, zone: Zone, stamp: float) -> Change:
        return self._change(self.core.put_zone(zone, Moment(stamp, stamp)))

    def remove_zone(self, zone_id: str, stamp: float) -> Change:
        return self._change(self.core.remove_zone(zone_id, Moment(stamp, stamp)))

    def tick(self, now: float, stamp: float) -> Change:
        return self._change(self.core.tick(Moment(now, stamp)))

    def _feed(self, channel: ch.Channel, message: Message, now: float, stamp: float, **ids: str) -> Change:
        return self._change(self.core.handlers()[channel](ids, message, Moment(now, stamp)))

    @staticmethod
    def _change(publications: Sequence[Publication]) -> Change:
        messages = [publication.message for publication in publications]
        zones = [message for message in messages if isinstance(message, ZoneSet)]
        return Change(
            [message for message in messages if isinstance(message, MapDelta)],
            [message for message in messages if isinstance(message, HazardArea)],
            zones[-1] if zones else None,
        )


def core(plan: Plan | None = None) -> Rig:
    return Rig(plan or floor())


def definition(name: str = "hall", x: float = 0.5, y: float = 0.5, size: float = 0.5, **fields) -> AreaDefinition:
    ring = [(x, y), (x + size, y), (x + size, y + size), (x, y + size)]
    return AreaDefinition(id=name, polygon=ring, **fields)


def hazard(state: str, seq: int = 1, *, area: str = "hall", epoch: int = 1, penalty: int | None = None) -> AreaHazard:
    cost = {"blocked": 254, "unknown": 200, "clear": 0}[state] if penalty is None else penalty
    trace = Trace(area=area, epoch=epoch, seq=seq, first_reading=1.0, confirmed=2.0) if state == "blocked" else None
    return AreaHazard(
        area=area, state=state, severity=0, penalty=cost, since=0.0, seq=seq, epoch=epoch, cause="test", trace=trace
    )


def at(map_core: Rig, x: float, y: float) -> tuple[int, int]:
    column, row = map_core.geometry.cell(x, y)
    return int(map_core.cost[row, column]), int(map_core.speed[row, column])


def zone(name: str = "z1", kind: str = "BLOCKED", **fields) -> Zone:
    shape = fields.pop("shape", None) or CircleShape(centre=(1.0, 1.0), radius=0.3)
    return Zone(id=name, kind=kind, shape=shape, **fields)


def pose(x: float, y: float) -> RobotPose:
    return RobotPose(x=x, y=y, theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.17, height=0.35, stamp=0.0)


def seen(*points: tuple[float, float], ttl: float = 5.0, view: View | None = None) -> RobotObstacles:
    return RobotObstacles(points=list(points), stamp=0.0, ttl=ttl, view=view)


def looking(x: float, y: float, reach: float, towards: float = 0.0, width: float = math.tau) -> View:
    """A view from (x, y) that reaches so far (m) in the directions around `towards` (rad), and tells nothing else."""
    reach_cm = [0] * VIEW_SECTORS
    for sector in range(VIEW_SECTORS):
        middle = (sector + 0.5) * math.tau / VIEW_SECTORS
        if abs(math.remainder(middle - towards, math.tau)) <= width / 2:
            reach_cm[sector] = round(100 * reach)
    return View(x=x, y=y, reach_cm=reach_cm)


# --- Hazards --------------------------------------------------------------------------------------------------------


def test_a_defined_area_counts_as_unknown_until_the_aggregator_speaks():
    m = core()
    change = m.on_definition(definition(), 0.0)
    assert at(m, 0.75, 0.75) == (200, 15)
    assert change.hazards[0].hazard.state == "unknown"
    m.on_hazard(hazard("clear"), 0.0)
    assert at(m, 0.75, 0.75) == (0, 0)


def test_a_blocked_area_is_lethal_inflated_and_traced():
    m = core()
    m.on_definition(definition(), 0.0)
    m.on_hazard(hazard("clear", 1), 1.0)
    change = m.on_hazard(hazard("blocked", 2), 7.5)
    assert at(m, 0.75, 0.75)[0] == LETHAL
    assert at(m, 0.5 - 0.12, 0.75)[0] == INSCRIBED
    assert 0 < at(m, 0.5 - 0.3, 0.75)[0] < INSCRIBED
    (delta,) = [d for d in change.deltas if d.layer == "cost"]
    assert [(c.kind, c.id, c.state) for c in delta.causes] == [("hazard", "hall", "blocked")]
    assert delta.traces[0].costmap_published == 7.5
    assert delta.traces[0].confirmed == 2.0
    assert change.hazards[0].polygon == definition().polygon


def test_an_unknown_area_is_graded_not_inflated_and_slow():
    m = core()
    m.on_definition(definition(), 0.0)
    m.on_hazard(hazard("unknown"), 0.0)
    assert at(m, 0.75, 0.75) == (200, 15)
    assert at(m, 0.5 - 0.12, 0.75) == (0, 0)


def test_an_unknown_area_that_was_blocked_stays_lethal_and_becomes_slow():
    m = core()
    m.on_definition(definition(), 0.0)
    m.on_hazard(hazard("unknown", penalty=254), 0.0)
    assert at(m, 0.75, 0.75) == (254, 15)


def test_overtaken_hazards_are_ignored_and_a_new_epoch_counts():
    m = core()
    m.on_definition(definition(), 0.0)
    m.on_hazard(hazard("blocked", 5), 0.0)
    for late in (hazard("clear", 5), hazard("clear", 4), hazard("clear", 9, epoch=0)):
        assert m.on_hazard(late, 0.0).deltas == []
        assert at(m, 0.75, 0.75)[0] == LETHAL
    m.on_hazard(hazard("clear", 1, epoch=2), 0.0)
    assert at(m, 0.75, 0.75)[0] == 0
    m.on_hazard(hazard("blocked", 1, epoch=1), 0.0)
    assert at(m, 0.75, 0.75)[0] == LETHAL, "an old epoch may still raise the cost"


def test_a_hazard_before_its_definition_waits_for_it():
    m = core()
    assert m.on_hazard(hazard("blocked"), 0.0).hazards == []
    m.on_definition(definition(), 0.0)
    assert at(m, 0.75, 0.75)[0] == LETHAL


def test_an_area_that_moves_or_goes_leaves_nothing_behind():
    m = core()
    plain = m.cost.copy()
    m.on_definition(definition(version=1), 0.0)
    m.on_hazard(hazard("blocked"), 0.0)
    m.on_definition(definition(x=1.5, version=2), 0.0)
    assert at(m, 0.75, 0.75)[0] == 0
    assert at(m, 1.75, 0.75)[0] == LETHAL
    m.on_definition(definition(version=1), 0.0)
    assert at(m, 1.75, 0.75)[0] == LETHAL, "an older version must not come back"
    change = m.on_definition(definition(version=3, removed=True), 0.0)
    assert change.hazards[0].hazard.state == "clear"
    assert np.array_equal(m.cost, plain)


def test_without_its_aggregator_no_area_counts_as_clear():
    m = core()
    m.on_definition(definition(), 0.0)
    m.on_definition(definition("gate", x=1.5), 0.0)
    m.on_hazard(hazard("clear"), 0.0)
    m.on_hazard(hazard("blocked", area="gate"), 0.0)
    change = m.on_aggregator(present=False, stamp=1.0)
    assert at(m, 0.75, 0.75) == (200, 15)
    assert at(m, 1.75, 0.75)[0] == LETHAL
    assert [h.hazard.area for h in change.hazards] == ["hall"]
    m.on_aggregator(present=True, stamp=2.0)
    assert at(m, 0.75, 0.75) == (0, 0)


def test_an_area_whose_polygon_crosses_itself_is_refused_and_leaves_the_known_one():
    m = core()
    m.on_definition(definition(), 0.0)
    bowtie = AreaDefinition(id="hall", polygon=[(0.0, 0.0), (1.0, 1.0), (1.0, 0.0), (0.0, 1.0)], version=2)
    with pytest.raises(RefusedMessageError, match=r"area hall: .*crosses itself"):
        m.on_definition(bowtie, 0.0)
    assert at(m, 0.75, 0.75) == (200, 15)


# --- Layers ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("chosen", "words"),
    [
        (["hazards", "static", "zones"], r"layers\[0\]: 'static' has to be the first"),
        (["static", "zones"], "'hazards' has to be there once"),
        (["static", "hazards", "zones", "zones"], "'zones' has to be there once"),
        (["static", "hazards", "zones", "lava"], r"layers\[3\]: .*'lava' \(known: hazards, obstacles, static, zones"),
        (["static", "hazards", {"name": "zones", "depth": 3}], r"layers\[2\] \(zones\): depth: .*no such option"),
        (["static", "hazards", "zones", {"cost": 3}], r"layers\[3\]: "),
    ],
)
def test_layers_that_cannot_be_used_are_refused_by_entry(chosen, words):
    with pytest.raises(LayersError, match=words):
        make_layers(floor(), chosen)


class Spot(CostLayer):
    """Makes a cell dear once somebody has spoken on a channel that no layer of ours hears."""

    def __init__(self) -> None:
        super().__init__()
        self.cost = 0

    def handlers(self):
        return {ch.ROBOT_STATE: self.on_state, ch.ROBOT_POSE: self.on_state}

    def on_state(self, _ids, _message, _at):
        return self.set(90)

    def tick(self, at):
        return self.set(0) if at.now >= 10.0 else []

    def set(self, cost: int):
        self.cost = cost
        self.mark_updated(Window(40, 30, 1, 1), Cause(kind="map", id="spot", state=str(cost)))
        return []

    def update_costs(self, window, cost, _speed):
        write_cost(ShapeMask(Window(40, 30, 1, 1), np.ones((1, 1), dtype=bool)), window, cost, self.cost)


def test_a_layer_that_the_core_knows_nothing_of_listens_ticks_and_writes_costs():
    plan = floor()
    m = MapCore("test", plan, 3, layers=[*make_layers(plan), Spot()])
    m.load_zones([], moment(0.0))
    m.tick(moment(0.0))
    assert ch.ROBOT_STATE in m.handlers()
    (delta,) = m.handlers()[ch.ROBOT_POSE]({"robot": "r1"}, pose(9.0, 9.0), moment(1.0))
    assert (delta.channel, delta.message.causes[0].id, m.costmap.cost[30, 40]) == (ch.MAP_DELTA, "spot", 90)
    m.tick(moment(10.0))
    assert m.costmap.cost[30, 40] == 0


# --- Serving --------------------------------------------------------------------------------------------------------


def started(**arguments) -> MapCore:
    plan = floor()
    areas = [definition(), definition("gate", x=1.5)]
    return MapCore("test", plan, 3, layers=make_layers(plan), definitions=areas, **arguments)


def moment(now: float) -> Moment:
    return Moment(now, now)


def sent(publications: Sequence[Publication]) -> list[str]:
    return [publication.channel.name for publication in publications]


def test_nothing_is_published_before_the_zones_are_read():
    m = started()
    assert m.tick(moment(0.0)) == []
    assert m.handlers()[ch.AREA_HAZARD]({"area": "hall"}, hazard("blocked"), moment(0.1)) == []
    assert m.put_zone(zone(), moment(0.1)) == []
    assert m.tick(moment(100.0)) == []
    assert (m.serving, m.missing()) == (False, "the zones are not read yet")
    m.load_zones([zone("stored")], moment(100.1))
    first = m.tick(moment(100.2))
    assert m.serving
    assert (sent(first), m.missing()) == (["hazard", "hazard", "zones", "map_heartbeat"], "")
    assert [z.id for z in first[2].message.zones] == ["stored"]
    assert first[-1].message == MapHeartbeat(
        epoch=3, seq=m.costmap.version.seq, hash=m.costmap.version.hash, stamp=100.2
    )
    assert sent(m.tick(moment(100.3))) == ["map_heartbeat"]


def test_a_start_waits_for_the_hazards_of_all_areas_but_not_forever():
    patient, hasty = started(hazards_wait_s=3.0), started(hazards_wait_s=3.0)
    for m in (patient, hasty):
        m.load_zones([], moment(0.0))
        m.tick(moment(0.0))
        m.handlers()[ch.AREA_HAZARD]({"area": "hall"}, hazard("blocked"), moment(0.1))
        assert m.tick(moment(0.2)) == []
        assert m.missing() == "waiting for the hazards of gate"
    assert patient.tick(moment(2.9)) == []
    assert sent(patient.tick(moment(3.0)))[-1] == "map_heartbeat"
    hasty.handlers()[ch.AREA_HAZARD]({"area": "gate"}, hazard("clear", area="gate"), moment(0.3))
    assert sent(hasty.tick(moment(0.4)))[-1] == "map_heartbeat"


def test_queries_get_the_map_its_zones_and_one_areas_hazard():
    m = started()
    m.load_zones([zone()], moment(0.0))
    m.tick(moment(0.0))
    answers = m.query_handlers()
    assert answers[ch.MAP_SNAPSHOT]({}, None, moment(1.0)) is m.costmap.snapshot()
    assert [z.id for z in answers[ch.ZONES]({}, None, moment(1.0)).zones] == ["z1"]
    assert answers[ch.HAZARD]({"area": "gate"}, None, moment(1.0)).hazard.area == "gate"


@pytest.mark.parametrize("gone", ["aggregator", "broker", "both from the start"])
def test_areas_stop_counting_as_clear_three_seconds_after_the_aggregator_or_its_broker_is_gone(gone):
    m = started()
    m.load_zones([], moment(0.0))
    if gone != "both from the start":
        m.on_broker(moment(0.0), connected=True)
        m.on_aggregator("a1", moment(0.0), alive=True)
    m.tick(moment(0.0))
    m.handlers()[ch.AREA_HAZARD]({"area": "hall"}, hazard("clear"), moment(0.0))

    def state(now: float) -> str:
        m.tick(moment(now))
        return m.hazards()[0].hazard.state

    begin = 0.0
    if gone != "both from the start":
        begin = 10.0
        assert state(begin) == "clear"
    if gone == "aggregator":
        m.on_aggregator("a1", moment(begin), alive=False)
    elif gone == "broker":
        m.on_broker(moment(begin), connected=False)
    assert state(begin + 2.9) == "clear"
    assert state(begin + 3.1) == "unknown"
    back = [*m.on_broker(moment(begin + 4.0), connected=True), *m.on_aggregator("a1", moment(begin + 4.0), alive=True)]
    assert sent(back) == ["map_delta", "map_delta", "hazard"]
    assert state(begin + 4.1) == "clear"


def test_one_of_two_aggregators_is_enough():
    m = started()
    m.load_zones([], moment(0.0))
    m.on_broker(moment(0.0), connected=True)
    for name in ("a1", "a2"):
        m.on_aggregator(name, moment(0.0), alive=True)
    m.handlers()[ch.AREA_HAZARD]({"area": "hall"}, hazard("clear"), moment(0.0))
    m.on_aggregator("a1", moment(1.0), alive=False)
    m.tick(moment(9.0))
    assert m.hazards()[0].hazard.state == "clear"


def test_stored_zones_replace_those_on_the_map_or_nothing_changes():
    m = started()
    m.load_zones([zone("old"), zone("kept")], moment(0.0))
    bad = zone("bad", shape=RectangleShape(corner=(0.0, 0.0), opposite=(0.0, 1.0)))
    with pytest.raises(ShapeError, match=r"bad\.shape\.opposite"):
        m.load_zones([zone("new"), bad], moment(1.0))
    assert [z.id for z in m.zones()] == ["kept", "old"]
    m.load_zones([zone("new"), zone("kept")], moment(1.0))
    assert [z.id for z in m.zones()] == ["kept", "new"]


# --- Zones ----------------------------------------------------------------------------------------------------------


def test_kinds_write_cost_or_speed():
    m = core()
    m.put_zone(zone("a", "PENALTY", factor=2.0), 0.0)
    assert at(m, 1.0, 1.0) == (penalty_cost(2.0), 0)
    m.put_zone(zone("b", "SPEED_LIMIT", speed=0.2), 0.0)
    assert at(m, 1.0, 1.0) == (penalty_cost(2.0), 20)
    change = m.put_zone(zone("c", "BLOCKED"), 0.0)
    assert at(m, 1.0, 1.0) == (254, 20)
    assert [z.id for z in change.zones.zones] == ["a", "b", "c"]
    assert change.zones.seq == m.map.version.seq
    m.remove_zone("c", 0.0)
    assert at(m, 1.0, 1.0) == (penalty_cost(2.0), 20)


def test_a_penalty_of_factor_f_weighs_as_f_free_cells_for_the_planner():
    for factor in (1.0, 1.5, 2.0, 3.0, 5.0):
        assert 50 + 0.8 * penalty_cost(factor) == pytest.approx(50 * factor, abs=0.5)
    assert penalty_cost(100.0) == 252


def test_no_zone_lowers_a_cost_or_opens_the_unknown():
    m = core()
    plain = m.cost.copy()
    m.put_zone(zone("a", "PENALTY", factor=3.0, shape=RectangleShape(corner=(-5.0, -5.0), opposite=(9.0, 9.0))), 0.0)
    assert (m.cost >= plain).all()
    assert (m.cost[plain == UNKNOWN] == UNKNOWN).all()


def test_zones_begin_and_end_by_the_stamp():
    m = core()
    m.put_zone(zone(starts_at=10.0, expires_at=20.0), 0.0)
    for stamp, cost in ((9.9, 0), (10.0, 254), (19.9, 254), (20.0, 0)):
        m.tick(stamp, stamp)
        assert at(m, 1.0, 1.0)[0] == cost, stamp
    assert m.tick(21.0, 21.0).zones is None
    m.put_zone(zone(enabled=False), 0.0)
    assert at(m, 1.0, 1.0)[0] == 0


@pytest.mark.parametrize(
    ("bad", "field"),
    [
        (zone(shape=PolygonShape(points=[(0.0, 0.0), (1.0, 1.0), (1.0, 0.0), (0.0, 1.0)])), "shape.points"),
        (zone(shape=PolygonShape(points=[(0.0, 0.0), (1.0, 1.0), (0.0, 0.0)])), "shape.points"),
        (zone(shape=RectangleShape(corner=(0.0, 0.0), opposite=(0.0, 1.0))), "shape.opposite"),
        (zone(shape=CorridorShape(line=[(0.0, 0.0), (0.0, 0.0)], width=1.0)), "shape.line"),
        (zone(shape=CircleShape(centre=(50.0, 0.0), radius=1.0)), "shape"),
        (zone(kind="PENALTY"), "factor"),
        (zone(kind="SPEED_LIMIT"), "speed"),
        (zone(factor=2.0), "factor"),
        (zone(expires_at=5.0), "expires_at"),
        (zone(starts_at=20.0, expires_at=15.0), "expires_at"),
    ],
)
def test_a_zone_that_cannot_be_used_is_refused_by_field(bad, field):
    with pytest.raises(ZoneError) as caught:
        validated_zone(bad, floor().geometry, 10.0)
    assert caught.value.field == field


def test_a_polygon_is_stored_counter_clockwise():
    clockwise = [(0.5, 0.5), (0.5, 1.5), (1.5, 0.5)]
    stored = validated_zone(zone(shape=PolygonShape(points=clockwise)), floor().geometry, 0.0)
    assert stored.shape.points == clockwise[::-1]


# --- Obstacles ------------------------------------------------------------------------------------------------------


def test_a_seen_point_is_lethal_until_it_has_not_been_seen_for_its_time():
    m = core()
    plain = m.cost.copy()
    m.on_obstacles("r1", seen((1.0, 1.0)), 0.0, 0.0)
    assert at(m, 1.0, 1.0)[0] == LETHAL
    m.on_obstacles("r2", seen((1.0, 1.0)), 3.0, 3.0)
    m.tick(5.5, 5.5)
    assert at(m, 1.0, 1.0)[0] == LETHAL
    m.tick(8.0, 8.0)
    assert np.array_equal(m.cost, plain)


def test_points_on_a_robot_are_the_robot():
    m = core()
    plain = m.cost.copy()
    m.on_pose("r2", pose(1.0, 1.0), 0.0)
    m.on_obstacles("r1", seen((0.85, 1.0), (1.0, 1.17)), 0.5, 0.5)
    assert np.array_equal(m.cost, plain)
    m.on_obstacles("r1", seen((0.85, 1.0)), 5.0, 5.0)
    assert at(m, 0.85, 1.0)[0] == LETHAL, "a stale pose excuses nothing"
    m.on_pose("r2", pose(1.0, 1.0), 5.1)
    m.tick(5.1, 5.1)
    assert np.array_equal(m.cost, plain)


def test_a_thing_that_two_looks_reach_beyond_is_gone():
    m = core()
    plain = m.cost.copy()
    m.on_obstacles("r1", seen((1.0, 1.0), ttl=600.0), 0.0, 0.0)
    m.on_obstacles("r2", seen(view=looking(0.4, 1.0, 1.2)), 1.0, 1.0)
    assert at(m, 1.0, 1.0)[0] == LETHAL, "one look may have slipped past"
    m.on_obstacles("r1", seen(view=looking(1.0, 1.6, 1.2)), 2.0, 2.0)
    assert np.array_equal(m.cost, plain)


@pytest.mark.parametrize(
    ("view", "why"),
    [
        (looking(0.4, 1.0, 0.7), "the look ends at it"),
        (looking(0.4, 1.0, 0.3), "the look ends before it"),
        (looking(0.4, 1.0, 1.2, towards=math.pi, width=4.0), "the look goes elsewhere"),
    ],
)
def test_a_thing_that_no_look_reaches_beyond_stays(view, why):
    m = core()
    m.on_obstacles("r1", seen((1.0, 1.0), ttl=600.0), 0.0, 0.0)
    for now in range(1, 10):
        m.on_obstacles("r1", seen(view=view), float(now), float(now))
    assert at(m, 1.0, 1.0)[0] == LETHAL, why


def test_a_thing_that_is_seen_between_two_looks_beyond_it_stays():
    m = core()
    for now in range(10):
        points = [(1.0, 1.0)] if now % 2 == 0 else []
        m.on_obstacles("r1", seen(*points, ttl=600.0, view=looking(0.4, 1.0, 1.2)), float(now), float(now))
    assert at(m, 1.0, 1.0)[0] == LETHAL


def test_an_obstacle_that_goes_uncovers_the_zone_beneath():
    m = core()
    m.put_zone(zone(), 0.0)
    with_zone = m.cost.copy()
    m.on_obstacles("r1", seen((1.0, 1.0), (1.5, 1.0)), 0.0, 0.0)
    m.tick(6.0, 6.0)
    assert np.array_equal(m.cost, with_zone)


# --- Windows, versions ----------------------------------------------------------------------------------------------


def test_only_what_an_input_touches_travels():
    m = core(floor(400, 300))
    change = m.put_zone(zone(), 0.0)
    (delta,) = change.deltas
    assert delta.w * delta.h < 40 * 40
    assert m.put_zone(zone(), 0.0).deltas == []


@given(
    st.lists(
        st.tuples(st.integers(0, 40), st.integers(0, 40), st.integers(0, 12), st.integers(0, 12)).map(
            lambda w: Window(*w)
        ),
        max_size=12,
    )
)
@settings(deadline=None)
def test_merged_windows_are_apart_and_cover_the_same(windows):
    result = merged(windows)
    count = np.zeros((60, 60), dtype=int)
    for window in result:
        count[window.rows, window.columns] += 1
    assert count.max(initial=0) <= 1
    for window in windows:
        assert (count[window.rows, window.columns] == 1).all()


coordinate = st.floats(-1.5, 3.5).map(lambda v: round(v, 2))
point = st.tuples(coordinate, coordinate)
shapes = st.one_of(
    st.builds(lambda c, r: CircleShape(centre=c, radius=r), point, st.floats(0.05, 1.0)),
    st.builds(lambda a, b, w: CorridorShape(line=[a, b], width=w), point, point, st.floats(0.05, 0.8)),
    st.builds(
        lambda a, w, h: RectangleShape(corner=a, opposite=(a[0] + w, a[1] + h)),
        point,
        st.floats(0.1, 2),
        st.floats(0.1, 2),
    ),
)
zones = st.builds(
    lambda name, shape, kind, start, life: Zone(
        id=name,
        shape=shape,
        kind=kind,
        factor=3.0 if kind == "PENALTY" else None,
        speed=0.25 if kind == "SPEED_LIMIT" else None,
        starts_at=start,
        expires_at=start + life,
    ),
    st.sampled_from(["z1", "z2", "z3"]),
    shapes,
    st.sampled_from(["BLOCKED", "PENALTY", "SPEED_LIMIT"]),
    st.floats(0, 30),
    st.floats(1, 30),
)
areas = st.sampled_from(["hall", "gate"])
events = st.one_of(
    st.tuples(st.just("zone"), zones),
    st.tuples(st.just("unzone"), st.sampled_from(["z1", "z2", "z3"])),
    st.tuples(st.just("define"), areas, coordinate, coordinate, st.floats(0.1, 1.5), st.booleans()),
    st.tuples(st.just("hazard"), areas, st.sampled_from(["blocked", "unknown", "clear"]), st.integers(0, 254)),
    st.tuples(st.just("see"), st.lists(point, max_size=8), st.floats(0.5, 10)),
    st.tuples(st.just("look"), point, st.floats(0.0, 3.0)),
    st.tuples(st.just("pose"), point),
    st.tuples(st.just("watched"), st.booleans()),
    st.tuples(st.just("wait"), st.floats(0.1, 10)),
)


def play(m: Rig, history: list[tuple]) -> list[MapDelta]:
    now, deltas = 0.0, []
    for seq, (kind, *rest) in enumerate(history, start=1):
        if kind == "zone":
            change = m.put_zone(rest[0], now)
        elif kind == "unzone":
            change = m.remove_zone(rest[0], now)
        elif kind == "define":
            change = m.on_definition(definition(*rest[:4], version=seq, removed=rest[4]), now)
        elif kind == "hazard":
            change = m.on_hazard(hazard(rest[1], seq, area=rest[0], penalty=rest[2]), now)
        elif kind == "see":
            change = m.on_obstacles("r1", seen(*rest[0], ttl=rest[1]), now, now)
        elif kind == "look":
            change = m.on_obstacles("r1", seen(view=looking(*rest[0], rest[1])), now, now)
        elif kind == "pose":
            deltas += m.on_pose("r2", pose(*rest[0]), now).deltas
            change = m.tick(now, now)
        elif kind == "watched":
            change = m.on_aggregator(present=rest[0], stamp=now)
        else:
            now += rest[0]
            change = m.tick(now, now)
        deltas += change.deltas
    return deltas


@given(st.lists(events, max_size=25))
@settings(max_examples=150, deadline=None)
def test_after_any_history_the_map_equals_a_full_recompute_and_its_replica(history):
    m = core()
    replica = Replica()
    replica.load(m.map.snapshot())
    for delta in play(m, history):
        outcome = replica.apply(delta)
        assert outcome == "waiting" or isinstance(outcome, Applied)
    cost, speed = m.map.recomputed()
    assert np.array_equal(m.cost, cost)
    assert np.array_equal(m.speed, speed)
    assert not replica.needs_snapshot
    assert replica.version == m.map.version
    assert np.array_equal(replica.cost, cost)
    assert np.array_equal(replica.speed, speed)


@given(st.lists(events, max_size=15))
@settings(max_examples=50, deadline=None)
def test_what_is_gone_leaves_the_plain_floor(history):
    m = core()
    plain = m.cost.copy()
    play(m, history)
    for name in ("z1", "z2", "z3"):
        m.remove_zone(name, 1e6)
    for name in ("hall", "gate"):
        m.on_definition(definition(name, version=10_000, removed=True), 1e6)
    m.tick(1e6, 1e6)
    assert np.array_equal(m.cost, plain)
    assert not m.speed.any()
