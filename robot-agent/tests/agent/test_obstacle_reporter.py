"""Obstacles that the map does not know are reported, those far ahead on the way once several looks agree."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from little_world import grid_of

from fog_contracts import channels as ch
from fog_contracts.costs import LETHAL, Inflation
from fog_contracts.grid import GridGeometry
from fog_contracts.handlers import Moment
from fog_contracts.messages import (
    REACH_UNIT_M,
    AreaHazard,
    CircleShape,
    CorridorShape,
    HazardArea,
    RectangleShape,
    Zone,
    ZoneSet,
)
from fog_kernels.astar import Planner
from fog_kernels.inflation import inflate, inflation_table
from fog_kernels.raycast import cast
from robot_agent.agent.navigation import BlockedPlaces
from robot_agent.agent.obstacle_reporter import ObstacleReporter, view
from robot_agent.config import LocalizationConfig
from robot_agent.localization.map_fields import map_fields
from robot_agent.localization.pose import Pose2, Uncertainty

RADIUS = 0.17
BARRIER = (16.0, 1.0, 16.6, 3.4)
SOUTH, NORTH = 1.0, 3.4
"""Walls of a corridor of 2.4 m from x = 1 to x = 25, from which another one leaves to the north at x = 13 to 15."""
ROOMS = [(1, SOUTH, 25, NORTH), (13, NORTH, 15, 9)]
STRAIGHT = [(x, 2.2) for x in np.arange(1.5, 24.0, 0.1)]
NORTHWARDS = [(x, 2.2) for x in np.arange(1.5, 14.0, 0.1)] + [(14.0, y) for y in np.arange(2.2, 8.0, 0.1)]


class Corridor:
    """A robot's localizer and map in the corridor, in which boxes (left, bottom, right, top; m) may stand."""

    def __init__(self, *, seed=1):
        self.static, self.geometry = grid_of(ROOMS, 26.0, 10.0)
        self.fields = map_fields(self.static, self.geometry, LocalizationConfig())
        self.solid = (self.static == LETHAL).astype(np.uint8)
        self.table = inflation_table(self.geometry.resolution, Inflation(inscribed_radius=RADIUS))
        self.raw = self.static.copy()
        self.reporter = ObstacleReporter(600.0, 400, RADIUS)
        self.noise = np.random.default_rng(seed)
        self.turning, self.status = 0.0, "good"
        self.uncertainty = Uncertainty(0.03, 0.02, 0.013)
        self.now = 0.0

    # --- as a localizer ---

    def points_in_map(self):
        return self.believed.transform(self.scan.points)

    def scan_pose(self):
        return self.believed

    def pose(self, _now):
        return self.believed

    def twist(self):
        return 0.3, self.turning

    def wall_distance(self, points):
        return self.fields.wall_distances(points)

    # --- as a map ---

    @property
    def replica(self):
        return SimpleNamespace(geometry=self.geometry, static=self.static, cost=inflate(self.raw, self.table))

    def put(self, points):
        """Let the map contain these points."""
        columns, rows = self.geometry.cells(np.array(points))[0].T
        self.raw[rows, columns] = LETHAL

    def see(self, x, boxes, *, error=0.0, y=2.2, beams=360):
        """Scan from (x, y), looking east, with a heading that is believed to be `error` rad more than it is."""
        g, solid = self.geometry, self.solid.copy()
        for left, bottom, right, top in boxes:
            (first, low), (last, high) = g.cell(left, bottom), g.cell(right, top)
            solid[low:high, first:last] = 1
        angles = np.arange(beams) * math.tau / beams
        ranges = cast(solid, g.resolution, g.origin_x, g.origin_y, x, y, angles, 12.0)
        ranges = ranges * (1.0 + 0.004 * self.noise.standard_normal(beams))
        kept = np.isfinite(ranges) & (ranges < 12.0) & (self.noise.random(beams) > 0.01)
        points = np.column_stack((np.cos(angles), np.sin(angles)))[kept] * ranges[kept, np.newaxis]
        self.believed = Pose2(x, y, error)
        self.scan = SimpleNamespace(points=points, timestamp=self.now)

    def report(self, way):
        ahead = np.array([p for p in way if p[0] >= self.believed.x])
        return self.reporter.report(self, self.replica, 0.1, Moment(self.now, self.now), way=ahead).points

    def drive(self, start, seconds, boxes=(), way=STRAIGHT, *, errors=(0.0,), **more):
        """Drive at 0.3 m/s as the agent does; return when something was first reported, and from where, and what."""
        begun = self.now
        for step in range(round(seconds * 10)):
            self.now = begun + 0.1 * step
            x = start + 0.03 * step
            if step % 2 == 0:
                here = boxes(self.now) if callable(boxes) else boxes
                self.see(x, here, error=float(self.noise.choice(errors)), **more)
            ahead = np.array([p for p in way if p[0] >= x])
            due = step % 10 == 0
            if not due and self.reporter.wants_look(self.now):
                due = self.reporter.look(self, self.replica, 0.1, ahead)
            if due and (points := self.report(way)):
                return self.now, x, points
        return None


