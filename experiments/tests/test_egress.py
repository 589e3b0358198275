"""A robot inside a no-go zone leaves it on an operator's command: agent, planner and map together."""

import math

import ring_site as ring

from fog_contracts.messages import RectangleShape, SimObstacle, Zone
from fognav_experiments.rigs import moment


class Run(ring.Run):
    """The whole system; a no-go zone is drawn around the robot as soon as it is enabled."""

    def __init__(self):
        super().__init__()
        self.speeds = []
        self.enable()
        self.until(lambda: self.state.mode == "NORMAL", 5.0)
        self.start = x, y, _ = self.world.pose
        shape = RectangleShape(corner=(x - 1.5, y - 0.6), opposite=(x + 1.5, y + 1.5))
        zone = Zone(id="wet", kind="BLOCKED", shape=shape, reason="wet floor")
        self.system.fog.map.put_zone(zone, moment(self.system.now))
        self.until(lambda: self.state.mode == "PROTECTIVE_STOP", 2.0)

    def step(self):
        super().step()
        if self.state and self.state.mode == "EGRESS":
            self.speeds.append(abs(self.world.truth(0.0).left + self.world.truth(0.0).right) / 2)

    @property
    def driven(self):
        x, y, _ = self.world.pose
        return math.hypot(x - self.start[0], y - self.start[1])


def test_robot_drives_out_of_a_zone_slowly_and_then_waits_for_an_enable():
    run = Run()
    assert "wet" in run.robot.command("enable").reason
    assert run.robot.command("egress").accepted
    run.until(lambda: run.state.mode == "EGRESS", 1.0)
    run.until(lambda: run.state.mode != "EGRESS", 40.0)
    assert run.state.reasons == ["the egress ended: the robot is out", "waiting for an operator to enable"]
    assert run.driven > 0.6
    assert max(run.speeds) <= 0.1 + 1e-3
    assert run.world.contacts == 0
    assert run.robot.command("enable").accepted


def test_robot_that_leaves_a_zone_stops_before_an_obstacle_and_gives_up():
    run = Run()
    assert run.robot.command("egress").accepted
    run.until(lambda: run.driven > 0.1, 15.0)
    x, y, theta = run.world.pose
    ahead = y + math.copysign(0.6, math.sin(theta))  # it drives along the corridor, to the north or south
    box = [(x - 0.6, ahead - 0.1), (x + 0.6, ahead - 0.1), (x + 0.6, ahead + 0.1), (x - 0.6, ahead + 0.1)]
    run.world.place(SimObstacle(id="box", polygon=box))
    run.until(lambda: run.state.mode != "EGRESS", 30.0)
    assert "came no nearer" in "; ".join(run.state.reasons)
    assert run.world.contacts == 0
