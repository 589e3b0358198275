"""A robot that sees markers on the walls: what they tell of its place, and which of them it does not believe."""

from __future__ import annotations

import math
import re
from dataclasses import replace

import numpy as np
import pytest
from little_world import AGENT, LittleWorld

from fog_contracts.messages import Pose
from fog_contracts.site import MarkerSite
from robot_agent.agent.recording import input_log as log
from robot_agent.localization.markers import Sighting, robot_place
from robot_agent.localization.pose import Pose2, wrap

UP = math.pi / 2
LOWER = [(1, 1, 13, 3), (4, 3, 5.2, 3.6), (9, 3, 10, 3.6)]
TWINS = {"rooms": [*LOWER, *((x, y + 4, right, top + 4) for x, y, right, top in LOWER)], "size": (14.0, 8.0)}
"""Two corridors that are the same, 4 m apart."""
MARKERS = (
    MarkerSite(id=1, x=7.0, y=1.0, theta=UP),
    MarkerSite(id=2, x=7.0, y=5.0, theta=UP),
    MarkerSite(id=3, x=10.5, y=7.0, theta=-UP),
    MarkerSite(id=4, x=10.5, y=3.0, theta=-UP),
    MarkerSite(id=5, x=2.5, y=1.0, theta=UP),
)
SIGMAS = np.array((0.04, 0.04, 0.05))
AT_S = 0.5


class Seeing:
    """A robot with a camera, which sees the markers as they hang."""

    def __init__(self, pose, *, hang=MARKERS, known=MARKERS, start_agent=None, **world):
        config = replace(AGENT, localization=replace(AGENT.localization, markers=tuple(known)))
        more = {} if start_agent is None else {"start_agent": start_agent}
        self.world = LittleWorld(pose=pose, config=config, **TWINS | world, **more)
        self.hang = list(hang)
        self.rng = np.random.default_rng(5)
        self.seen = []

    def begin(self, x, y, theta):
        """Give the robot a pose, which its scans confirm, and enable it."""
        world = self.world
        world.agent.load(world.master.snapshot(), world.now)
        world.run(0.6)
        assert world.command("initial_pose", pose=Pose(x=x, y=y, theta=theta)).accepted
        world.run(3.0)
        assert world.agent.localizer.status == "good", world.agent.localizer.detail
        assert world.command("enable").accepted
        return self

    def look(self):
        """Take a picture: markers within 3 m and 0.7 rad of ahead that face the camera."""
        world = self.world
        at = Pose2(world.x, world.y, world.theta)
        for marker in self.hang:
            seen = Pose2(marker.x, marker.y, marker.theta).relative_to(at)
            bearing, incidence = math.atan2(seen.y, seen.x), wrap(seen.theta - math.atan2(-seen.y, -seen.x))
            if math.hypot(seen.x, seen.y) < 3.0 and abs(bearing) < 0.7 and abs(incidence) < 1.2:
                noisy = Pose2(*(np.array(seen) + SIGMAS * self.rng.standard_normal(3)).tolist())
                self.seen.append(marker.id)
                world.agent.on_sighting(Sighting(marker.id, noisy, np.diag(SIGMAS**2), world.now), world.now)

    def run(self, seconds, until=None):
        """Run, with pictures; return whether the condition became true."""
        for _ in range(round(seconds / AT_S)):
            self.world.run(AT_S)
            self.look()
            if until is not None and until():
                return True
        return until is None

    @property
    def status(self):
        return self.world.agent.localizer.status

    @property
    def reasons(self):
        return self.world.state().reasons

    def problems(self):
        return [reason for reason, code in zip(self.reasons, self.world.state().codes, strict=True) if "marker" in code]


def test_place_by_a_sighting_is_where_the_robot_sees_the_marker_from_and_as_certain():
    marker, robot = Pose2(4.0, 3.0, 1.0), Pose2(6.0, 3.5, -2.8)
    rng = np.random.default_rng(1)
    covariance = np.diag((0.02, 0.03, 0.02)) ** 2
    seen = marker.relative_to(robot)
    place = robot_place(marker, Sighting(1, seen, covariance, 0.0))
    assert place.pose == pytest.approx(robot)
    hung = rng.multivariate_normal(marker, np.diag((0.05, 0.05, 0.03)) ** 2, 4000)
    noisy = rng.multivariate_normal(seen, covariance, 4000)
    places = [
        robot_place(Pose2(*one), Sighting(1, Pose2(*two), covariance, 0.0)).pose
        for one, two in zip(hung, noisy, strict=True)
    ]
    assert place.covariance == pytest.approx(np.cov(np.array(places).T), abs=4e-4)


