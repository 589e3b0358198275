"""ROS 1's navigation drives the simulated robot. `FOGNAV_ROS1_NAVIGATION` names the folder in which it was built."""

import os
from pathlib import Path

import pytest

from fog_runtime.configuration.site import load_site
from fognav.output import WrongUseError
from fognav_experiments.comparison.drives import draw
from fognav_experiments.comparison.move_base import PROGRAMS, RosRobot
from fognav_experiments.comparison.runner import read_spec

SITE = Path(__file__).parents[2] / "sites" / "estig"
BUILT = os.environ.get("FOGNAV_ROS1_NAVIGATION", "")


@pytest.fixture
def route():
    loaded = load_site(SITE)
    return loaded, draw(read_spec(loaded, SITE), 1, 1)[0]


def test_missing_programs_of_ros_are_named(route, tmp_path: Path) -> None:
    with pytest.raises(WrongUseError, match=r"lib/move_base/move_base: build them"):
        RosRobot(tmp_path, *route, "default", 1.0)


@pytest.mark.skipif(not BUILT, reason="FOGNAV_ROS1_NAVIGATION names no folder `devel` with ROS 1's navigation")
@pytest.mark.timeout(900)
def test_navigation_of_ros_drives_the_simulated_robot_to_its_goal_and_its_processor_time_is_counted(route) -> None:
    with RosRobot(Path(BUILT), *route, "full", 2.0) as robot:
        drive = robot.drive(blocked=False)
    assert (drive.outcome, drive.contacts) == ("reached", 0)
    assert 60.0 <= drive.distance_m <= 100.0
    assert all(drive.cpu[name] > 0.0 for name in PROGRAMS)