def is_passable(corridor, points):
    """Return whether the planner finds a way along the corridor past these reported points."""
    corridor.put(points)
    g = corridor.geometry
    found = Planner(g.width, g.height).plan(corridor.replica.cost, g.cell(2.0, 2.2), g.cell(24.0, 2.2))
    return found.found


ERRORS = np.linspace(-0.02, 0.02, 5)
"""Of the heading, rad: 1.1 degrees, by which a point 10 m away is 0.2 m off."""


@pytest.mark.parametrize("seed", range(8))
def test_barrier_is_reported_at_once_and_whole_as_soon_as_several_looks_show_it(seed):
    corridor = Corridor(seed=seed)
    _, x, points = corridor.drive(2.0, 20.0, [BARRIER], errors=ERRORS)
    assert BARRIER[0] - x > 10.0, "from nearly as far as the lidar sees"
    assert np.abs(np.array(points)[:, 0] - BARRIER[0]).max() < 0.35
    assert not is_passable(corridor, points)


@pytest.mark.parametrize("seed", range(8))
def test_gap_that_the_body_fits_through_is_not_closed_by_what_is_seen_from_afar(seed):
    corridor = Corridor(seed=seed)
    left, bottom, right, top = BARRIER
    found = corridor.drive(2.0, 20.0, [(left, bottom, right, top - 0.8)], errors=ERRORS)
    assert found is not None
    assert is_passable(corridor, found[2])


def test_end_of_a_barrier_that_was_not_seen_at_first_is_reported_while_it_is_still_far():
    corridor = Corridor()
    _, x, points = corridor.drive(2.0, 20.0, [BARRIER])
    assert is_passable(corridor, [point for point in points if point[1] < 2.9]), "some 0.4 m beside the wall"
    corridor.now = 100.0
    beside = [(x, 3.15) for x, _ in STRAIGHT]
    found = corridor.drive(x, 10.0, [BARRIER], beside)
    assert found is not None
    assert BARRIER[0] - found[1] > 9.5
    assert not is_passable(corridor, found[2])


def test_what_the_map_has_is_not_told_again():
    corridor = Corridor()
    _, x, points = corridor.drive(2.0, 20.0, [BARRIER])
    corridor.put(points)
    corridor.now = 100.0
    assert corridor.drive(x, 10.0, [BARRIER]) is None


def test_barrier_beside_the_path_is_not_reported_from_afar():
    assert Corridor().drive(2.0, 20.0, [BARRIER], NORTHWARDS) is None
    assert Corridor().drive(2.0, 20.0, [BARRIER], NORTHWARDS[:20]) is None, "the path ends before it"


@pytest.mark.parametrize(
    ("speed", "width", "reported"),
    [(0.0, 1.2, True), (0.0, 0.5, False), (0.7, 1.2, False), (1.5, 1.2, False), (-0.7, 1.2, False), (-1.0, 1.2, False)],
)
def test_only_what_is_wide_and_stands_is_reported_from_afar(speed, width, reported):
    def group(now):
        x = 13.5 + speed * now
        return [(x, 2.2 - width / 2, x + 0.4, 2.2 + width / 2)]

    assert (Corridor().drive(2.5, 4.0, group) is not None) == reported


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_reported_where_nothing_stands_however_the_heading_errs(seed):
    errors = np.linspace(-0.04, 0.04, 9)
    assert Corridor(seed=seed).drive(2.0, 30.0, errors=errors) is None
    assert Corridor(seed=seed).drive(2.0, 30.0, way=NORTHWARDS, errors=errors) is None


