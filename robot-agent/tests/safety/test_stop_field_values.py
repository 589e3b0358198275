"""The stop field's constants, sides and formulas, by literal values."""

from __future__ import annotations

import math

import numpy as np
import pytest

from robot_agent.config import StopFieldConfig
from robot_agent.footprint import Footprint
from robot_agent.hardware import DriveTrain
from robot_agent.safety.stop_field import StopField, turn_in_place


def field(*, corners=32, deceleration=1.0, top_speed=0.5, config=None):
    """A body with this many corners on a circle of 0.17 m."""
    ring = [math.tau * (number + 0.5) / corners for number in range(corners)]
    footprint = Footprint(tuple((0.17 * math.cos(angle), 0.17 * math.sin(angle)) for angle in ring))
    drive = DriveTrain(axle_m=0.235, wheel_speed_max_m_s=top_speed, deceleration_m_s2=deceleration)
    return StopField(footprint, drive, config or StopFieldConfig())


def point(distance, bearing=0.0):
    angle = math.radians(bearing)
    return np.array([[distance * math.cos(angle), distance * math.sin(angle)]])


@pytest.mark.parametrize(
    ("bearing", "side"),
    [
        (0.0, "ahead"), (40.0, "ahead"), (-40.0, "ahead"), (50.0, "to the left"), (90.0, "to the left"),
        (130.0, "to the left"), (140.0, "behind"), (179.0, "behind"), (-179.0, "behind"), (-140.0, "behind"),
        (-130.0, "to the right"), (-90.0, "to the right"), (-50.0, "to the right"),
    ],
)  # fmt: skip
def test_obstacle_too_near_is_named_by_its_side(bearing, side) -> None:
    body = field(corners=4)  # turning brings each of its corners nearer to something, and driving each of its sides
    found = {
        body.limit(wheels, point(0.172, bearing)).reason
        for wheels in ((0.2, 0.2), (-0.2, -0.2), (0.2, -0.2), (-0.2, 0.2))
    }
    near = {
        body.limit(wheels, point(0.135, bearing)).reason
        for wheels in ((0.2, 0.2), (-0.2, -0.2), (0.2, -0.2), (-0.2, 0.2))
    }
    assert (found | near) - {None} == {f"the lidar sees an obstacle {side}, too near to drive on"}


@pytest.mark.parametrize(
    ("share", "in_place"), [(0.0, True), (0.047, True), (0.0499, True), (0.0501, False), (0.052, False)]
)
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_wheels_mean_to_turn_in_place_below_a_twentieth_of_advance(share, sign, in_place) -> None:
    turning, mean = 0.2 * sign, 0.2 * share
    found = turn_in_place((mean - turning, mean + turning))
    if in_place:
        assert found == pytest.approx((-turning, turning))
    else:
        assert found is None
    assert (turn_in_place((-mean - turning, -mean + turning)) is not None) == in_place


def test_a_twentieth_itself_is_an_arc() -> None:
    left, right = -0.01615, 0.01785  # numbers whose mean and half difference are exact
    assert 0.5 * (left + right) == 0.05 * 0.5 * (right - left)
    assert turn_in_place((left, right)) is None


@pytest.mark.parametrize(("corners", "round_"), [(21, True), (20, False)])
def test_body_is_round_whose_corners_stand_out_by_less_than_2_mm(corners, round_) -> None:
    wheels = field(corners=corners).limit((-0.19, 0.205), point(0.165)).wheels
    assert (wheels == pytest.approx((-0.1975, 0.1975))) == round_


@pytest.mark.parametrize("deceleration", [0.25, 0.5, 2.0])
@pytest.mark.parametrize("clearance", [0.03, 0.05])
def test_speed_in_the_slow_zone_follows_the_brakes(deceleration, clearance) -> None:
    body = field(corners=4, deceleration=deceleration)
    left, right = body.limit((0.4, 0.4), point(0.17 * math.cos(math.pi / 4) + clearance)).wheels
    assert left == right
    assert 0.25 * left + left * left / (2.0 * deceleration) == pytest.approx(clearance - 0.02, abs=1e-6)


def test_speed_that_is_exactly_the_slowest_is_driven() -> None:
    slowed = field().limit((0.3, 0.3), point(0.2))
    assert slowed.zone == "slow"
    exact = field(config=StopFieldConfig(slowest=slowed.wheels[0]))
    assert exact.limit((0.3, 0.3), point(0.2)).zone == "slow"
    above = field(config=StopFieldConfig(slowest=slowed.wheels[0] * 1.0001))
    assert above.limit((0.3, 0.3), point(0.2)).zone == "stop"


def test_wheel_of_1_m_s_is_limited_like_any_other() -> None:
    assert field(top_speed=1.0).limit((1.0, 1.0), point(0.3)).zone == "slow"
    assert field(top_speed=1.0).limit((1.0, 0.5), point(0.3)).zone == "slow"