def test_robot_that_believes_to_be_in_the_other_of_two_equal_corridors_knows_itself_at_the_first_marker():
    robot = Seeing((3.0, 6.0, 0.0)).begin(3.0, 2.0, 0.0)
    assert robot.world.error()[0] == pytest.approx(4.0, abs=0.1)
    robot.world.drive_to([(3.0, 2.0), (10.0, 2.0)])
    assert robot.run(20.0, lambda: robot.world.error()[0] < 0.15)
    assert set(robot.seen) == {2}
    assert len(robot.seen) == 2
    robot.world.run(0.1)
    assert robot.world.state().mode == "PROTECTIVE_STOP"
    assert robot.run(2.0, lambda: robot.status == "good")
    assert robot.world.error()[0] < 0.15
    assert robot.problems() == []


def test_robot_that_is_carried_to_the_equal_corridor_after_it_has_seen_a_marker_knows_itself_at_the_next():
    robot = Seeing((4.5, 2.0, 0.0)).begin(4.5, 2.0, 0.0)
    robot.run(2.0)
    assert set(robot.seen) == {1}
    robot.seen.clear()
    robot.world.wheel_drop = True
    robot.world.run(0.5)
    robot.world.wheel_drop, robot.world.y = False, 6.0
    assert robot.run(3.0, lambda: robot.world.error()[0] < 0.15)
    assert robot.seen == [2, 2]


def test_robot_that_was_carried_without_any_sign_of_it_believes_the_second_marker_and_none_is_blamed():
    robot = Seeing((4.5, 2.0, 0.0)).begin(4.5, 2.0, 0.0)
    robot.run(1.0)
    robot.seen.clear()
    robot.world.y = 6.0
    robot.world.drive_to([(4.5, 2.0), (11.0, 2.0)])
    assert robot.run(40.0, lambda: robot.world.error()[0] < 0.2)
    assert set(robot.seen) == {2, 3}
    assert robot.run(3.0, lambda: robot.status == "good")
    assert robot.problems() == []


def test_marker_that_was_moved_to_the_same_place_of_the_equal_corridor_casts_doubt_until_another_one_decides():
    moved = MarkerSite(id=2, x=7.0, y=1.0, theta=UP)
    robot = Seeing((12.0, 2.0, math.pi), hang=[moved, *MARKERS[3:]]).begin(12.0, 2.0, math.pi)
    robot.world.drive_to([(12.0, 2.0), (3.0, 2.0)])
    worst = [0.0]
    assert robot.run(26.0, lambda: worst.append(robot.world.error()[0]) or 2 in robot.seen)
    robot.run(1.5)
    assert robot.status == "weak"
    assert any("marker 2 tells of another place that looks like this one" in reason for reason in robot.reasons)
    assert robot.problems() == []
    assert robot.run(40.0, lambda: worst.append(robot.world.error()[0]) or 5 in robot.seen)
    assert "marker 2 was seen at" in robot.problems()[0]
    assert robot.run(2.0, lambda: robot.status == "good")
    assert max(worst) < 0.2


def test_doubt_that_a_moved_marker_casts_ends_where_the_other_place_looks_otherwise():
    moved = MarkerSite(id=2, x=7.0, y=1.0, theta=UP)
    rooms = [*TWINS["rooms"], (1.2, 3.0, 2.2, 3.8)]
    robot = Seeing((12.0, 2.0, math.pi), hang=[moved, MARKERS[3]], rooms=rooms).begin(12.0, 2.0, math.pi)
    robot.world.drive_to([(12.0, 2.0), (2.0, 2.0)])
    assert robot.run(60.0, lambda: any("tells of another place" in reason for reason in robot.reasons))
    assert robot.run(60.0, robot.problems)
    assert robot.world.x > 2.0
    assert robot.run(2.0, lambda: robot.status == "good")
    assert robot.world.error()[0] < 0.2


