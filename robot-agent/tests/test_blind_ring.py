"""What a lidar that is mounted forward does not see any more, because it is too near, is not driven into."""

from __future__ import annotations

import pytest
from little_world import DRIVE_TRAIN, KEY, LIDAR, LittleWorld

from fog_contracts.messages import Pose
from fog_contracts.robot import BaseSettings, LidarSettings, RobotSettings
from fog_contracts.site import RobotSite
from robot_agent.config import agent_config
from robot_agent.footprint import Footprint

CIRCLE = Footprint.circle(0.17)
LONG = Footprint(((0.35, -0.25), (0.35, 0.25), (-0.35, 0.25), (-0.35, -0.25)))
HALL = [(1, 1, 9, 5), (3, 5, 4, 5.6), (9, 2, 10, 2.8)]


def hall(footprint, lidar_x, posts, seed=1):
    """A robot in a hall, with its lidar so far ahead of its axle, before posts that no map has."""
    lidar = LidarSettings(driver="l", x_m=lidar_x)
    settings = RobotSettings(base=BaseSettings(driver="b"), lidar=lidar)
    start = RobotSite(id="r1", start=Pose(x=2.0, y=3.0, theta=0.0), radius=0.17)
    config = agent_config("r1", KEY, DRIVE_TRAIN, LIDAR, start, boot="b1", footprint=footprint, settings=settings)
    return LittleWorld(HALL, (11.0, 6.0), (2.0, 3.0, 0.0), seed, config=config, posts=posts).ready()


def post(x, y, width=0.05):
    return (x, y - width / 2, x + width, y + width / 2)


@pytest.mark.parametrize(("lidar_x", "y"), [(0.10, 3.0), (0.12, 3.0), (0.13, 3.04)])
@pytest.mark.drive
def test_post_at_the_goal_is_not_touched_by_a_robot_whose_lidar_is_mounted_forward(lidar_x, y):
    world = hall(CIRCLE, lidar_x, [post(4.4, y)])
    world.drive_to([(2.0, 3.0), (4.5, 3.0)])
    world.run(25.0, lambda w: w.collided)
    assert not world.collided, (world.x, world.y, world.state().reasons)
    assert world.travelled > 1.9


@pytest.mark.drive
def test_legs_across_the_way_are_not_touched_by_a_long_body_with_its_lidar_at_the_front():
    world = hall(LONG, 0.30, [post(4.5, 3.0 + 0.35 * k, 0.04) for k in range(-5, 6)])
    world.drive_to([(2.0, 3.0), (7.0, 3.0)])
    world.run(20.0, lambda w: w.collided)
    assert not world.collided, (world.x, world.y, world.state().reasons)
    assert world.travelled > 1.9
