"""The robot starts without slip or jolt, does not waver, and arrives where and how it was sent.

FOGNAV_RIDE_SEEDS sets the number of drives. Lengths in m, angles in rad, times in s.
"""

import math
import os

import msgspec
import numpy as np
import pytest
import ring_site as ring

from fog_contracts import channels as ch
from fog_contracts.messages import Pose, RobotGoal
from fognav_experiments.rigs import System
from robot_agent.agent.core import AgentCore
from robot_agent.localization.pose import wrap

SEEDS = range(1, 1 + int(os.environ.get("FOGNAV_RIDE_SEEDS", "2")))
GOALS = [Pose(x=4.2, y=1.4, theta=1.57), Pose(x=1.5, y=6.3, theta=-0.6), Pose(x=2.6, y=1.2, theta=3.1)]
PERIOD_S = 0.05
TURNING_RAD_S = 0.05
"""A slower turn is no intent to turn."""


class RecordingAgent(AgentCore):
    """An agent that keeps the wheel speeds that it commands, twenty times a second."""

    def __init__(self, config, seed=0):
        super().__init__(config, seed)
        self.axle_m = config.drive_train.axle_m
        self.commands = []

    def stream(self, now, stamp):
        command = super().stream(now, stamp)
        self.commands.append((command.left, command.right))
        return command


@pytest.mark.parametrize("seed", SEEDS)
def test_robot_arrives_within_its_tolerances_and_drives_smoothly(seed):
    site, goal, agents, states = ring.ring_site(), GOALS[seed % len(GOALS)], [], []

    def make(config, number):
        agents.append(RecordingAgent(config, number))
        return agents[0]

    robot = msgspec.structs.replace(site.site.robots[0], start=ring.START)
    system = System(site, robot, seed, make_agent=make)
    system.bus.subscribe({ch.ROBOT_STATE: lambda _ids, state, _at: states.append(state) or ()})
    (agent,) = agents
    while agent.safety.mode != "NORMAL" and system.now < 15.0:
        system.step()
        if agent.safety.mode == "INIT" and agent.safety.reasons == ("waiting for an operator to enable",):
            system.robot.command("enable")
    began, before = system.now, len(agent.commands)
    system.fog.planner.set_goal(robot.id, RobotGoal(goal_id="ride", pose=goal))
    longest = 30.0 + 3.0 * math.dist((ring.START.x, ring.START.y), (goal.x, goal.y)) / 0.08
    settled = 0
    while settled < 50 and system.now - began < longest:
        system.step()
        arrived = any(state.goal_reached for state in states)
        settled = settled + 1 if arrived and agent.commands[-1] == (0.0, 0.0) else 0

    x, y, theta = system.world.pose
    assert (settled, system.world.contacts) == (50, 0)
    assert math.dist((x, y), (goal.x, goal.y)) <= 0.10
    assert abs(wrap(float(theta) - goal.theta)) <= 0.17
    wheels = np.array(agent.commands[before:])
    v, w = wheels.mean(axis=1), np.diff(wheels, axis=1)[:, 0] / agent.axle_m
    advancing = np.maximum(np.diff(np.abs(v)), 0.0) / PERIOD_S
    assert np.diff(np.abs(wheels), axis=0).max() / PERIOD_S <= 1.38, "a wheel slips"
    assert np.diff(advancing).max() / PERIOD_S <= 5.1, "a jolt"
    assert np.abs(v * w).max() <= 0.4, "too fast round a corner"
    # Most of them while it turns at its goal; a robot that wavers on its way has dozens.
    assert np.count_nonzero(np.diff(np.sign(w[np.abs(w) > TURNING_RAD_S]))) <= 6
