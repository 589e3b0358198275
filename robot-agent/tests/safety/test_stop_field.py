"""No command drives the footprint into what the lidar sees, and none is slower than that needs; values are literal."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from robot_agent.config import StopFieldConfig
from robot_agent.footprint import Footprint
from robot_agent.hardware import DriveTrain
from robot_agent.safety.stop_field import StopField, turn_in_place

DRIVE = DriveTrain(axle_m=0.235, wheel_speed_max_m_s=0.5, deceleration_m_s2=1.0)
CIRCLE = StopField(Footprint.circle(0.17), DRIVE, StopFieldConfig())
BOX = ((0.25, 0.15), (-0.10, 0.15), (-0.10, -0.15), (0.25, -0.15))
BOXED = StopField(Footprint(BOX), DRIVE, StopFieldConfig())


def points(*pairs):
    return np.array(pairs, np.float64).reshape(-1, 2)


def test_free_way_changes_nothing():
    assert CIRCLE.limit((0.3, 0.3), points()) == ((0.3, 0.3), "free", None)
    assert CIRCLE.limit((0.3, 0.3), points((1.0, 0.0), (0.3, 0.3), (-0.2, 0.0))).zone == "free"


def test_standing_robot_is_not_limited():
    assert CIRCLE.limit((0.0, 0.0), points((0.1, 0.0))) == ((0.0, 0.0), "free", None)


def test_stopping_distance_at_full_speed_is_that_of_reaction_and_braking():
    # 0.3 m/s for 0.25 s, then 0.3^2 / (2 * 1.0), and 0.02 m margin: 0.075 + 0.045 + 0.02 = 0.14 m before the body.
    assert CIRCLE.limit((0.3, 0.3), points((0.17 + 0.1401, 0.0))).zone == "free"
    slowed = CIRCLE.limit((0.3, 0.3), points((0.17 + 0.1390, 0.0)))
    assert slowed.zone == "slow"
    assert 0.29 < slowed.wheels[0] < 0.3


@pytest.mark.parametrize("clearance", [0.03, 0.05, 0.08, 0.12])
def test_speed_in_the_slow_zone_stops_at_the_margin(clearance):
    left, right = CIRCLE.limit((0.3, 0.3), points((0.17 + clearance, 0.0))).wheels
    assert left == right
    assert 0.25 * left + left * left / 2.0 == pytest.approx(clearance - 0.02, abs=1e-6)


def test_contact_within_the_margin_stops_at_once_and_names_the_side():
    ahead = CIRCLE.limit((0.3, 0.3), points((0.185, 0.0)))
    assert (ahead.wheels, ahead.zone) == ((0.0, 0.0), "stop")
    assert ahead.reason == "the lidar sees an obstacle ahead, too near to drive on"
    assert "behind" in CIRCLE.limit((-0.1, -0.1), points((-0.185, 0.01))).reason
    assert "to the left" in BOXED.limit((-0.2, 0.2), points((0.0, 0.155), (-0.03, 0.155))).reason
    assert "to the right" in BOXED.limit((0.2, -0.2), points((0.0, -0.155), (-0.03, -0.155))).reason


def test_robot_may_leave_what_is_too_near():
    assert CIRCLE.limit((-0.3, -0.3), points((0.175, 0.0), (0.165, 0.02))).zone == "free"
    assert CIRCLE.limit((-0.2, 0.2), points((0.175, 0.0))).zone == "free"


def test_round_body_that_hardly_advances_turns_in_place_only():
    wall = points((0.16, 0.0), (0.175, 0.03))
    assert CIRCLE.limit((-0.19, 0.205), wall).wheels == pytest.approx((-0.1975, 0.1975))
    assert CIRCLE.limit((-0.19, 0.215), wall).zone == "stop"
    assert CIRCLE.limit((0.009, 0.009), points((0.185, 0.0))).zone == "stop"


def test_slow_arc_from_rest_is_no_turn_in_place():
    # The first 50 ms at 0.1 m/s2: a robot that was turned in place instead would never drive off.
    assert CIRCLE.limit((0.004, 0.005), points((1.0, 0.0))) == ((0.004, 0.005), "free", None)
    assert CIRCLE.limit((0.004, 0.005), points((0.185, 0.0))).zone == "stop"


def test_arc_of_a_whole_turn_is_judged_at_any_rate():
    # At 0.8 m/s the braking time is longer than a turn; tau / |w| times |w| is more than tau at many rates.
    drive = DriveTrain(axle_m=0.235, wheel_speed_max_m_s=0.8, deceleration_m_s2=0.3)
    field = StopField(Footprint.circle(0.17), drive, StopFieldConfig())
    for right in np.linspace(-0.65, -0.38, 200).tolist():
        assert field.limit((0.8, right), points((1.0, 0.0))).zone == "free"


def test_arc_is_kept_when_the_speed_is_lowered():
    limited = CIRCLE.limit((0.2, 0.3), points((0.28, 0.03)))
    assert limited.zone == "slow"
    assert limited.wheels[0] / limited.wheels[1] == pytest.approx(2.0 / 3.0)


def test_box_turns_its_corner_into_what_a_circle_passes():
    beside = points((0.0, 0.2))
    assert CIRCLE.limit((-0.2, 0.2), beside).zone == "free"
    assert BOXED.limit((-0.2, 0.2), beside).zone == "slow"


def test_weaker_brakes_stop_earlier():
    weak = StopField(Footprint.circle(0.17), DriveTrain(axle_m=0.235, wheel_speed_max_m_s=0.5, deceleration_m_s2=0.2),
                     StopFieldConfig())  # fmt: skip
    wall = points((0.17 + 0.15, 0.0))
    assert CIRCLE.limit((0.3, 0.3), wall).zone == "free"
    assert weak.limit((0.3, 0.3), wall).zone == "slow"


def test_reach_is_where_points_begin_to_matter():
    # 0.171 m to a corner, the margin, and 0.25 s + 0.25 s of braking at 0.5 m/s.
    assert CIRCLE.reach == pytest.approx(0.1708 + 0.0201 + 0.25, abs=1e-3)
    assert CIRCLE.limit((0.5, 0.5), points((CIRCLE.reach, 0.0))).zone == "free"


def test_spinning_base_on_a_short_axle_is_judged_for_one_turn():
    spinner = StopField(Footprint(BOX), DriveTrain(axle_m=0.05, wheel_speed_max_m_s=0.5), StopFieldConfig())
    assert spinner.limit((-0.5, 0.5), points((0.0, 0.2))).zone == "slow"


def rolled_outside(field_polygon, x, y, v, w, t):
    """How far (m) the point is outside the polygon's sides after t s at v and w."""
    bx, by = (v * t, 0.0) if abs(w) < 1e-9 else (v / w * math.sin(w * t), v / w * (1.0 - math.cos(w * t)))
    dx, dy = x - bx, y - by
    cos, sin = math.cos(w * t), math.sin(w * t)
    px, py = cos * dx + sin * dy, cos * dy - sin * dx
    corners = np.array(field_polygon)
    sides = np.roll(corners, -1, axis=0) - corners
    normals = np.column_stack((sides[:, 1], -sides[:, 0])) / np.hypot(*sides.T)[:, None]
    return float(((np.array((px, py)) - corners) * normals).sum(axis=1).max())


@settings(max_examples=200, deadline=None)
@given(
    st.lists(st.tuples(st.floats(-0.6, 0.6), st.floats(-0.6, 0.6)), min_size=1, max_size=8),
    st.floats(-0.5, 0.5),
    st.floats(-0.5, 0.5),
)
def test_stopping_never_ends_nearer_than_the_margin_or_than_it_began(cloud, left, right):
    seen = points(*cloud)
    limited = BOXED.limit((left, right), seen)
    allowed = limited.wheels
    assert all(abs(a) <= abs(r) and a * r >= 0.0 for a, r in zip(allowed, (left, right), strict=True))
    assert allowed[0] * right == pytest.approx(allowed[1] * left, abs=1e-9)
    fastest = max(abs(allowed[0]), abs(allowed[1]))
    if fastest == 0.0:
        return
    v, w = (allowed[0] + allowed[1]) / 2.0, (allowed[1] - allowed[0]) / 0.235
    for x, y in cloud:
        before = rolled_outside(BOX, x, y, v, w, 0.0)
        for t in np.linspace(0.0, 0.25 + fastest / 2.0, 12).tolist():
            assert rolled_outside(BOX, x, y, v, w, t) >= min(0.02, before) - 1e-5


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
