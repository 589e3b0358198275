"""Hazards that come and go do not move a robot to and fro between two ways.

The measure: a switch is a published path that leads another way than the one before. It is forced if the old path was
impassable on the map of that moment, else voluntary. A voluntary switch is justified if it saves the share of the cost
that the policy asks for, and if the last switch is longer ago than the dwell time, which doubles with every switch that
follows another within a minute. No robot may ever make a switch that is neither forced nor justified.

`FOGNAV_FLAPS` sets how many changes there are in all (default 400).
"""

from __future__ import annotations

import itertools
import math
import os
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from ring_map import RingMap, goal, pose, via

from fog_contracts import channels as ch
from fog_contracts.handlers import Moment
from fog_contracts.messages import RobotPath
from planner.config import PlannerConfig
from planner.core import PlannerCore
from planner.path_search import Route

if TYPE_CHECKING:
    from ring_map import Box

    from fog_contracts.messages import MapDelta

FLAPS = int(os.environ.get("FOGNAV_FLAPS", "400"))
RUNS = 4
CONFIG = PlannerConfig()
PLACES: list[Box] = [
    (9.0, 10.0, 11.0, 12.0), (5.0, 10.0, 6.0, 12.0), (9.0, 0.0, 11.0, 2.0), (14.0, 0.0, 15.0, 2.0),
    (8.0, 10.9, 8.6, 12.0), (8.0, 0.0, 8.6, 1.1),
]  # fmt: skip
"""The first four close a corridor of the ring, the others narrow it."""


@dataclass
class Count:
    """The switches of one drive: when each was made, and what it was."""

    forced: list[float] = field(default_factory=list)
    voluntary: list[float] = field(default_factory=list)
    unjustified: list[str] = field(default_factory=list)

    @property
    def all(self) -> list[float]:
        return sorted([*self.forced, *self.voluntary])


class Drive:
    """A robot on the ring, which drives along its path; every path that is published is checked."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.map = RingMap()
        self.core = PlannerCore(epoch=1)
        self.now = 100.0
        self.at = (1.0, float(self.rng.uniform(5.6, 6.4)))
        self.path: RobotPath | None = None
        self.count = Count()
        self.core.load(self.map.master.snapshot(), self.now)
        self.core.set_goal("r1", goal(19.0, 6.0))

    def flap(self) -> list[MapDelta]:
        """Put a hazard onto a place, or take it away."""
        name = str(self.rng.integers(len(PLACES)))
        if name in self.map.areas:
            return self.map.clear(name)
        penalty = int(self.rng.choice([254, 254, 254, 200]))
        return self.map.put(name, PLACES[int(name)], penalty)

    def step(self, seconds: float, deltas: list[MapDelta]) -> None:
        self.now += seconds
        moment = Moment(self.now, self.now)
        self.core.handlers()[ch.MAP_HEARTBEAT]({}, self.map.master.heartbeat(self.now), moment)
        self.core.handlers()[ch.ROBOT_POSE]({"robot": "r1"}, pose(*self.at), moment)
        for delta in deltas:
            self.core.handlers()[ch.MAP_DELTA]({}, delta, moment)
        for publication in self.core.tick(moment):
            if isinstance(publication.message, RobotPath):
                self.check(publication.message)
        for job in self.core.jobs(moment):
            job.run()
            self.core.add(job, self.now)

    def remaining(self, path: RobotPath) -> float:
        """Return the cost of the rest of a path on the newest map; infinite if it is impassable."""
        route = Route(np.array(path.points), 0.1)
        along, _ = route.nearest(*self.at)
        return route.cost(self.map.master.layers["cost"], self.map.geometry, along)

    def check(self, path: RobotPath) -> None:
        before, self.path = self.path, path
        if before is None or not before.points or not path.points or via(before) == via(path):
            return
        old, new = self.remaining(before), self.remaining(path)
        if math.isinf(old):
            self.count.forced.append(self.now)
            return
        dwell = self.dwell()
        if new > (1.0 - CONFIG.hysteresis) * old * 1.02:  # 2 % for the exact position on the path
            self.count.unjustified.append(f"at {self.now:.2f}: costs {new:.0f} instead of {old:.0f}")
        if self.count.all and self.now - self.count.all[-1] < dwell - 1e-6:
            self.count.unjustified.append(f"at {self.now:.2f}: {self.now - self.count.all[-1]:.2f} s after the last")
        self.count.voluntary.append(self.now)

    def dwell(self) -> float:
        """Return how long the last switch has to be ago, by the rule in the head of this file."""
        in_a_row = 0
        for earlier, later in itertools.pairwise([-math.inf, *self.count.all]):
            in_a_row = in_a_row + 1 if later - earlier < 60.0 else 1
        return min(CONFIG.switch_dwell_s * 2.0 ** max(0, in_a_row - 1), CONFIG.max_switch_dwell_s)


def test_robot_never_alternates_between_two_ways_faster_than_the_policy_allows() -> None:
    switches = flaps = 0
    for seed in range(RUNS):
        drive = Drive(seed)
        drive.step(0.1, [])
        begun = drive.now
        for _ in range(FLAPS // RUNS):
            deltas = drive.flap()
            flaps += 1
            drive.step(float(drive.rng.choice([0.05, 0.1, 0.3, 1.0])), deltas)
            for _ in range(int(drive.rng.integers(0, 3))):
                drive.step(0.5, [])
        count = drive.count
        assert count.unjustified == []
        # While hazards keep coming and going, what is not forced becomes seldom.
        assert len(count.voluntary) <= 5 + (drive.now - begun) / CONFIG.switch_dwell_s
        switches += len(count.all)
    assert flaps >= RUNS
    assert switches >= RUNS, "the hazards moved nobody: this test has tried nothing"


def test_hazard_that_flaps_beside_a_free_way_moves_the_robot_ever_more_seldom() -> None:
    drive = Drive(0)
    drive.at = (1.0, 9.0)  # far nearer to the upper corridor
    drive.core.set_goal("r1", goal(19.0, 9.0, "north"))
    drive.step(0.1, [])
    for _ in range(120):
        drive.step(0.5, drive.map.put("0", PLACES[0]))
        drive.step(0.5, drive.map.clear("0"))
    assert drive.count.unjustified == []
    # Every appearance would force the robot off the upper path if it had gone back to it: 120 times within 2 minutes.
    assert 1 <= len(drive.count.voluntary) <= 8
    assert len(drive.count.all) <= 16
