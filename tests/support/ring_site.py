"""A site of 15 x 8 m: a ring of corridors around a block, with two routes west to east, the southern one watched.

And the whole system on it, all cores in lockstep, with one robot.
"""

from pathlib import Path

import numpy as np

from fog_contracts import channels as ch
from fog_contracts.grid import GridGeometry, StaticMap
from fog_contracts.messages import Place, Pose, RobotGoal
from fog_contracts.site import AreaSite, DemoPlan, NodeSite, RobotSite, Site, Sonar
from fog_runtime.configuration.site import LoadedSite
from fognav_experiments.rigs import System

RESOLUTION = 0.05
FREE = [  # left, bottom, right, top (m): the ring, and niches that make every place look different
    (0.5, 0.5, 14.5, 2.5), (0.5, 5.5, 14.5, 7.5), (0.5, 0.5, 2.5, 7.5), (12.5, 0.5, 14.5, 7.5),
    (3.6, 2.5, 4.6, 3.2), (9.9, 2.5, 10.5, 3.6), (5.2, 5.0, 6.9, 5.5), (10.8, 4.7, 11.6, 5.5), (2.5, 3.9, 3.1, 4.7),
]  # fmt: skip
START = Pose(x=1.5, y=3.0, theta=-1.5707963)
GOAL = Place(x=13.5, y=3.2, theta=None)


def ring_site():
    geometry = GridGeometry(300, 160, RESOLUTION, 0.0, 0.0)
    cells = np.full(geometry.shape, 254, np.uint8)
    for box in FREE:
        left, bottom, right, top = (round(value / RESOLUTION) for value in box)
        cells[bottom:top, left:right] = 0
    area = AreaSite(id="z1", label="South", polygon=[(6.5, 0.5), (8.5, 0.5), (8.5, 2.5), (6.5, 2.5)], number=1)
    sonars = [Sonar(angle=angle, range_limit=1.65) for angle in (-0.22, 0.22)]
    node = NodeSite(id="n1", area="z1", x=7.5, y=0.55, theta=1.5707963, sonars=sonars)
    site = Site(
        id="ring",
        places={"west": Place(x=START.x, y=START.y, theta=START.theta), "east": GOAL},
        areas=[area],
        nodes=[node],
        robots=[RobotSite(id="r1", start=START, radius=0.17)],
        demo=DemoPlan(start="west", goal="east", areas=["z1"]),
    )
    return LoadedSite(site, StaticMap(geometry, cells), Path())


class Run:
    """The system of the ring, or of another site, whose states are recorded."""

    def __init__(self, site=None, seed=3, **parts):
        site = site or ring_site()
        self.system = System(site, site.site.robots[0], seed, **parts)
        self.world, self.robot = self.system.world, self.system.robot
        self.states = []
        self.system.bus.subscribe({ch.ROBOT_STATE: lambda _ids, state, _at: self.states.append(state) or ()})

    @property
    def state(self):
        """The latest state, None before the first."""
        return self.states[-1] if self.states else None

    def step(self):
        """Simulate 10 ms."""
        self.system.step()

    def until(self, condition, seconds):
        """Run until the condition holds, which must be so within this time."""
        end = self.system.now + seconds
        while not condition():
            assert self.system.now < end, self.state
            self.step()

    def enable(self):
        """Enable the robot once it waits for that."""
        self.until(lambda: self.state and self.state.reasons == ["waiting for an operator to enable"], 12.0)
        assert self.robot.command("enable").accepted

    def send(self, pose=None):
        """Send the robot to a pose in any heading, to the east of the ring by default."""
        goal = RobotGoal(goal_id="g1", pose=pose or Pose(x=GOAL.x, y=GOAL.y, theta=0.0))
        self.system.fog.planner.set_goal("r1", goal, any_heading=True)