@pytest.mark.parametrize(
    "change",
    [{"status": "weak"}, {"turning": 0.3}, {"uncertainty": Uncertainty(0.03, 0.02, 0.05)}],
    ids=["weak pose", "turning", "uncertain heading"],
)
def test_nothing_far_is_reported_by_a_robot_that_turns_or_hardly_knows_its_heading(change):
    corridor = Corridor()
    for name, value in change.items():
        setattr(corridor, name, value)
    if corridor.status == "weak":
        corridor.see(5.0, [BARRIER])
        assert corridor.reporter.report(corridor, corridor.replica, 0.1, Moment(0.0, 0.0)) is None
    else:
        assert corridor.drive(5.0, 5.0, [BARRIER]) is None


def test_single_beam_in_the_way_is_not_reported_from_afar():
    assert Corridor().drive(6.0, 5.0, [(16.0, 2.2, 16.05, 2.25)]) is None


def test_looks_between_two_reports_are_made_only_while_something_seems_to_be_there():
    empty, barred = Corridor(), Corridor()
    for corridor, boxes in ((empty, []), (barred, [BARRIER])):
        corridor.see(6.0, boxes)
        corridor.report(STRAIGHT)
    assert not empty.reporter.wants_look(0.9)
    assert [barred.reporter.wants_look(now) for now in (0.1, 0.3, 0.9)] == [False, True, True]


GEOMETRY = GridGeometry(100, 100, 0.1, 0.0, 0.0)
HERE = Pose2(5.0, 5.0, 0.0)


class FakeLocalizer:
    def __init__(self, points):
        self.points = np.array(points, dtype=np.float64).reshape(-1, 2)
        self.status = "good"
        self.turning = 0.0
        self.scan = SimpleNamespace(points=self.points - (HERE.x, HERE.y), timestamp=0.0)
        self.uncertainty = Uncertainty(0.02, 0.02, 0.013)

    def points_in_map(self):
        return self.points

    def pose(self, _now):
        return HERE

    def scan_pose(self):
        return HERE

    def twist(self):
        return 0.0, self.turning

    def wall_distance(self, points):
        return np.abs(points[:, 0] - 9.0)  # a wall at x = 9


def replica():
    return SimpleNamespace(
        geometry=GEOMETRY, static=np.zeros(GEOMETRY.shape, np.uint8), cost=np.zeros(GEOMETRY.shape, np.uint8)
    )


def report(points, *, copy=None, reporter=None, scan_age=0.1, now=0.0, **changes):
    localizer = FakeLocalizer(points)
    for name, value in changes.items():
        setattr(localizer, name, value)
    reporter = reporter or ObstacleReporter(600.0, 3, 0.17)
    return reporter.report(localizer, copy or replica(), scan_age, Moment(now, 1_000.0 + now))


TWO = [(6.03, 5.02), (6.06, 5.04)]


def test_cells_with_two_points_or_more_are_reported_once_each():
    reported = report([*TWO, (7.05, 5.05)])
    assert reported.points == [pytest.approx((6.05, 5.05))]
    assert (reported.stamp, reported.ttl) == (1_000.0, 600.0)


@pytest.mark.parametrize(
    ("x", "y"), [(8.9, 5.05), (-0.5, 5.0), (5.0, 12.0)], ids=["wall of the map", "left of the map", "above the map"]
)
def test_points_that_the_map_explains_or_does_not_have_are_not_reported(x, y):
    assert report([(x, y), (x, y + 0.01)]).points == []


def test_only_the_nearest_cells_are_reported():
    far = [point for x in (5.5, 6.5, 7.5, 8.5, 4.0) for point in [(x + 0.02, 5.02), (x + 0.04, 5.04)]]
    assert [x for x, _ in report(far).points] == pytest.approx([5.55, 4.05, 6.55])