def test_robot_that_was_switched_on_where_two_places_look_alike_is_found_by_a_marker():
    robot = Seeing((5.5, 6.0, 0.0))
    robot.world.agent.load(robot.world.master.snapshot(), robot.world.now)
    assert robot.world.run(12.0, lambda one: one.state().places)
    assert robot.run(3.0, lambda: robot.status == "good")
    assert robot.world.error()[0] < 0.15
    assert robot.world.state().places == []


def test_marker_narrows_a_pose_along_a_plain_corridor():
    corridor = {"rooms": [(1.0, 1.0, 61.0, 3.0)], "size": (62.0, 4.0)}
    marker = MarkerSite(id=1, x=30.0, y=1.0, theta=UP)
    robot = Seeing((28.0, 2.0, 0.0), hang=[marker], known=[marker], **corridor)
    world = robot.world
    world.agent.load(world.master.snapshot(), world.now)
    world.run(0.6)
    assert world.command("initial_pose", pose=Pose(x=28.4, y=2.0, theta=0.0)).accepted
    world.run(1.5)
    assert robot.status == "weak"
    robot.run(2.0)
    assert robot.status == "good"
    assert world.error()[0] < 0.2
    assert 0.05 < world.agent.localizer.uncertainty.along < 0.2  # one marker's sightings do not add up


@pytest.mark.parametrize(
    ("moved", "twice"),
    [({"x": 8.5}, False), ({"x": 13.0, "y": 2.0, "theta": math.pi}, False), ({"x": 8.5}, True)],
    ids=["along its wall", "to the end of the corridor", "doubled"],
)
def test_marker_that_hangs_elsewhere_than_the_site_says_is_reported_and_never_believed(moved, twice):
    wrong = MarkerSite(**{"id": 1, "x": 7.0, "y": 1.0, "theta": UP} | moved)
    robot = Seeing((3.0, 2.0, 0.0), hang=[wrong, *MARKERS[0 if twice else 1 :]]).begin(3.0, 2.0, 0.0)
    world = robot.world
    worst = [0.0]
    world.drive_to([(3.0, 2.0), (11.0, 2.0)])
    robot.run(26.0, lambda: worst.append(world.error()[0]))
    assert world.x > 10.5
    assert max(worst) < 0.2
    (problem,) = robot.problems()
    x, y = re.match(r"marker 1 was seen at \((.+), (.+)\), not at \(7.0, 1.0\) as the site says", problem).groups()
    assert math.hypot(float(x) - wrong.x, float(y) - wrong.y) < 0.25
    assert ("there are two of it" in problem) == twice
    assert world.state().mode == "NORMAL"


def test_marker_of_another_site_and_one_that_is_seen_too_badly_change_nothing():
    robot = Seeing((3.0, 2.0, 0.0)).begin(3.0, 2.0, 0.0)
    agent, now = robot.world.agent, robot.world.now
    before = agent.localizer.pose(now), agent.localizer.covariance().tolist()
    for marker, sigma in ((99, 0.01), (1, 2.0)):
        agent.on_sighting(Sighting(marker, Pose2(2.0, 0.0, math.pi), np.eye(3) * sigma**2, now), now)
    agent.on_sighting(Sighting(1, Pose2(2.0, 0.0, math.pi), np.eye(3) * 1e-4, now - 10.0), now)
    assert (agent.localizer.pose(now), agent.localizer.covariance().tolist()) == before


def test_sighting_changes_nothing_while_no_scan_can_check_it():
    robot = Seeing((5.5, 6.0, 0.0)).begin(5.5, 2.0, 0.0)
    robot.world.lidar_on = False
    robot.world.run(2.0)
    robot.run(2.0)
    assert len(robot.seen) == 4
    assert robot.world.error()[0] == pytest.approx(4.0, abs=0.1)
    robot.world.lidar_on = True
    robot.world.run(0.5)
    robot.run(1.0)
    assert robot.world.error()[0] < 0.2


def test_sightings_are_in_the_input_log_and_come_back_exactly():
    entries = []
    robot = Seeing((4.5, 2.0, 0.0), start_agent=lambda config, seed: log.LoggedAgent(config, seed, entries.append))
    robot.begin(4.5, 2.0, 0.0).run(1.0)
    (first, _) = [entry for entry in entries if isinstance(entry, log.MarkerSighted)]
    sighting = first.sighting()
    assert (sighting.marker, sighting.covariance.tolist()) == (1, np.diag(SIGMAS**2).tolist())
