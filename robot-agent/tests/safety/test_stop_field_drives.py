"""A robot that is commanded into walls and gaps that only its lidar sees never touches them, whoever commands.

`FOGNAV_TEST_STOP_FIELD_SEEDS` is the number of drives of each kind.
"""

from __future__ import annotations

import math
import os
from collections import deque

import numpy as np
import pytest

from fog_contracts.grid import GridGeometry
from fog_contracts.messages import Pose, SimObstacle
from fog_contracts.robot import BaseSettings, LidarSettings, RobotSettings
from fog_contracts.site import RobotSite
from fognav_sim.floor import Floor
from fognav_sim.sensors import Noise
from fognav_sim.world import World
from robot_agent.agent.motion_guard import MotionGuard
from robot_agent.config import agent_config
from robot_agent.hardware import DriveTrain, LidarSamples, LidarTraits
from robot_agent.localization.localizer import Localizer
from robot_agent.localization.odometry import integrate

SEEDS = int(os.environ.get("FOGNAV_TEST_STOP_FIELD_SEEDS", "20"))
AXLE = 0.235


def config_of(turns_per_s=5.5, latency_s=0.0):
    """Return the configuration of a robot whose lidar turns so often, and is so late."""
    return agent_config(
        "r1", b"", DriveTrain(axle_m=AXLE, wheel_speed_max_m_s=0.5),
        LidarTraits(range_min_m=0.15, range_max_m=12.0, scan_period_s=1 / turns_per_s), boot="b",
        settings=RobotSettings(base=BaseSettings(driver="b"), lidar=LidarSettings(driver="l", latency_s=latency_s)),
    )  # fmt: skip


STEP_S = 0.01
NOISE = Noise(range_sigma=0.01, range_share=0.0, lidar_dropout=0.02, wheel_diameter=0.0)


class Driven:
    """A simulated body with a lidar of 2000 samples/s, 5.5 turns/s by default; its wheels obey a guard."""

    def __init__(self, obstacles, seed, pose=(1.5, 2.0, 0.0), turns_per_s=5.5, latency_s=0.0):
        geometry = GridGeometry(100, 80, 0.05, 0.0, 0.0)
        cells = np.zeros(geometry.shape, np.uint8)
        x, y, theta = pose
        body = RobotSite(id="r1", start=Pose(x=x, y=y, theta=theta), radius=0.17)
        self.world = World(Floor(geometry, cells), body, seed, axle_m=AXLE, noise=NOISE)
        for number, polygon in enumerate(obstacles):
            self.world.place(SimObstacle(id=f"o{number}", polygon=polygon, height=1.0))
        self.localizer = Localizer()
        self.guard = MotionGuard(config_of(turns_per_s, latency_s), self.localizer)
        self.now = 10.0
        self.odom = (0.0, 0.0, 0.0)
        self.wheels = (0.0, 0.0)
        self._head = 0.0
        self._step_rad = math.tau * turns_per_s / 2000.0
        self._latency_s = latency_s
        self._on_their_way = deque()
        self._steps = 0

    def drive(self, seconds, command):
        """Stream `command(driven)` 20 times a second through the guard, changing by at most 2.5 m/s2."""
        for _ in range(round(seconds / STEP_S)):
            self._steps += 1
            left, right = self.world.step(STEP_S)
            self.now += STEP_S
            self.odom = integrate(*self.odom, left, right, AXLE)
            if self._steps % 4 == 0:
                self.localizer.on_odometry(self.now, *self.odom)
            if self._steps % 2 == 0:
                self._measure(40)
            if self._steps % 5 == 0:
                wanted = [np.clip(w, s - 0.125, s + 0.125) for w, s in zip(command(self), self.wheels, strict=True)]
                self.wheels = self.guard.limit((float(wanted[0]), float(wanted[1])), self.now)
                self.world.set_wheels(*self.wheels)

    def _measure(self, count):
        clockwise = self._head + np.arange(1, count + 1) * self._step_rad
        self._head = float(clockwise[-1])
        angles = (-clockwise + math.pi) % math.tau - math.pi
        ranges = self.world.lidar(angles, self.now)
        self._on_their_way.append(
            LidarSamples(angles.astype(np.float32), ranges.astype(np.float32), self.now - 2 * STEP_S, self.now)
        )
        while self._on_their_way and self._on_their_way[0].ended_at <= self.now - self._latency_s:
            self.guard.on_samples(self._on_their_way.popleft())


