"""Nodes that save air, as a board does by default, tell nothing later than nodes that publish every reading."""

from dataclasses import replace

import msgspec
import pytest
import ring_site as ring

from fog_contracts import channels as ch
from fog_contracts.bus import Bus
from fog_contracts.handlers import Publication
from fog_contracts.messages import Pose, RobotPose, SimObstacle
from fognav_experiments.rigs import FogRig, moment
from fognav_sim.floor import Floor
from fognav_sim.world import World

BEFORE_LEFT_SONAR = (7.1, 1.6)
BEFORE_RIGHT_SONAR = (7.85, 1.6)


class Corridor:
    """The ring's fog node and its sensor node, with a robot that stands somewhere."""

    def __init__(self, *, every_reading=False):
        loaded = ring.ring_site()
        (node,) = loaded.site.nodes
        nodes = [msgspec.structs.replace(node, every_reading=every_reading)]
        loaded = replace(loaded, site=msgspec.structs.replace(loaded.site, nodes=nodes))
        robot = loaded.site.robots[0]
        self.world = World(Floor(loaded.map.geometry, loaded.map.cells), robot, 1, axle_m=0.235)
        bus = Bus(loaded.site.id)
        self.readings = []
        bus.subscribe({ch.NODE_READING: lambda _ids, reading, _at: self.readings.append(reading) or ()})
        self.fog = FogRig(loaded, self.world, bus, 1, 0.0)
        self.bus = bus
        self.steps = 0

    @property
    def now(self):
        return self.steps * 0.01

    @property
    def state(self):
        return self.fog.aggregator.core.announced()["z1"].state

    def step(self):
        self.steps += 1
        at = moment(self.now)
        self.fog.measure(self.now)
        if self.steps % 10 == 0:
            x, y, theta = self.world.pose
            pose = RobotPose(
                x=x, y=y, theta=theta, covariance=[0.0] * 9, v=0.0, w=0.0, stamp=at.stamp,
                radius=self.world.robot.radius, height=self.world.robot.height,
            )  # fmt: skip
            self.bus.publish([Publication(ch.ROBOT_POSE, pose, {"robot": self.world.robot.id})])
        self.fog.deliver(at)
        if self.steps % 10 == 0:
            self.fog.tick(at)

    def run(self, seconds):
        """Run for so long; return the readings that were published."""
        before, until = len(self.readings), self.now + seconds
        while self.now < until:
            self.step()
        return self.readings[before:]

    def seconds_until(self, state):
        began = self.now
        while self.fog.aggregator.core.announced().get("z1") is None or self.state != state:
            assert self.now - began < 10.0, f"z1 is still {self.state}"
            self.step()
        return self.now - began

    def put(self, place):
        x, y = place
        corners = [(x - 0.15, y - 0.15), (x + 0.15, y - 0.15), (x + 0.15, y + 0.15), (x - 0.15, y + 0.15)]
        self.world.place(SimObstacle(id="box", polygon=corners))


@pytest.fixture
def corridor():
    """A corridor that has been clear for a while."""
    made = Corridor()
    made.run(10.0)
    assert made.state == "clear"
    return made


def test_nodes_of_a_site_save_air_and_of_the_thesis_publish_every_reading(corridor):
    assert 9 <= len(corridor.run(10.0)) <= 11
    assert 75 <= len(Corridor(every_reading=True).run(10.0)) <= 105


def test_hazard_and_its_end_are_told_as_soon_as_by_every_reading(corridor):
    thesis = Corridor(every_reading=True)
    thesis.run(10.0)
    told = []
    for each in (corridor, thesis):
        each.put(BEFORE_LEFT_SONAR)
        began = each.seconds_until("blocked")
        each.run(10.0)
        each.world.remove("box")
        told.append((began, each.seconds_until("clear")))
    assert told[0] == pytest.approx(told[1], abs=0.15)
    assert told[0][0] < 0.4


def test_area_is_known_soon_after_a_restart_of_the_aggregator(corridor):
    corridor.fog.stop("aggregator")
    corridor.run(0.5)
    corridor.fog.start_again("aggregator", moment(corridor.now))
    assert corridor.state == "unknown"
    assert corridor.seconds_until("clear") < 1.5


@pytest.mark.parametrize("where", [BEFORE_RIGHT_SONAR, (7.35, 1.05)])
def test_person_beside_a_robot_is_a_hazard_at_once(where):
    """In the other sonar's cone, or nearer than the robot in the same one: the node is blocked before and after."""
    corridor = Corridor()
    corridor.world.kidnap(Pose(x=BEFORE_LEFT_SONAR[0], y=BEFORE_LEFT_SONAR[1] + 0.15, theta=0.0))
    corridor.run(10.0)
    assert {reading.state for reading in corridor.run(3.0)} == {"blocked"}
    assert corridor.state != "blocked", "it is the robot"
    corridor.put(where)
    assert corridor.seconds_until("blocked") < 0.5
