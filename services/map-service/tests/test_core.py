"""The master costmap: the rules of its layers, versions that replicas can follow, and no outdated cell."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fog_contracts import channels as ch
from fog_contracts.costs import INSCRIBED, LETHAL, UNKNOWN, penalty_cost
from fog_contracts.grid import GridGeometry, Window
from fog_contracts.handlers import Moment, Publication, RefusedMessageError
from fog_contracts.messages import (
    REACH_UNIT_M,
    VIEW_SECTORS,
    AggregatorHeartbeat,
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
    hazards_digest,
)
from fog_contracts.replica import Applied, Replica
from fog_contracts.shapes import ShapeError, ShapeMask
from map_service.aggregator_monitor import TRUSTED_AFTER_S
from map_service.core import MapCore
from map_service.costmap import merge_overlapping
from map_service.layers.base import CostLayer, write_cost
from map_service.layers.obstacles import BEYOND_M, CELL_HALF_WIDTH_M, MARGIN_M, MAX_OF_ROBOT, RANGE_M
from map_service.registry import LayersError, make_layers
from map_service.zones import ZoneError, list_size, prepare_zone


@dataclass
class Plan:
    geometry: GridGeometry
    cells: np.ndarray


def floor_plan(width: int = 80, height: int = 60, *, origin: tuple[float, float] = (-1.0, -0.5)) -> Plan:
    """Return a plan of 5 cm cells: free inside, a wall around it, an unknown corner."""
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


AGE_S = ch.AGGREGATOR_HEARTBEAT.max_age_s
FAR = (-4.0, -4.0)
"""Beside the little floor plan, but within sight of all of it."""


class LivingAggregator:
    """An aggregator that has announced some hazards and confirms them."""

    def __init__(self, core: MapCore, epoch: int = 1) -> None:
        self.core = core
        self.epoch = epoch
        self.announced: dict[str, AreaHazard] = {}

    def heartbeat(self, stamp: float, *, areas: dict[str, int] | None = None, complete: bool = False):
        listed = {name: h.seq for name, h in self.announced.items()} if areas is None else areas
        return AggregatorHeartbeat(
            epoch=self.epoch, areas=listed, complete=complete, digest=hazards_digest(self.announced.values()),
            uptime=stamp + 1e5, stamp=stamp,
        )  # fmt: skip

    def send(self, heartbeat: AggregatorHeartbeat, now: float) -> list[Publication]:
        return list(self.core.handlers()[ch.AGGREGATOR_HEARTBEAT]({}, heartbeat, Moment(now, now)))

    def announce(self, hazard: AreaHazard, stamp: float) -> list[Publication]:
        self.announced[hazard.area] = hazard
        return self.beat(stamp)

    def beat(self, stamp: float) -> list[Publication]:
        """Send heartbeats up to `stamp` for as long as it takes to be trusted."""
        sent = [self.send(self.heartbeat(stamp - TRUSTED_AFTER_S + i * 0.125), stamp - TRUSTED_AFTER_S + i * 0.125)
                for i in range(5)]  # fmt: skip
        return [publication for publications in sent for publication in publications]


class Rig:
    """A core that serves its map and gets messages through its handlers."""

    def __init__(self, plan: Plan) -> None:
        self.core = MapCore("test", plan, 3, layers=make_layers(plan))
        at = Moment(0.0, 0.0)
        self.core.load_zones([], at)
        self.core.tick(at)
        self.aggregator = LivingAggregator(self.core)
        self.map = self.core.costmap
        self.geometry = self.map.geometry

    @property
    def cost(self) -> np.ndarray:
        return self.map.cost

    @property
    def speed(self) -> np.ndarray:
        return self.map.speed

    def on_definition(self, definition: AreaDefinition, stamp: float) -> Change:
        return self._deliver(ch.AREA_DEFINITION, definition, stamp, stamp, area=definition.id)

    def receive(self, hazard: AreaHazard, stamp: float) -> Change:
        """Deliver a hazard that no heartbeat confirms."""
        return self._deliver(ch.AREA_HAZARD, hazard, stamp, stamp, area=hazard.area)

    def on_hazard(self, hazard: AreaHazard, stamp: float) -> Change:
        """Deliver a hazard that the living aggregator announces, and heartbeats that confirm it."""
        published = self.core.handlers()[ch.AREA_HAZARD]({"area": hazard.area}, hazard, Moment(stamp, stamp))
        return self._change([*published, *self.aggregator.announce(hazard, stamp)])

    def on_obstacles(
        self, robot: str, obstacles: RobotObstacles, now: float, stamp: float, at: tuple[float, float] | None = None
    ) -> Change:
        """Deliver a report of a robot that stands `at`: where its view is, or else 1 m right of its first point."""
        if at is None and obstacles.view is not None:
            at = obstacles.view.x, obstacles.view.y
        elif at is None:
            at = obstacles.points[0][0] + 1.0, obstacles.points[0][1]
        placed = self.on_pose(robot, pose(*at), now)
        change = self._deliver(ch.ROBOT_OBSTACLES, obstacles, now, stamp, robot=robot)
        return Change(placed.deltas + change.deltas, placed.hazards + change.hazards, change.zones or placed.zones)

    def on_pose(self, robot: str, pose: RobotPose, now: float) -> Change:
        return self._deliver(ch.ROBOT_POSE, pose, now, now, robot=robot)

    def on_aggregator(self, *, present: bool, stamp: float) -> Change:
        if present:
            return self._change(self.aggregator.beat(stamp))
        return self.tick(stamp + AGE_S + 0.1, stamp)

    def put_zone(self, zone: Zone, stamp: float) -> Change:
        return self._change(self.core.put_zone(zone, Moment(stamp, stamp)))

    def remove_zone(self, zone_id: str, stamp: float) -> Change:
        return self._change(self.core.remove_zone(zone_id, Moment(stamp, stamp)))

    def tick(self, now: float, stamp: float) -> Change:
        return self._change(self.core.tick(Moment(now, stamp)))

    def _deliver(self, channel: ch.Channel, message: Message, now: float, stamp: float, **ids: str) -> Change:
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


def make_rig(plan: Plan | None = None) -> Rig:
    return Rig(plan or floor_plan())


def definition(name: str = "hall", x: float = 0.5, y: float = 0.5, size: float = 0.5, **fields) -> AreaDefinition:
    ring = [(x, y), (x + size, y), (x + size, y + size), (x, y + size)]
    return AreaDefinition(id=name, polygon=ring, **fields)


def hazard(state: str, seq: int = 1, *, area: str = "hall", epoch: int = 1, penalty: int | None = None) -> AreaHazard:
    cost = {"blocked": 254, "unknown": 200, "clear": 0}[state] if penalty is None else penalty
    trace = Trace(area=area, epoch=epoch, seq=seq, first_reading=1.0, confirmed=2.0) if state == "blocked" else None
    return AreaHazard(
        area=area, state=state, severity=0, penalty=cost, since=0.0, seq=seq, epoch=epoch, cause="test", trace=trace
    )


def cost_and_speed(rig: Rig, x: float, y: float) -> tuple[int, int]:
    column, row = rig.geometry.cell(x, y)
    return int(rig.cost[row, column]), int(rig.speed[row, column])


def zone(name: str = "z1", kind: str = "BLOCKED", **fields) -> Zone:
    shape = fields.pop("shape", None) or CircleShape(centre=(1.0, 1.0), radius=0.3)
    return Zone(id=name, kind=kind, shape=shape, **fields)


def pose(x: float, y: float) -> RobotPose:
    return RobotPose(x=x, y=y, theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.17, height=0.35, stamp=0.0)


def obstacles(*points: tuple[float, float], ttl: float = 5.0, view: View | None = None) -> RobotObstacles:
    return RobotObstacles(points=list(points), stamp=0.0, ttl=ttl, view=view)


def view_from(x: float, y: float, reach: float, towards: float = 0.0, width: float = math.tau) -> View:
    """Return a view from (x, y) that reaches `reach` (m) in the `width` (rad) around `towards` (rad) only."""
    units = [0] * VIEW_SECTORS
    for sector in range(VIEW_SECTORS):
        middle = (sector + 0.5) * math.tau / VIEW_SECTORS
        if abs(math.remainder(middle - towards, math.tau)) <= width / 2:
            units[sector] = min(255, int(reach / REACH_UNIT_M + 1e-9))
    return View(x=x, y=y, reach=bytes(units))


# --- Hazards --------------------------------------------------------------------------------------------------------


def test_area_is_unknown_until_its_hazard_is_received():
    rig = make_rig()
    change = rig.on_definition(definition(), 0.0)
    assert cost_and_speed(rig, 0.75, 0.75) == (200, 15)
    assert change.hazards[0].hazard.state == "unknown"
    rig.on_hazard(hazard("clear"), 0.0)
    assert cost_and_speed(rig, 0.75, 0.75) == (0, 0)


def test_blocked_area_is_lethal_inflated_and_traced():
    rig = make_rig()
    rig.on_definition(definition(), 0.0)
    rig.on_hazard(hazard("clear", 1), 1.0)
    change = rig.on_hazard(hazard("blocked", 2), 7.5)
    assert cost_and_speed(rig, 0.75, 0.75)[0] == LETHAL
    assert cost_and_speed(rig, 0.5 - 0.12, 0.75)[0] == INSCRIBED
    assert 0 < cost_and_speed(rig, 0.5 - 0.3, 0.75)[0] < INSCRIBED
    (delta,) = [d for d in change.deltas if d.layer == "cost"]
    assert [(c.kind, c.id, c.state) for c in delta.causes] == [("hazard", "hall", "blocked")]
    assert delta.traces[0].costmap_published == 7.5
    assert delta.traces[0].confirmed == 2.0
    assert change.hazards[0].polygon == definition().polygon


def test_unknown_area_has_a_graded_cost_and_a_speed_limit_and_is_not_inflated():
    rig = make_rig()
    rig.on_definition(definition(), 0.0)
    rig.on_hazard(hazard("unknown"), 0.0)
    assert cost_and_speed(rig, 0.75, 0.75) == (200, 15)
    assert cost_and_speed(rig, 0.5 - 0.12, 0.75) == (0, 0)


def test_unknown_area_that_was_blocked_stays_lethal_and_gets_a_speed_limit():
    rig = make_rig()
    rig.on_definition(definition(), 0.0)
    rig.on_hazard(hazard("unknown", penalty=254), 0.0)
    assert cost_and_speed(rig, 0.75, 0.75) == (254, 15)


def test_outdated_hazards_are_ignored_and_one_of_a_new_epoch_is_applied():
    rig = make_rig()
    rig.on_definition(definition(), 0.0)
    rig.on_hazard(hazard("blocked", 5), 0.0)
    for late in (hazard("clear", 5), hazard("clear", 4)):
        assert rig.receive(late, 0.0).deltas == []
    with pytest.raises(RefusedMessageError, match="has taken over"):
        rig.receive(hazard("clear", 9, epoch=0), 0.0)
    assert cost_and_speed(rig, 0.75, 0.75)[0] == LETHAL
    rig.aggregator = LivingAggregator(rig.core, epoch=2)
    rig.on_hazard(hazard("clear", 1, epoch=2), 1.0)
    assert cost_and_speed(rig, 0.75, 0.75)[0] == 0
    rig.receive(hazard("blocked", 1, epoch=1), 1.0)
    assert cost_and_speed(rig, 0.75, 0.75)[0] == LETHAL, "a hazard of an old epoch may raise the cost"


def test_hazard_received_before_its_definition_is_applied_with_it():
    rig = make_rig()
    assert rig.on_hazard(hazard("blocked"), 0.0).hazards == []
    rig.on_definition(definition(), 0.0)
    assert cost_and_speed(rig, 0.75, 0.75)[0] == LETHAL


def test_moved_or_removed_area_leaves_no_costs_behind():
    rig = make_rig()
    initial = rig.cost.copy()
    rig.on_definition(definition(version=1), 0.0)
    rig.on_hazard(hazard("blocked"), 0.0)
    rig.on_definition(definition(x=1.5, version=2), 0.0)
    assert cost_and_speed(rig, 0.75, 0.75)[0] == 0
    assert cost_and_speed(rig, 1.75, 0.75)[0] == LETHAL
    rig.on_definition(definition(version=1), 0.0)
    assert cost_and_speed(rig, 1.75, 0.75)[0] == LETHAL, "an older version is ignored"
    change = rig.on_definition(definition(version=3, removed=True), 0.0)
    assert change.hazards[0].hazard.state == "clear"
    assert np.array_equal(rig.cost, initial)


@pytest.mark.parametrize("state", ["clear", "blocked"])
def test_area_that_is_defined_again_does_not_meet_the_hazard_of_the_removed_one(state):
    rig = make_rig()
    rig.on_definition(definition(version=1), 0.0)
    rig.on_hazard(hazard(state, 7), 0.0)
    rig.on_definition(definition(version=2, removed=True), 0.1)
    change = rig.on_definition(definition(version=3, x=1.5), 0.2)
    assert (change.hazards[0].hazard.state, change.hazards[0].confirmed) == ("unknown", False)
    rig.receive(hazard(state, 7), 0.3)  # a late duplicate, while the newest heartbeat still lists it
    assert cost_and_speed(rig, 1.75, 0.75) == (200, 15)
    rig.on_hazard(hazard("clear", 8), 0.4)
    assert cost_and_speed(rig, 1.75, 0.75) == (0, 0)


def test_no_area_is_clear_while_the_aggregator_is_lost():
    rig = make_rig()
    rig.on_definition(definition(), 0.0)
    rig.on_definition(definition("gate", x=1.5), 0.0)
    rig.on_hazard(hazard("clear"), 0.0)
    rig.on_hazard(hazard("blocked", area="gate"), 0.0)
    change = rig.on_aggregator(present=False, stamp=1.0)
    assert cost_and_speed(rig, 0.75, 0.75) == (200, 15)
    assert cost_and_speed(rig, 1.75, 0.75)[0] == LETHAL
    assert [(h.hazard.area, h.hazard.state, h.confirmed) for h in change.hazards] == [
        ("hall", "unknown", False),
        ("gate", "blocked", False),
    ]
    rig.on_aggregator(present=True, stamp=4.0)
    assert cost_and_speed(rig, 0.75, 0.75) == (0, 0)


def test_aggregator_that_knows_all_areas_decides_on_them_though_its_versions_begin_anew():
    # Redis lost the areas, an administrator accepted that, and the aggregator started again.
    rig = make_rig()
    rig.on_definition(definition(version=5, epoch=1), 0.0)
    rig.aggregator.announce(hazard("blocked", epoch=1), 1.0)
    rig.on_hazard(hazard("blocked", epoch=1), 1.0)
    moved = definition(x=1.5, version=1, epoch=2)
    rig.on_definition(moved, 2.0)
    rig.on_hazard(hazard("blocked", epoch=2), 2.0)
    successor = LivingAggregator(rig.core, epoch=2)
    successor.announced["hall"] = hazard("blocked", epoch=2)
    successor.beat(3.0)
    assert cost_and_speed(rig, 1.75, 0.75)[0] < LETHAL, "it may have started without Redis, and know the site's only"
    for now in (4.0, 4.1):
        successor.send(successor.heartbeat(now, complete=True), now)
    assert cost_and_speed(rig, 1.75, 0.75)[0] == LETHAL
    assert cost_and_speed(rig, 0.75, 0.75)[0] < LETHAL
    rig.on_definition(definition(version=0, epoch=2), 4.2)
    successor.send(successor.heartbeat(4.3, complete=True), 4.3)
    assert cost_and_speed(rig, 1.75, 0.75)[0] == LETHAL, "of one aggregator the higher version counts"


def test_area_whose_polygon_crosses_itself_is_refused_and_the_known_one_stays():
    rig = make_rig()
    rig.on_definition(definition(), 0.0)
    bowtie = AreaDefinition(id="hall", polygon=[(0.0, 0.0), (1.0, 1.0), (1.0, 0.0), (0.0, 1.0)], version=2)
    with pytest.raises(RefusedMessageError, match=r"area hall: .*crosses itself"):
        rig.on_definition(bowtie, 0.0)
    assert cost_and_speed(rig, 0.75, 0.75) == (200, 15)


# --- Layers ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("layers", "message"),
    [
        (["hazards", "static", "zones"], r"layers\[0\]: 'static' must be the first"),
        (["static", "zones"], "'hazards' must occur exactly once"),
        (["static", "hazards", "zones", "zones"], "'zones' must occur exactly once"),
        (["static", "hazards", "zones", "lava"], r"layers\[3\]: .*'lava' \(known: .*obstacles, reported, static, z"),
        (["static", "hazards", {"name": "zones", "depth": 3}], r"layers\[2\] \(zones\): depth: .*no such option"),
        (["static", "hazards", "zones", {"cost": 3}], r"layers\[3\]: "),
    ],
)
def test_invalid_layers_are_refused_naming_the_entry(layers, message):
    with pytest.raises(LayersError, match=message):
        make_layers(floor_plan(), layers)


class Spot(CostLayer):
    """Raises the cost of a cell at a message of a channel that no standard layer subscribes to."""

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


def test_additional_layer_gets_messages_and_ticks_and_writes_costs():
    plan = floor_plan()
    core = MapCore("test", plan, 3, layers=[*make_layers(plan), Spot()])
    core.load_zones([], moment(0.0))
    core.tick(moment(0.0))
    assert ch.ROBOT_STATE in core.handlers()
    (delta,) = core.handlers()[ch.ROBOT_POSE]({"robot": "r1"}, pose(9.0, 9.0), moment(1.0))
    assert (delta.channel, delta.message.causes[0].id, core.costmap.cost[30, 40]) == (ch.MAP_DELTA, "spot", 90)
    core.tick(moment(10.0))
    assert core.costmap.cost[30, 40] == 0


# --- Serving --------------------------------------------------------------------------------------------------------


def make_core(**arguments) -> MapCore:
    plan = floor_plan()
    areas = [definition(), definition("gate", x=1.5)]
    return MapCore("test", plan, 3, layers=make_layers(plan), definitions=areas, **arguments)


def moment(now: float) -> Moment:
    return Moment(now, now)


def channel_names(publications: Sequence[Publication]) -> list[str]:
    return [publication.channel.name for publication in publications]


def test_nothing_is_published_before_the_zones_are_loaded():
    core = make_core()
    assert core.tick(moment(0.0)) == []
    assert core.handlers()[ch.AREA_HAZARD]({"area": "hall"}, hazard("blocked"), moment(0.1)) == []
    assert core.put_zone(zone(), moment(0.1)) == []
    assert core.tick(moment(100.0)) == []
    assert (core.serving, core.missing()) == (False, "the stored zones are not loaded yet")
    core.load_zones([zone("stored")], moment(100.1))
    first = core.tick(moment(100.2))
    assert core.serving
    assert (channel_names(first), core.missing()) == (["hazard", "hazard", "zones", "places", "map_heartbeat"], "")
    assert [z.id for z in first[2].message.zones] == ["stored"]
    assert first[-1].message == MapHeartbeat(
        epoch=3, seq=core.costmap.version.seq, hash=core.costmap.version.hash, sent=(0, 100.2)
    )
    assert channel_names(core.tick(moment(100.3))) == ["map_heartbeat"]


def test_first_map_waits_for_the_hazards_of_all_areas_until_a_timeout():
    without_gate, with_gate = make_core(hazards_wait_s=3.0), make_core(hazards_wait_s=3.0)
    for core in (without_gate, with_gate):
        core.load_zones([], moment(0.0))
        core.tick(moment(0.0))
        core.handlers()[ch.AREA_HAZARD]({"area": "hall"}, hazard("blocked"), moment(0.1))
        assert core.tick(moment(0.2)) == []
        assert core.missing() == "waiting for the hazards of gate"
    assert without_gate.tick(moment(2.9)) == []
    assert channel_names(without_gate.tick(moment(3.0)))[-1] == "map_heartbeat"
    gate = hazard("clear", area="gate")
    with_gate.handlers()[ch.AREA_HAZARD]({"area": "gate"}, gate, moment(0.3))
    assert with_gate.tick(moment(0.4)) == [], "nobody has confirmed yet that it is clear"
    aggregator = LivingAggregator(with_gate)
    aggregator.announced = {"hall": hazard("blocked")}
    aggregator.announce(gate, 1.0)
    assert channel_names(with_gate.tick(moment(1.0)))[-1] == "map_heartbeat"


def test_queries_return_the_map_its_zones_and_an_areas_hazard():
    core = make_core()
    core.load_zones([zone()], moment(0.0))
    core.tick(moment(0.0))
    answers = core.query_handlers()
    assert answers[ch.MAP_SNAPSHOT]({}, None, moment(1.0)).make() is core.costmap.snapshot()
    assert [z.id for z in answers[ch.ZONES]({}, None, moment(1.0)).zones] == ["z1"]
    assert answers[ch.HAZARD]({"area": "gate"}, None, moment(1.0)).hazard.area == "gate"


def test_loaded_zones_replace_all_zones_and_an_invalid_one_changes_nothing():
    core = make_core()
    core.load_zones([zone("old"), zone("kept")], moment(0.0))
    bad = zone("bad", shape=RectangleShape(corner=(0.0, 0.0), opposite=(0.0, 1.0)))
    with pytest.raises(ShapeError, match=r"bad\.shape\.opposite"):
        core.load_zones([zone("new"), bad], moment(1.0))
    assert [z.id for z in core.zones.zones()] == ["kept", "old"]
    core.load_zones([zone("new"), zone("kept")], moment(1.0))
    assert [z.id for z in core.zones.zones()] == ["kept", "new"]


# --- Zones ----------------------------------------------------------------------------------------------------------


def test_each_kind_of_zone_sets_its_cost_or_speed_limit():
    rig = make_rig()
    rig.put_zone(zone("a", "PENALTY", factor=2.0), 0.0)
    assert cost_and_speed(rig, 1.0, 1.0) == (penalty_cost(2.0), 0)
    rig.put_zone(zone("b", "SPEED_LIMIT", speed=0.2), 0.0)
    assert cost_and_speed(rig, 1.0, 1.0) == (penalty_cost(2.0), 20)
    change = rig.put_zone(zone("c", "BLOCKED"), 0.0)
    assert cost_and_speed(rig, 1.0, 1.0) == (254, 20)
    assert [z.id for z in change.zones.zones] == ["a", "b", "c"]
    assert change.zones.seq == rig.map.version.seq
    rig.remove_zone("c", 0.0)
    assert cost_and_speed(rig, 1.0, 1.0) == (penalty_cost(2.0), 20)


def test_penalty_zone_lowers_no_cost_and_leaves_unknown_cells_unknown():
    rig = make_rig()
    initial = rig.cost.copy()
    rig.put_zone(zone("a", "PENALTY", factor=3.0, shape=RectangleShape(corner=(-5.0, -5.0), opposite=(9.0, 9.0))), 0.0)
    assert (rig.cost >= initial).all()
    assert (rig.cost[initial == UNKNOWN] == UNKNOWN).all()


def test_zone_is_in_force_between_its_start_and_expiry_and_while_enabled():
    rig = make_rig()
    rig.put_zone(zone(starts_at=10.0, expires_at=20.0), 0.0)
    for stamp, cost in ((9.9, 0), (10.0, 254), (19.9, 254), (20.0, 0)):
        rig.tick(stamp, stamp)
        assert cost_and_speed(rig, 1.0, 1.0)[0] == cost, stamp
    assert rig.tick(21.0, 21.0).zones is None
    rig.put_zone(zone(enabled=False), 0.0)
    assert cost_and_speed(rig, 1.0, 1.0)[0] == 0


def test_zones_are_published_again_with_the_ids_in_force_when_one_begins_or_ends():
    rig = make_rig()
    rig.put_zone(zone("always"), 0.0)
    first = rig.put_zone(zone("later", starts_at=10.0, expires_at=20.0), 0.0)
    assert ([z.id for z in first.zones.zones], first.zones.active) == (["always", "later"], ["always"])
    listed = [(stamp, change.zones) for stamp in (9.9, 10.0, 19.9, 20.0) if (change := rig.tick(stamp, stamp)).zones]
    assert [(stamp, zones.active) for stamp, zones in listed] == [(10.0, ["always", "later"]), (20.0, ["always"])]
    assert [z.id for z in listed[-1][1].zones] == ["always", "later"]
    assert listed[-1][1].seq == rig.map.version.seq
    assert first.zones.active == ["always"], "what was published stays as it was"


def test_zones_in_force_are_listed_by_the_rules_of_the_map_and_not_by_the_date():
    core = make_core()
    unknown = Moment(0.0, 5.0, synchronized=False)
    core.load_zones([zone("later", starts_at=1e9), zone("off", enabled=False)], unknown)
    (listed,) = [p.message for p in core.tick(unknown) if p.channel is ch.ZONES]
    assert listed.active == ["later"], "nobody knows whether it has started"
    (listed,) = [p.message for p in core.tick(Moment(1.0, 100.0)) if p.channel is ch.ZONES]
    assert ([z.id for z in listed.zones], listed.active) == (["later", "off"], [])
    assert core.query_handlers()[ch.ZONES]({}, None, moment(2.0)) == listed


@given(st.integers(0, 40), st.integers(1, 32))
@settings(max_examples=40, deadline=None)
def test_list_with_all_zones_in_force_is_no_larger_than_what_is_checked_before_one_is_stored(count, length):
    core = make_core()
    core.load_zones([zone(f"{number:x<{length}}"[:length]) for number in range(count)], moment(0.0))
    listed = core.zone_set()
    assert len(listed.active) == len(listed.zones)
    assert len(msgspec.msgpack.encode(listed)) <= list_size(core.zones.size)


@pytest.mark.parametrize(
    ("invalid", "field"),
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
def test_invalid_zone_is_refused_naming_its_field(invalid, field):
    with pytest.raises(ZoneError) as caught:
        prepare_zone(invalid, floor_plan().geometry, 10.0)
    assert caught.value.field == field


# --- Obstacles ------------------------------------------------------------------------------------------------------


def test_obstacle_is_lethal_until_its_last_report_expires():
    rig = make_rig()
    initial = rig.cost.copy()
    rig.on_obstacles("r1", obstacles((1.0, 1.0)), 0.0, 0.0)
    assert cost_and_speed(rig, 1.0, 1.0)[0] == LETHAL
    rig.on_obstacles("r2", obstacles((1.0, 1.0)), 3.0, 3.0)
    rig.tick(5.5, 5.5)
    assert cost_and_speed(rig, 1.0, 1.0)[0] == LETHAL
    rig.tick(8.0, 8.0)
    assert np.array_equal(rig.cost, initial)


def test_points_on_a_robot_are_no_obstacles():
    rig = make_rig()
    initial = rig.cost.copy()
    rig.on_pose("r2", pose(1.0, 1.0), 0.0)
    rig.on_obstacles("r1", obstacles((0.85, 1.0), (1.0, 1.17)), 0.5, 0.5)
    assert np.array_equal(rig.cost, initial)
    rig.on_obstacles("r1", obstacles((0.85, 1.0)), 5.0, 5.0)
    assert cost_and_speed(rig, 0.85, 1.0)[0] == LETHAL, "a stale pose explains no obstacle"
    rig.on_pose("r2", pose(1.0, 1.0), 5.1)
    rig.tick(5.1, 5.1)
    assert np.array_equal(rig.cost, initial)


@pytest.mark.parametrize(("seen_from", "is_robot"), [(6.0, False), (1.0, True)], ids=["4 m away", "9 m away"])
def test_what_is_near_a_robot_is_told_from_it_less_well_from_far_away(seen_from, is_robot):
    rig = make_rig(floor_plan(600, 300))
    rig.on_pose("r2", pose(10.0, 5.0), 0.0)
    # 0.45 m from its centre: 0.28 m from its rim.
    rig.on_obstacles(
        "r1", obstacles((10.0, 5.45), view=view_from(seen_from, 5.0, 12.0, towards=0.1, width=0.1)), 0.1, 0.1
    )
    assert (cost_and_speed(rig, 10.0, 5.45)[0] < LETHAL) == is_robot


def test_obstacle_is_cleared_by_two_consecutive_views_beyond_it():
    rig = make_rig()
    initial = rig.cost.copy()
    rig.on_obstacles("r1", obstacles((1.0, 1.0), ttl=600.0), 0.0, 0.0)
    rig.on_obstacles("r2", obstacles(view=view_from(0.4, 1.0, 1.2)), 1.0, 1.0)
    assert cost_and_speed(rig, 1.0, 1.0)[0] == LETHAL, "one view is not enough"
    rig.on_obstacles("r1", obstacles(view=view_from(1.0, 1.6, 1.2)), 2.0, 2.0)
    assert np.array_equal(rig.cost, initial)


@pytest.mark.parametrize(
    ("view", "reason"),
    [
        (view_from(0.4, 1.0, 0.7), "the view ends at it"),
        (view_from(0.4, 1.0, 0.3), "the view ends before it"),
        (view_from(0.4, 1.0, 1.2, towards=math.pi, width=4.0), "the view covers another direction"),
    ],
)
def test_obstacle_that_no_view_reaches_beyond_stays(view, reason):
    rig = make_rig()
    rig.on_obstacles("r1", obstacles((1.0, 1.0), ttl=600.0), 0.0, 0.0)
    for now in range(1, 10):
        rig.on_obstacles("r1", obstacles(view=view), float(now), float(now))
    assert cost_and_speed(rig, 1.0, 1.0)[0] == LETHAL, reason


def test_what_lidars_saw_in_a_blocked_area_is_gone_once_its_nodes_say_so_and_older_things_stay():
    rig = make_rig()
    rig.on_definition(definition(), 1.0)
    rig.on_hazard(hazard("clear"), 2.0)
    rig.on_obstacles("r1", obstacles((0.6, 0.6), ttl=600.0), 3.0, 3.0)  # stood there before
    rig.on_obstacles("r1", obstacles((0.9, 0.9), (1.5, 0.9), ttl=600.0), 19.5, 19.5)
    rig.on_hazard(hazard("blocked", 2), 20.0)
    rig.on_hazard(hazard("unknown", 3), 30.0)
    assert cost_and_speed(rig, 0.9, 0.9)[0] == LETHAL
    rig.on_hazard(hazard("clear", 4), 40.0)
    assert [cost_and_speed(rig, *at)[0] == LETHAL for at in ((0.6, 0.6), (0.9, 0.9), (1.5, 0.9))] == [
        True, False, True,
    ]  # fmt: skip


def test_area_that_is_removed_takes_no_obstacle_with_it():
    rig = make_rig()
    rig.on_definition(definition(), 1.0)
    rig.on_hazard(hazard("blocked"), 2.0)
    rig.on_obstacles("r1", obstacles((0.9, 0.9), ttl=600.0), 3.0, 3.0)
    rig.on_definition(definition(removed=True, version=1), 4.0)
    assert cost_and_speed(rig, 0.9, 0.9)[0] == LETHAL


def test_obstacle_that_is_seen_between_two_views_beyond_it_stays():
    rig = make_rig()
    for now in range(10):
        points = [(1.0, 1.0)] if now % 2 == 0 else []
        rig.on_obstacles("r1", obstacles(*points, ttl=600.0, view=view_from(0.4, 1.0, 1.2)), float(now), float(now))
    assert cost_and_speed(rig, 1.0, 1.0)[0] == LETHAL


def test_robot_with_a_broken_lidar_takes_no_other_robots_room():
    rig = make_rig(floor_plan(600, 300))
    wall = [(0.025 + 0.05 * (i % 200), 0.025 + 0.05 * (i // 200)) for i in range(25_000)]
    for start in range(0, 25_000, 2_000):
        rig.on_obstacles("r1", obstacles(*wall[start : start + 2_000], ttl=600.0), 1.0, 1.0, at=(5.0, -0.5))
    assert rig.core.refused_cells == 25_000 - MAX_OF_ROBOT
    rig.on_obstacles("r2", obstacles((10.0, 10.0), ttl=600.0), 2.0, 2.0)
    assert cost_and_speed(rig, 10.0, 10.0)[0] == LETHAL
    for now in (3.0, 4.0):
        rig.on_obstacles("r2", obstacles((10.0, 10.0), ttl=600.0, view=view_from(5.0, -0.3, 12.0)), now, now)
    rig.on_obstacles("r1", obstacles((20.0, 10.0), ttl=600.0), 5.0, 5.0)
    assert cost_and_speed(rig, 20.0, 10.0)[0] == LETHAL, "what was cleared made room"


@pytest.mark.parametrize("at", [None, (2.0, 2.0)], ids=["no pose", "another pose"])
def test_view_from_where_the_robot_is_not_clears_no_obstacle_and_adds_none(at):
    rig = make_rig()
    rig.on_obstacles("r1", obstacles((1.0, 1.0), ttl=600.0), 0.0, 0.0)
    before = rig.cost.copy()
    forged = obstacles((1.5, 0.5), ttl=600.0, view=view_from(0.4, 1.0, 12.0))
    for now in (2.0, 3.0, 4.0):
        if at is not None:
            rig.on_pose("r2", pose(*at), now)
        rig._deliver(ch.ROBOT_OBSTACLES, forged, now, now, robot="r2")
    assert np.array_equal(rig.cost, before)
    assert rig.core.refused_cells == 3


@pytest.mark.parametrize(
    ("view", "seen"),
    [
        (view_from(2.0, 7.0, 12.0), [(5.0, 7.0), (13.9, 7.0)]),  # not what is 13 m away
        (view_from(2.0, 7.0, 3.0), [(5.0, 7.0)]),  # nor what is behind what it sees
        (view_from(2.0, 7.0, 12.0, towards=math.pi, width=3.0), []),  # nor what is where it sees nothing
        (None, [(5.0, 7.0), (13.9, 7.0)]),
    ],
)
def test_robot_adds_what_it_can_see_only(view, seen):
    rig = make_rig(floor_plan(600, 300))
    points = [(5.0, 7.0), (13.9, 7.0), (15.0, 7.0)]
    rig.on_obstacles("r1", obstacles(*points, ttl=600.0, view=view), 0.0, 0.0, at=(2.0, 7.0))
    assert [point for point in points if cost_and_speed(rig, *point)[0] == LETHAL] == seen
    assert rig.core.refused_cells == 3 - len(seen)


def test_what_a_robot_could_not_pass_is_added_although_it_sees_nothing_there():
    rig = make_rig()
    nothing = view_from(1.0, 1.0, 3.0, towards=math.pi, width=3.0)
    rig.on_obstacles("r1", obstacles((1.5, 1.0), ttl=600.0, view=nothing), 0.0, 0.0)
    assert cost_and_speed(rig, 1.5, 1.0)[0] == LETHAL


@settings(max_examples=40, deadline=None)
@given(
    reports=st.lists(
        st.tuples(
            st.sampled_from(["r1", "r2"]),
            st.lists(st.tuples(st.integers(-25, 70), st.integers(-15, 55)), max_size=12),
            st.one_of(st.none(), st.tuples(st.integers(0, 50), st.integers(0, 45), st.sampled_from([10, 30, 255]))),
            st.sampled_from([0.3, 2.0, 600.0]),
        ),
        max_size=12,
    )
)
def test_obstacles_on_the_map_are_those_that_were_seen_and_neither_cleared_nor_expired(reports):
    rig, known = make_rig(), {}
    free = rig.cost.copy()
    for step, (robot, cells, view, ttl) in enumerate(reports):
        now = 1.0 + 1.5 * step  # nobody's pose is fresh any more
        # In the middle of cells; a view is none of a cell's, so that no bearing is between two sectors.
        points = [(0.05 * x + 0.025, 0.05 * y + 0.025) for x, y in cells]
        seen = (
            None
            if view is None
            else View(x=0.05 * view[0] + 0.01, y=0.05 * view[1] + 0.02, reach=bytes([view[2]]) * VIEW_SECTORS)
        )
        told = points
        if seen is not None:
            reach = min(REACH_UNIT_M * view[2] + BEYOND_M, REACH_UNIT_M * 255)
            at = seen.x, seen.y
            points = [point for point in points if math.dist(point, at) <= reach]
            known = {point: state for point, state in known.items() if math.dist(point, at) > 0.39}
        for point in points:
            if rig.geometry.contains(*point) and (seen is None or math.dist(point, at) > 0.39):
                known[point] = [max(now + ttl, known.get(point, (0.0,))[0]), 0]
        if seen is not None:
            for point, state in known.items():
                distance = math.dist(point, (seen.x, seen.y))
                if point in points or not 2 * CELL_HALF_WIDTH_M < distance <= RANGE_M:
                    continue
                state[1] = state[1] + 1 if REACH_UNIT_M * view[2] > distance + MARGIN_M else 0
        known = {point: state for point, state in known.items() if state[1] < 2}
        rig.on_obstacles(robot, obstacles(*told, ttl=ttl, view=seen), now, now, at=None if seen else FAR)
        rig.tick(now + 0.5, now + 0.5)
        known = {point: state for point, state in known.items() if state[0] > now + 0.5}
        check = make_rig()
        check.on_obstacles("r9", obstacles(*known, ttl=600.0), 0.0, 0.0, at=FAR)
        assert np.array_equal(rig.cost, check.cost)
    rig.tick(1e4, 1e4)
    assert np.array_equal(rig.cost, free)


def test_expired_obstacle_restores_the_zone_beneath():
    rig = make_rig()
    rig.put_zone(zone(), 0.0)
    with_zone = rig.cost.copy()
    rig.on_obstacles("r1", obstacles((1.0, 1.0), (1.5, 1.0)), 0.0, 0.0)
    rig.tick(6.0, 6.0)
    assert np.array_equal(rig.cost, with_zone)


# --- Windows, versions ----------------------------------------------------------------------------------------------


def test_delta_covers_only_the_cells_that_a_zone_changes():
    rig = make_rig(floor_plan(400, 300))
    change = rig.put_zone(zone(), 0.0)
    (delta,) = change.deltas
    assert delta.w * delta.h < 40 * 40
    assert rig.put_zone(zone(), 0.0).deltas == []


@given(
    st.lists(
        st.tuples(st.integers(0, 40), st.integers(0, 40), st.integers(0, 12), st.integers(0, 12)).map(
            lambda w: Window(*w)
        ),
        max_size=12,
    )
)
@settings(deadline=None)
def test_merged_windows_are_disjoint_and_cover_the_same_cells(windows):
    result = merge_overlapping(windows)
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
    st.sampled_from(["BLOCKED", "PENALTY", "SPEED_LIMIT", "RELEASE"]),
    st.floats(0, 30),
    st.floats(1, 30),
)
areas = st.sampled_from(["hall", "gate"])
events = st.one_of(
    st.tuples(st.just("zone"), zones),
    st.tuples(st.just("remove zone"), st.sampled_from(["z1", "z2", "z3"])),
    st.tuples(st.just("define"), areas, coordinate, coordinate, st.floats(0.1, 1.5), st.booleans()),
    st.tuples(st.just("hazard"), areas, st.sampled_from(["blocked", "unknown", "clear"]), st.integers(0, 254)),
    st.tuples(st.just("obstacles"), st.lists(point, max_size=8), st.floats(0.5, 10)),
    st.tuples(st.just("view"), point, st.floats(0.0, 3.0)),
    st.tuples(st.just("pose"), point),
    st.tuples(st.just("aggregator"), st.booleans()),
    st.tuples(st.just("wait"), st.floats(0.1, 10)),
)


def apply_events(rig: Rig, history: list[tuple]) -> list[MapDelta]:
    now, deltas = 0.0, []
    for seq, (kind, *rest) in enumerate(history, start=1):
        if kind == "zone":
            change = rig.put_zone(rest[0], now)
        elif kind == "remove zone":
            change = rig.remove_zone(rest[0], now)
        elif kind == "define":
            change = rig.on_definition(definition(*rest[:4], version=seq, removed=rest[4]), now)
        elif kind == "hazard":
            change = rig.on_hazard(hazard(rest[1], seq, area=rest[0], penalty=rest[2]), now)
        elif kind == "obstacles":
            change = rig.on_obstacles("r1", obstacles(*rest[0], ttl=rest[1]), now, now, at=FAR)
        elif kind == "view":
            change = rig.on_obstacles("r1", obstacles(view=view_from(*rest[0], rest[1])), now, now)
        elif kind == "pose":
            deltas += rig.on_pose("r2", pose(*rest[0]), now).deltas
            change = rig.tick(now, now)
        elif kind == "aggregator":
            change = rig.on_aggregator(present=rest[0], stamp=now)
        else:
            now += rest[0]
            change = rig.tick(now, now)
        deltas += change.deltas
    return deltas


@given(st.lists(events, max_size=25))
@settings(max_examples=150, deadline=None)
def test_map_equals_a_full_recompute_and_its_replica_after_any_events(history):
    rig = make_rig()
    replica = Replica()
    replica.load(rig.map.snapshot())
    for delta in apply_events(rig, history):
        outcome = replica.apply(delta)
        assert outcome == "waiting" or isinstance(outcome, Applied)
    cost, speed = rig.map.recompute()
    assert np.array_equal(rig.cost, cost)
    assert np.array_equal(rig.speed, speed)
    assert not replica.needs_snapshot
    assert replica.version == rig.map.version
    assert np.array_equal(replica.cost, cost)
    assert np.array_equal(replica.speed, speed)


@given(st.lists(events, max_size=15))
@settings(max_examples=50, deadline=None)
def test_map_equals_the_static_map_once_everything_is_removed(history):
    rig = make_rig()
    initial = rig.cost.copy()
    apply_events(rig, history)
    for name in ("z1", "z2", "z3"):
        rig.remove_zone(name, 1e6)
    for name in ("hall", "gate"):
        rig.on_definition(definition(name, version=10_000, removed=True), 1e6)
    rig.tick(1e6, 1e6)
    assert np.array_equal(rig.cost, initial)
    assert not rig.speed.any()
