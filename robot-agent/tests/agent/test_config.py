"""The live process and lockstep get a robot's configuration from one function."""

from __future__ import annotations

from dataclasses import replace

import pytest

from fog_contracts.messages import Pose
from fog_contracts.robot import (
    BaseSettings,
    LidarSettings,
    MotionSettings,
    OdometrySettings,
    PowerSettings,
    RobotSettings,
)
from fog_contracts.site import RobotSite
from fog_runtime.configuration.robot_file import default_robot
from robot_agent.config import agent_config
from robot_agent.footprint import Footprint
from robot_agent.guardian.__main__ import limits_of
from robot_agent.guardian.core import Limits
from robot_agent.hardware import DriveTrain, LidarTraits

KEY = b"k" * 32
BODY = RobotSite(id="r1", start=Pose(x=0.0, y=0.0, theta=0.0), radius=0.25, height=0.5)
BASE = DriveTrain(axle_m=0.3, wheel_speed_max_m_s=0.4)
LIDAR = LidarTraits(range_min_m=0.1, range_max_m=8.0, scan_period_s=0.2)


def test_site_sets_radius_height_and_inscribed_radius():
    config = agent_config("r1", KEY, BASE, LIDAR, BODY, boot="b1", obstacle_ttl=30.0)
    assert (config.robot, config.operator_key, config.obstacle_ttl) == ("r1", KEY, 30.0)
    assert (config.radius, config.height, config.motion.inflation.inscribed_radius) == (0.25, 0.5, 0.25)


def test_footprint_of_the_settings_replaces_the_circle_of_the_site():
    box = Footprint(((0.2, 0.15), (-0.1, 0.15), (-0.1, -0.15), (0.2, -0.15)))
    config = agent_config("r1", KEY, BASE, LIDAR, BODY, boot="b1", footprint=box)
    assert (config.footprint, config.height) == (box, 0.5)
    assert config.radius == pytest.approx(0.25)
    assert config.motion.inflation.inscribed_radius == pytest.approx(0.1)
    assert agent_config("r1", KEY, BASE, LIDAR, BODY, boot="b1").footprint == Footprint.circle(0.25)


def test_hardware_sets_axle_top_speed_ranges_and_how_long_a_scan_may_take():
    config = agent_config("r1", KEY, BASE, LIDAR, boot="b1")
    assert config.drive_train == BASE
    assert (config.motion.limits.axle, config.motion.limits.wheel_max) == (0.3, 0.4)
    assert (config.localization.range_min, config.localization.range_max) == (0.1, 8.0)
    assert config.safety.scan_lost == pytest.approx(2.4 * 0.2)
    fast = agent_config("r1", KEY, replace(BASE, wheel_speed_max_m_s=2.0), replace(LIDAR, scan_period_s=0.1), boot="b1")
    assert (fast.motion.limits.wheel_max, fast.safety.scan_lost) == (0.5, 0.45)


def test_every_setting_of_the_robot_file_reaches_the_configuration():
    settings = RobotSettings(
        base=BaseSettings(driver="b"),
        lidar=LidarSettings(driver="l", x_m=0.1, y_m=-0.02, yaw_rad=1.5),
        odometry=OdometrySettings(alphas=(0.1, 0.2, 0.3, 0.4)),
        motion=MotionSettings(
            speed_m_s=0.2,
            degraded_speed_m_s=0.08,
            turn_rad_s=1.5,
            acceleration_m_s2=0.5,
            turn_acceleration_rad_s2=0.9,
            jerk_m_s3=3.0,
            turn_jerk_rad_s3=8.0,
        ),
        power=PowerSettings(low_fraction=0.3, rest_after_s=90.0),
    )
    config = agent_config("r1", KEY, BASE, LIDAR, BODY, boot="b1", settings=settings)
    assert (config.battery_low, config.rest_after) == (0.3, 0.0)
    can_rest = replace(LIDAR, can_rest=True)
    assert agent_config("r1", KEY, BASE, can_rest, BODY, boot="b1", settings=settings).rest_after == 90.0
    limits, where = config.motion.limits, config.localization
    assert (limits.v_max, limits.w_max, limits.acc_v, limits.acc_w) == (0.2, 1.5, 0.5, 0.9)
    assert (config.motion.jerk_v, config.motion.jerk_w) == (3.0, 8.0)
    assert (limits.axle, limits.wheel_max) == (0.3, 0.4)
    safety = config.safety
    assert (safety.speed_normal, safety.speed_degraded, safety.speed_egress) == (0.2, 0.08, 0.08)
    assert (where.lidar_x, where.lidar_y, where.lidar_yaw, where.alphas) == (0.1, -0.02, 1.5, (0.1, 0.2, 0.3, 0.4))
    assert limits_of(settings.motion, 0.3) == Limits(linear=0.21, acceleration=0.76)


@pytest.mark.parametrize(("turn_rad_s", "stall"), [(2.75, 10.0), (0.8, 10.0), (0.5, 12.28), (0.2, 21.71)])
def test_robot_that_turns_slowly_has_the_time_to_turn_to_its_way_out(turn_rad_s, stall):
    parts = {"base": BaseSettings(driver="b"), "lidar": LidarSettings(driver="l")}
    settings = RobotSettings(**parts, motion=MotionSettings(turn_rad_s=turn_rad_s))
    found = agent_config("r1", KEY, BASE, LIDAR, boot="b1", settings=settings).safety.egress_stall
    assert found == pytest.approx(stall, abs=0.01)


def test_stop_field_remembers_two_turns_and_a_half_of_a_slow_or_late_lidar():
    late = RobotSettings(base=BaseSettings(driver="b"), lidar=LidarSettings(driver="l", latency_s=0.3))
    slow = replace(LIDAR, scan_period_s=0.4)
    assert agent_config("r1", KEY, BASE, replace(LIDAR, scan_period_s=0.1), boot="b1").stop_field.memory == 0.5
    assert agent_config("r1", KEY, BASE, slow, boot="b1").stop_field.memory == pytest.approx(1.0)
    assert agent_config("r1", KEY, BASE, slow, boot="b1", settings=late).stop_field.memory == pytest.approx(1.3)


def test_default_settings_are_the_defaults_of_agent_and_guardian():
    settings = default_robot().settings
    assert agent_config("r1", KEY, BASE, LIDAR, BODY, boot="b1", settings=settings) == agent_config(
        "r1", KEY, BASE, LIDAR, BODY, boot="b1"
    )
    assert limits_of(settings.motion, 0.235) == Limits()


def test_defaults_apply_without_a_site():
    config = agent_config("r1", KEY, BASE, LIDAR, boot="b1")
    assert (config.radius, config.height, config.obstacle_ttl) == (0.17, 0.35, 600.0)
