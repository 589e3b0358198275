"""The whole agent when its pose is in doubt: encoders that jump, suspension, and corridors without features."""

from __future__ import annotations

import math

import numpy as np
import pytest
from little_world import LittleWorld

from fog_contracts import channels as ch
from fog_contracts.messages import PolygonShape, Pose, Zone, ZoneSet
from robot_agent.localization.pose import AbsoluteObservation, Pose2

PLAIN_CORRIDOR = {"rooms": [(1.0, 1.0, 61.0, 3.0)], "size": (62.0, 4.0)}
TICKS_PER_M = 508.8 / (math.pi * 0.072)


def push(world, distance, *, counted):
    """Move the robot forward at once; the encoders count it if the wheels rolled."""
    world.x += distance * math.cos(world.theta)
    world.y += distance * math.sin(world.theta)
    if counted:
        world.ticks = [ticks + distance * TICKS_PER_M for ticks in world.ticks]


def test_jump_of_the_encoders_makes_the_pose_weak_until_the_lidar_has_found_the_robot_again():
    world = LittleWorld().ready()
    push(world, 0.9, counted=True)
    world.run(0.1)
    assert world.error()[0] > 0.8
    assert world.agent.localizer.status == "weak"
    assert world.agent.encoder_faults == 1
    world.run(0.1)
    assert world.state().mode == "HOLD"
    assert any("encoders jumped" in reason for reason in world.state().reasons)
    assert world.run(6.0, lambda w: w.state().mode == "NORMAL"), world.state().reasons
    assert world.error()[0] < 0.1


def test_robot_that_was_moved_while_its_computer_was_suspended_finds_its_place_again():
    world = LittleWorld().ready()
    push(world, 0.5, counted=False)
    world.agent.on_suspension(30.0)
    assert world.agent.localizer.status == "weak"
    assert "suspended for 30.0 s" in world.agent.localizer.detail
    assert world.run(6.0, lambda w: w.agent.localizer.status == "good")
    assert world.error()[0] < 0.1


@pytest.mark.parametrize("offset", [0.0, 6.0])
def test_pose_given_in_a_plain_corridor_is_never_good_since_the_lidar_cannot_confirm_it(offset):
    world = LittleWorld(**PLAIN_CORRIDOR, pose=(28.0, 2.0, 0.0))
    world.agent.load(world.master.snapshot(), world.now)
    world.run(0.6)
    assert world.command("initial_pose", pose=Pose(x=world.x + offset, y=2.1, theta=0.05)).accepted
    for _ in range(10):
        world.run(0.3)
        assert world.agent.localizer.status != "good"
    assert world.error()[0] == pytest.approx(offset, abs=0.2)
    covariance = world.agent.localizer.covariance()
    assert math.sqrt(covariance[0, 0]) > 0.45
    assert math.sqrt(covariance[1, 1]) < 0.1
    assert world.command("enable").accepted
    world.run(0.2)
    assert world.state().mode == "DEGRADED"
    assert any("in one direction" in reason for reason in world.state().reasons)


@pytest.mark.parametrize("driven", [True, False])
@pytest.mark.parametrize("jump", [0.9, 5.0])
def test_jump_of_the_encoders_along_a_plain_corridor_stays_uncertain_since_no_scan_tells_how_far_it_was(jump, driven):
    world = LittleWorld(**PLAIN_CORRIDOR, pose=(28.0, 2.0, 0.0))
    world.agent.load(world.master.snapshot(), world.now)
    world.run(0.6)
    observation = AbsoluteObservation(Pose2(28.0, 2.0, 0.0), np.diag([0.01, 0.01, 0.001]), world.now)
    assert world.agent.on_absolute_observation(observation)
    world.run(3.0)
    assert world.command("enable").accepted
    world.x += jump if driven else 0.0
    world.ticks = [ticks + jump * TICKS_PER_M for ticks in world.ticks]
    for _ in range(20):
        world.run(0.3)
        error, sigma = world.error()[0], world.agent.localizer.uncertainty.along
        assert error < 2.6 * sigma, f"{error:.2f} m off, {sigma:.2f} m claimed"
        assert world.agent.localizer.status == "weak"
    assert world.state().mode == "HOLD", world.state().reasons


def test_robot_that_may_already_be_in_a_zone_ahead_holds_and_drives_away_from_it():
    world = LittleWorld(**PLAIN_CORRIDOR, pose=(28.0, 2.0, 0.0))
    world.agent.load(world.master.snapshot(), world.now)
    world.run(0.6)
    assert world.command("initial_pose", pose=Pose(x=28.0, y=2.0, theta=0.0)).accepted
    world.run(3.0)
    assert world.command("enable").accepted
    outline = [(28.7, 1.0), (30.0, 1.0), (30.0, 3.0), (28.7, 3.0)]
    zone = Zone(id="wet", kind="BLOCKED", shape=PolygonShape(points=outline))
    world.send(ch.ZONES, ZoneSet(epoch=7, seq=1, zones=[zone], active=["wet"]))
    world.block(28.7, 1.0, 30.0, 3.0)
    world.drive_to([(28.0, 2.0), (28.4, 2.0)])
    world.run(3.0)
    assert world.state().mode == "HOLD"
    assert any("may already be in the no-go zone wet" in reason for reason in world.state().reasons)
    assert world.x == pytest.approx(28.0, abs=0.05)
    world.drive_to([(28.0, 2.0), (26.0, 2.0)], goal_id="g2", plan_id=2)
    assert world.run(60.0, lambda w: w.x < 27.0), world.state().reasons
