"""Maps of logs that Fognav's own robots wrote: of a drive through a building, without knowing its map."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest

from fog_contracts.costs import LETHAL
from fog_contracts.messages import Pose, RobotGoal
from fog_kernels.distance import squared_distance_capped
from fog_mapping.poses import between, compose, place
from fog_runtime.configuration.site import load_site
from fognav.output import WrongUseError
from fognav_experiments.lidar_logs.logs import read_log
from fognav_experiments.lidar_logs.mapping import map_log
from fognav_experiments.lockstep import LockstepDrive
from fognav_sim.sensors import Noise
from robot_agent.agent.recording.input_log import LoggedAgent
from robot_agent.agent.recording.input_writer import InputWriter

ESTIG = Path(__file__).parents[2] / "sites" / "estig"


@pytest.fixture(scope="module")
def logged(tmp_path_factory):
    """The log of a robot that visits places of the thesis's floor, and its first true pose."""
    file, site = tmp_path_factory.mktemp("log") / "agent.mcap", load_site(ESTIG)
    start = site.site.robots[0].start
    assert start is not None
    with InputWriter(file, queue_limit=10**6) as writer:
        goals = [Pose(x=each.x, y=each.y, theta=0.0) for each in list(site.site.places.values())[:2]] + [start]
        run = LockstepDrive(
            site, start, RobotGoal(goal_id="g0", pose=goals[0]), 1, Noise(), watched=False, hazard=None, bus=None,
            make_agent=partial(LoggedAgent, write=writer.write),
        )  # fmt: skip
        assert run.warm_up() is None
        run.start()
        for number, pose in enumerate(goals):
            run.system.fog.planner.set_goal(run.robot.id, RobotGoal(goal_id=f"g{number}", pose=pose), any_heading=True)
            until = run.now + 300.0
            while run.now < until and np.hypot(run.world.pose[0] - pose.x, run.world.pose[1] - pose.y) > 0.3:
                run.step()
    return file, np.array((start.x, start.y, start.theta)), site.map


@pytest.mark.drive
def test_walls_of_the_map_stand_where_those_of_the_building_stand(logged):
    file, start, building = logged
    made = map_log(read_log(file).scans, "matched", [], 0.05, 12.0)
    walls = made.map.geometry.centres(np.argwhere(made.map.cells == LETHAL)[:, ::-1].astype(np.int64))
    walls = place(compose(start, between(made.poses[0], np.zeros(3))), walls) - start[:2]
    solid = (building.cells == LETHAL).astype(np.uint8)
    away = np.sqrt(squared_distance_capped(solid, 40)) * building.geometry.resolution
    # The map lies as the first scan does, by some thousandths of a radian turned.
    off = min(
        (building.geometry.sample(away, place(np.array((*start[:2], turn)), walls), 2.0)
         for turn in np.linspace(-0.01, 0.01, 41)),
        key=np.mean,
    )  # fmt: skip
    assert len(walls) > 5000
    assert (off <= 0.05).mean() > 0.9
    assert (off <= 0.1).mean() > 0.97  # 97.7 % of the way that it took when this was written


def test_recording_that_is_no_log_of_an_agent_is_refused(tmp_path):
    (tmp_path / "other.mcap").write_bytes(b"nothing")
    with pytest.raises(WrongUseError, match=r"not an MCAP file.*Name the file that `fognav map record` wrote"):
        read_log(tmp_path / "other.mcap")