@pytest.mark.parametrize("change", [{"status": "weak"}, {"turning": 0.6}, {"scan_age": 0.6}, {"scan": None}])
def test_no_report_while_the_pose_or_scan_is_not_good_enough(change):
    assert report(TWO) is not None
    assert report(TWO, **change) is None


def test_place_that_the_robot_could_not_pass_is_reported_although_the_lidar_sees_nothing_there():
    localizer, reporter = FakeLocalizer(TWO), ObstacleReporter(600.0, 1, 0.17)
    bar = np.array([(5.45, 4.81), (5.45, 4.9), (5.45, 5.0)])
    reported = reporter.report(localizer, replica(), 0.1, Moment(0.0, 1_000.0), bar)
    assert reported.points == [pytest.approx(p) for p in ((6.05, 5.05), (5.45, 4.85), (5.45, 4.95), (5.45, 5.05))]
    assert reporter.is_self_reported(bar, 601.9).all()


def test_obstacles_of_others_are_left_out_and_own_ones_repeated_until_forgotten():
    reporter, blocked = ObstacleReporter(10.0, 3, 0.17), replica()
    blocked.cost[45:56, 55:66] = 254
    assert report(TWO, copy=blocked).points == []
    assert len(report(TWO, reporter=reporter).points) == 1
    assert len(report(TWO, copy=blocked, reporter=reporter, now=11.9).points) == 1
    assert report(TWO, copy=blocked, reporter=reporter, now=24.0).points == []


def test_view_gives_the_nearest_return_of_each_sector_and_zero_without_one():
    points = np.array([(7.0, 5.01), (6.04, 5.01), (5.01, 8.0)])
    seen = view(HERE, points, GEOMETRY)
    assert (seen.x, seen.y) == (5.0, 5.0)
    assert [seen.reach[0] * REACH_UNIT_M, seen.reach[44] * REACH_UNIT_M] == pytest.approx([1.0, 3.0])
    assert sum(reach > 0 for reach in seen.reach) == 2
    (far,) = np.flatnonzero(list(view(HERE, np.array([(25.0, 5.01)]), GEOMETRY).reach))
    assert (far, view(HERE, np.array([(25.0, 5.01)]), GEOMETRY).reach[far]) == (0, 255)
    assert view(Pose2(-1.0, 5.0, 0.0), points, GEOMETRY) is None
    assert view(None, points, GEOMETRY) is None


# --- blocked places ---


def places(hazards=(), zones=(), off=()):
    found = BlockedPlaces()
    at = Moment(0.0, 0.0)
    for state, polygon in hazards:
        area = AreaHazard(
            area="z4", state=state, severity=1, penalty=254, since=0.0, seq=1, epoch=1, cause="", nodes={}
        )
        found.handlers()[ch.HAZARD]({}, HazardArea(hazard=area, polygon=polygon, label="Z4"), at)
    active = [zone.id for zone in zones if zone.enabled and zone.id not in off]
    found.handlers()[ch.ZONES]({}, ZoneSet(epoch=1, seq=1, zones=list(zones), active=active), at)
    return found


def lethal():
    copy = replica()
    copy.cost[50, 50] = 254
    return copy


SQUARE = [(4.0, 4.0), (6.0, 4.0), (6.0, 6.0), (4.0, 6.0)]


@pytest.mark.parametrize(
    ("shape", "inside"),
    [
        (CircleShape(centre=(5.0, 5.5), radius=0.6), True),
        (CircleShape(centre=(5.0, 5.7), radius=0.6), False),
        (RectangleShape(corner=(6.0, 6.0), opposite=(4.0, 4.0)), True),
        (RectangleShape(corner=(6.0, 6.0), opposite=(5.5, 4.0)), False),
        (CorridorShape(line=[(0.0, 5.4), (9.0, 5.4)], width=1.0), True),
        (CorridorShape(line=[(0.0, 5.6), (9.0, 5.6)], width=1.0), False),
    ],
)
def test_a_zone_of_any_shape_is_named_only_by_a_robot_inside_it(shape, inside):
    zone = Zone(id="wet", kind="BLOCKED", shape=shape, reason="mopped")
    description = places(zones=[zone]).containing(HERE, lethal(), ObstacleReporter(10.0, 3, 0.17), 0.0)
    assert description == ("the no-go zone wet (mopped)" if inside else "a blocked part of the map")


