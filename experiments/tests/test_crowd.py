"""People walk about a robot and stand in its way: it touches none by its own motion, and arrives or says why not.

FOGNAV_CROWD_SEEDS sets the number of drives.
"""

import math
import os

import msgspec
import numpy as np
import pytest
import ring_site as ring

from fog_contracts.messages import SimObstacle
from fognav_experiments.comparison.drives import ExperimentSpec, RouteSpec
from fognav_experiments.comparison.people import PeopleDrive, people_drive, people_tasks
from fognav_experiments.comparison.people_page import publish
from fognav_experiments.comparison.records import DriveFiles
from planner.waits.blocks import Blocks

pytestmark = pytest.mark.timeout(900)
SEEDS = int(os.environ.get("FOGNAV_CROWD_SEEDS", "2"))
PEOPLE = 4
RADIUS_M = 0.18
"""Of a person, whom the lidar sees as one round thing."""
POLITE_M = 0.12
"""Nobody walks nearer than this to the robot: what comes nearer, the robot brought about."""
AROUND_M = (0.7, 2.5)
"""How far from the robot people are headed for."""
STEP_S = 0.1
CROWDED_S = 30.0
QUIET_S = 15.0
"""A robot that did not move for so long has a reason that it tells."""


class Person:
    """Walks from place to place near the robot, at a speed of its own; stops before walls, people and the robot."""

    def __init__(self, number, rng):
        self.id, self._rng = f"person-{number}", rng
        self.speed = rng.uniform(0.3, 1.2)
        self.place, self._target, self._waits = None, None, 0.0

    def _target_near(self, robot):
        away, angle = self._rng.uniform(*AROUND_M), self._rng.uniform(-math.pi, math.pi)
        return robot[0] + away * math.cos(angle), robot[1] + away * math.sin(angle)

    def walk(self, floor, robot, robot_radius, others):
        """Walk for a step; return whether the person has moved."""
        if self._waits > 0.0:
            self._waits -= STEP_S
            return False
        if self._target is None or self.place is None:
            self._target = self._target_near(robot)
        if self.place is None:
            step = self._target
        else:
            dx, dy = self._target[0] - self.place[0], self._target[1] - self.place[1]
            share = min(1.0, self.speed * STEP_S / max(math.hypot(dx, dy), 1e-9))
            step = self.place[0] + share * dx, self.place[1] + share * dy
        free = floor._nearest_wall(*step)[0] > RADIUS_M + 0.05
        apart = all(math.dist(step, other) > 2.0 * RADIUS_M for other in others)
        from_robot = math.dist(step, robot) - robot_radius - RADIUS_M
        if not (free and apart and from_robot > POLITE_M + self.speed * STEP_S) or step == self.place:
            self._target, self._waits = None, self._rng.uniform(0.0, 3.0)
            return False
        self.place = step
        return True

    def outline(self):
        """The person as an obstacle."""
        corners = [turn * math.tau / 12 for turn in range(12)]
        x, y = self.place
        points = [(x + RADIUS_M * math.cos(turn), y + RADIUS_M * math.sin(turn)) for turn in corners]
        return SimObstacle(id=self.id, polygon=points)


class Crowd:
    """The people around one robot."""

    def __init__(self, world, seed):
        rng = np.random.default_rng(seed)
        self.world, self.people = world, [Person(number, rng) for number in range(PEOPLE)]
        self.nearest = math.inf

    def walk(self):
        robot = self.world.pose[:2]
        for person in self.people:
            others = [other.place for other in self.people if other is not person and other.place is not None]
            if person.walk(self.world._floor, robot, self.world.robot.radius, others):
                self.world.place(person.outline())
            if person.place is not None:
                away = math.dist(person.place, robot) - RADIUS_M - self.world.robot.radius
                self.nearest = min(self.nearest, away)

    def leave(self):
        for person in self.people:
            self.world.remove(person.id)


