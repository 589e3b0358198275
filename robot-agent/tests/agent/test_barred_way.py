"""An obstacle on the robot's path is reported from as far as the lidar sees, whole, and nothing where nothing stands.

The scans are those of a lidar with a beam in every degree, whose ranges err by 0.4 %, at poses whose heading errs.
"""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest
from little_world import grid_of

from fog_contracts.costs import LETHAL, Inflation
from fog_contracts.handlers import Moment
from fog_kernels.astar import Planner
from fog_kernels.inflation import inflate, inflation_table
from fog_kernels.raycast import cast
from robot_agent.agent.obstacle_reporter import ObstacleReporter
from robot_agent.config import LocalizationConfig
from robot_agent.localization.localizer import Pose2
from robot_agent.localization.map_fields import map_fields
from robot_agent.localization.pose import Uncertainty

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