@pytest.mark.parametrize("changes", [{"enabled": False}, {"kind": "PENALTY", "factor": 2.0}])
def test_only_zones_that_block_are_named(changes):
    zone = Zone(**{"id": "wet", "kind": "BLOCKED", "shape": CircleShape(centre=(5.0, 5.0), radius=1.0), **changes})
    assert (
        places(zones=[zone]).containing(HERE, lethal(), ObstacleReporter(10.0, 3, 0.17), 0.0)
        == "a blocked part of the map"
    )


@pytest.mark.parametrize(
    ("state", "description", "caution"),
    [("blocked", "the blocked area Z4", False), ("unknown", "the unknown area Z4", True), ("clear", None, False)],
)
def test_an_area_is_named_by_its_label_unless_it_is_clear(state, description, caution):
    found = places(hazards=[(state, SQUARE)])
    assert found.containing(HERE, lethal(), ObstacleReporter(10.0, 3, 0.17), 0.0) == (
        description or "a blocked part of the map"
    )
    assert found.only_watched(HERE, lethal())
    assert not found.only_watched(Pose2(1.0, 1.0, 0.0), lethal())
    assert (found.caution(HERE) is not None) == caution
    assert found.caution(Pose2(1.0, 1.0, 0.0)) is None


@pytest.mark.parametrize(("edge", "watched"), [(5.0, True), (4.9, False)])
def test_cell_that_an_area_or_a_zone_only_touches_is_blocked_by_it(edge, watched):
    shape = RectangleShape(corner=(4.0, 4.0), opposite=(edge, 6.0))
    beside, zone = [(4.0, 4.0), (edge, 4.0), (edge, 6.0), (4.0, 6.0)], Zone(id="wet", kind="BLOCKED", shape=shape)
    inside = Pose2(5.03, 5.03, 0.0)
    assert places(hazards=[("blocked", beside)]).only_watched(inside, lethal()) == watched
    assert not places(hazards=[("blocked", beside)], zones=[zone]).only_watched(inside, lethal())


def test_only_the_map_decides_whether_a_place_is_blocked():
    found, reporter = places(hazards=[("blocked", SQUARE)]), ObstacleReporter(10.0, 3, 0.17)
    assert found.containing(HERE, replica(), reporter, 0.0) is None
    beside_a_wall = lethal()
    beside_a_wall.static[50, 50] = 254
    assert found.containing(HERE, beside_a_wall, reporter, 0.0) is None
    assert found.containing(Pose2(-5.0, math.pi, 0.0), lethal(), reporter, 0.0) is None


def test_robot_does_not_stop_for_an_obstacle_that_it_reported_under_itself():
    reporter = ObstacleReporter(10.0, 3, 0.17)
    assert report([(5.02, 5.02), (5.04, 5.04)], reporter=reporter).points
    assert places().containing(HERE, lethal(), reporter, 0.0) is None
    assert places().containing(HERE, lethal(), reporter, 13.0) == "a blocked part of the map"


def test_zone_that_is_not_in_force_is_no_reason_to_stop_for_an_own_obstacle():
    reporter = ObstacleReporter(10.0, 3, 0.17)
    assert report([(5.02, 5.02), (5.04, 5.04)], reporter=reporter).points
    zone = Zone(id="nights", kind="BLOCKED", shape=CircleShape(centre=(5.0, 5.0), radius=1.0))
    assert places(zones=[zone]).containing(HERE, lethal(), reporter, 0.0) == "the no-go zone nights"
    assert not places(hazards=[("blocked", SQUARE)], zones=[zone]).only_watched(HERE, lethal())
    assert places(zones=[zone], off=["nights"]).containing(HERE, lethal(), reporter, 0.0) is None