@pytest.mark.parametrize("seed", range(SEEDS))
@pytest.mark.drive
def test_robot_among_walking_people_touches_none_and_arrives_or_says_why_it_stands(seed):
    run = ring.Run(seed=seed)
    run.enable()
    run.send()
    run.until(lambda: run.world.distance > 0.5, 20.0)
    world = run.world
    crowd = Crowd(world, seed)
    stood, before = 0.0, world.distance
    end = run.system.now + CROWDED_S
    while run.system.now < end and not run.state.goal_reached:
        crowd.walk()
        for _ in range(round(STEP_S / 0.01)):
            run.system.step()
        stood = 0.0 if world.distance > before + 0.002 else stood + STEP_S
        before = world.distance
        if stood > QUIET_S:
            assert run.state.reasons, run.state
        assert world.contacts == 0, run.state
    assert crowd.nearest < 0.6, "somebody came near"
    crowd.leave()
    # What it reported as an obstacle while people stood there is forgotten after two minutes.
    left, asked = run.system.now + 240.0, -math.inf
    while run.system.now < left and not run.state.goal_reached:
        run.system.step()
        # Somebody beside it in a watched area: it was blocked, and its sonars hear only the robot now. An operator who
        # sees that nobody is left lets it out.
        inside = run.state.mode == "PROTECTIVE_STOP" and "in_blocked" in run.state.codes
        if inside and run.system.now > asked + 5.0:
            asked = run.system.now
            assert run.robot.command("egress").accepted
        if run.state.mode in {"HOLD", "INIT"} and run.state.awaits_operator:
            assert run.robot.command("enable").accepted
    assert run.state.goal_reached, run.state
    assert world.contacts == 0


@pytest.mark.drive
def test_robot_that_somebody_passes_in_a_watched_area_goes_on_by_itself():
    run = ring.Run(seed=1)
    modes = set()
    run.enable()
    run.send()
    run.until(lambda: run.world.pose[0] > 7.2, 60.0)
    began, passer = run.system.now, Person(0, np.random.default_rng(1))
    while (walked := 0.8 * (run.system.now - began)) < 2.3:
        passer.place = 6.5 + walked, 1.3
        run.world.place(passer.outline())
        run.step()
        modes.add(run.state.mode)
    run.world.remove(passer.id)
    assert "PROTECTIVE_STOP" in modes, "the area is blocked round the robot"
    run.until(lambda: run.state.goal_reached, 60.0)
    assert run.world.contacts == 0


@pytest.mark.drive
def test_a_drive_among_people_tells_what_nodes_reported_of_them_and_what_they_cost(tmp_path, monkeypatch):
    known, restore = [], Blocks.restore
    monkeypatch.setattr(Blocks, "restore", lambda blocks, seen, now: (known.append(seen), restore(blocks, seen, now)))
    spec = ExperimentSpec(routes=[RouteSpec(start="west", goal="east", areas=["z1"])])
    drives = [people_drive(ring.ring_site(), "", task) for task in people_tasks(spec, 1, 1, [4])]
    assert all(drive.success and not drive.contacts for drive in drives), drives
    among, learned, alone = drives
    assert min(drive.closest_m for drive in drives) > 0.0
    assert [list(seen) for seen in known] == [[], [], ["z1"], []], "one planner has seen a drive before"
    assert known[2]["z1"].hours
    assert learned.learned
    found = among.episodes
    assert found.blocks
    assert found.passed >= found.passed_reported > 0
    assert found.missed_seen == 0, "who stands in a cone is seen"
    assert alone.episodes.blocks == 0, "without nodes nobody reports anything"
    files, others = (DriveFiles(tmp_path / name, PeopleDrive) for name in "ab")
    for drive in drives:
        files.write(drive)
    (tmp_path / "all").write_bytes(files.pack({}))
    others.unpack(tmp_path / "all")
    assert others.read() == drives
    free = msgspec.structs.replace(among, people=0, distance_m=among.distance_m - 1.5)
    page = publish([free, *drives], "fognav experiment people", {}, tmp_path)[0].read_text("utf-8")
    assert "| 4 | fog | 1, 1 | 1.50 | 0.00 |" in page
