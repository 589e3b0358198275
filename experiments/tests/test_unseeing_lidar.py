"""A robot whose lidar does not see drives into no box: blind sector, missing returns, and replayed buffers."""

import pytest
import ring_site as ring

from fog_contracts.messages import SimObstacle

AHEAD = (-1.05, 1.05)


class Run(ring.Run):
    """The whole system, driving along the southern corridor, until the fault begins."""

    def __init__(self):
        super().__init__()
        self.enable()
        self.until(lambda: self.state.mode == "NORMAL", 5.0)
        self.send()
        self.until(lambda: self.world.pose[0] > 3.5, 30.0)

    def drive_on(self, seconds):
        """Put a box 1.2 m ahead, and go on; return the reasons that were told."""
        x, y, _ = self.world.pose
        box = [(x + 1.2, y - 0.3), (x + 1.6, y - 0.3), (x + 1.6, y + 0.3), (x + 1.2, y + 0.3)]
        self.world.place(SimObstacle(id="box", polygon=box))
        told, end = len(self.states), self.system.now + seconds
        while self.system.now < end:
            self.step()
        return "; ".join(reason for state in self.states[told:] for reason in state.reasons)


@pytest.mark.parametrize("fault", ["no returns", "blind sector", "buffer of 2", "buffer of 5"])
def test_robot_whose_lidar_does_not_see_the_box_stops_and_says_why(fault):
    run = Run()
    lidar = run.robot.hardware.lidar
    if fault == "no returns":
        run.world.no_return_rad = AHEAD
        expected = "the lidar sees nothing ahead"
    elif fault == "blind sector":
        lidar.blind_sector_rad = AHEAD
        expected = "no complete scan of the lidar"
    else:
        lidar.frozen, lidar.frozen_revolutions = True, int(fault[-1])
        expected = "the lidar repeats itself"
    reasons = run.drive_on(8.0)
    assert expected in reasons
    assert run.world.contacts == 0
    assert run.robot.agent.safety.cap == 0.0 or run.world.truth(0.0).left == 0.0