def rectangle(left, bottom, right, top):
    return [(left, bottom), (right, bottom), (right, top), (left, top)]


def wall_with_gap(width):
    """A wall 1 m ahead, 0.2 m thick, with a gap in the middle."""
    return [rectangle(2.5, 0.2, 2.7, 2.0 - width / 2), rectangle(2.5, 2.0 + width / 2, 2.7, 3.8)]


def steer_at_the_gap(driven):
    """Drive at full speed at the middle of the wall, whatever is there."""
    x, y, theta = driven.world.pose
    error = math.remainder(math.atan2(2.0 - y, 3.5 - x) - theta, math.tau)
    turn = 0.5 * AXLE * float(np.clip(3.0 * error, -1.0, 1.0))
    return 0.3 - turn, 0.3 + turn


@pytest.mark.parametrize("seed", range(SEEDS))
def test_gap_of_any_width_is_driven_at_without_contact(seed):
    width = 0.20 + 0.40 * (seed % 21) / 20
    offset = 0.15 * math.sin(seed)
    driven = Driven(wall_with_gap(width), seed, pose=(1.5, 2.0 + offset, -offset))
    driven.drive(8.0, steer_at_the_gap)
    assert driven.world.contacts == 0, f"touched a wall at a gap of {width:.2f} m"
    if width < 0.34:
        assert driven.world.pose[0] < 2.5
        assert driven.wheels[0] + driven.wheels[1] < 0.05


@pytest.mark.parametrize(
    ("turns_per_s", "latency_s"), [(5.5, 0.3), (5.5, 0.5), (1.5, 0.0), (1.5, 0.4)], ids=lambda value: f"{value:g}"
)
def test_wall_is_not_touched_by_a_robot_whose_lidar_turns_slowly_or_is_late(turns_per_s, latency_s):
    driven = Driven(wall_with_gap(0.0), 3, (1.5, 2.0, 0.0), turns_per_s, latency_s)
    driven.drive(2.0, lambda _: (0.0, 0.0))
    driven.drive(8.0, lambda _: (0.3, 0.3))
    assert driven.world.contacts == 0
    assert driven.guard.reason is not None
    assert driven.wheels == (0.0, 0.0)


@pytest.mark.parametrize("seed", range(SEEDS))
def test_random_commands_in_a_narrow_box_never_touch_it(seed):
    rng = np.random.default_rng(seed)
    box = [
        rectangle(1.0, 1.5, 2.0, 1.55), rectangle(1.0, 2.45, 2.0, 2.5),
        rectangle(1.0, 1.5, 1.05, 2.5), rectangle(1.95, 1.5, 2.0, 2.5), rectangle(1.7, 1.8, 1.75, 1.85),
    ]  # fmt: skip
    driven = Driven(box, seed, pose=(1.4, 2.1, seed))
    driven.drive(0.4, lambda _: (0.0, 0.0))
    for _ in range(12):
        wheels = rng.uniform(-0.4, 0.4, 2)
        driven.drive(0.7, lambda _, wheels=wheels: wheels)
    assert driven.world.contacts == 0
    assert driven.world.distance > 0.05, "it never moved"


def test_gap_wide_enough_is_passed():
    driven = Driven(wall_with_gap(0.50), 1)
    driven.drive(12.0, steer_at_the_gap)
    assert driven.world.contacts == 0
    assert driven.world.pose[0] > 2.9


def test_person_who_steps_in_front_is_not_run_over():
    driven = Driven([], 3)
    driven.drive(2.0, lambda _: (0.3, 0.3))
    x, y, _ = driven.world.pose
    driven.world.place(SimObstacle(id="leg", polygon=rectangle(x + 0.45, y - 0.05, x + 0.55, y + 0.05), height=1.0))
    driven.drive(3.0, lambda _: (0.3, 0.3))
    assert driven.world.contacts == 0
    assert driven.wheels == (0.0, 0.0)
    driven.world.remove("leg")
    driven.drive(1.5, lambda _: (0.3, 0.3))
    assert driven.wheels == (0.3, 0.3)
