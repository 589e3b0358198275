"""The live process and lockstep get a robot's configuration from one function."""

from __future__ import annotations

from fog_contracts.messages import Pose
from fog_contracts.site import RobotSite
from robot_agent.config import AgentConfig, agent_config

KEY = b"k" * 32
BODY = RobotSite(id="r1", start=Pose(x=0.0, y=0.0, theta=0.0), radius=0.25, height=0.5)


def test_site_sets_radius_height_and_inscribed_radius():
    config = agent_config("r1", KEY, BODY, obstacle_ttl=30.0)
    assert (config.robot, config.operator_key, config.obstacle_ttl) == ("r1", KEY, 30.0)
    assert (config.radius, config.height, config.motion.inflation.inscribed_radius) == (0.25, 0.5, 0.25)


def test_defaults_apply_without_a_site():
    assert agent_config("r1", KEY) == AgentConfig(robot="r1", operator_key=KEY)
    assert agent_config("r1", KEY, obstacle_ttl=30.0).obstacle_ttl == 30.0
