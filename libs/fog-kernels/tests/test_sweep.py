"""The time to contact against small steps along the arc, in plain Python."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fog_kernels.sweep import first_contact, half_planes

BOX = np.array([(0.25, 0.15), (-0.1, 0.15), (-0.1, -0.15), (0.25, -0.15)])
WEDGE = np.array([(0.4, 0.0), (-0.2, 0.3), (-0.2, -0.3)])
ROUND = 0.17 * np.array([(math.cos(a), math.sin(a)) for a in np.arange(32) * math.tau / 32])
OCTAGON = ROUND[::4]
STEP_S = 4e-3


def outside(polygon, x, y):
    """How far (m) a point is outside the side's line that it is most outside of."""
    worst = -math.inf
    for i, (ax, ay) in enumerate(polygon.tolist()):
        bx, by = polygon[(i + 1) % len(polygon)].tolist()
        worst = max(worst, ((by - ay) * (x - ax) - (bx - ax) * (y - ay)) / math.hypot(bx - ax, by - ay))
    return worst


def seen_after(x, y, v, w, t):
    """Where a fixed point is in the body's frame after t s: the body's pose by its arc, then the inverse transform."""
    bx, by = (v * t, 0.0) if w == 0 else (v / w * math.sin(w * t), v / w * (1.0 - math.cos(w * t)))
    dx, dy = x - bx, y - by
    return math.cos(w * t) * dx + math.sin(w * t) * dy, -math.sin(w * t) * dx + math.cos(w * t) * dy


@settings(max_examples=100, deadline=None)
@given(
    st.sampled_from([BOX, WEDGE, OCTAGON]),
    st.floats(-0.7, 0.7),
    st.floats(-0.7, 0.7),
    st.sampled_from([-0.3, -0.05, 0.0, 0.01, 0.15, 0.3]),
    st.sampled_from([-2.75, -1.0, -0.01, 0.0, 2e-4, 0.3, 1.0, 2.75]),
    st.sampled_from([0.0, 0.02, 0.05]),
)
def test_contact_is_neither_late_nor_early(polygon, x, y, v, w, margin):
    tolerance = 0.002
    time, index = first_contact(
        np.array([(x, y)]), half_planes(polygon), v, w, horizon=1.5, margin=margin, tolerance=tolerance
    )
    pad = min(margin, outside(polygon, x, y) - tolerance)
    for t in np.arange(0.0, min(time, 1.5) - 1e-6, STEP_S).tolist():
        assert outside(polygon, *seen_after(x, y, v, w, t)) > pad - 1e-7, "touched before"
    if math.isfinite(time):
        assert index == 0
        assert outside(polygon, *seen_after(x, y, v, w, time)) == pytest.approx(pad, abs=1e-6)


def test_first_of_many_points_is_found():
    rng = np.random.default_rng(4)
    for _ in range(50):
        points = rng.uniform(-0.8, 0.8, (60, 2))
        v, w = rng.uniform(-0.3, 0.3), rng.uniform(-2.0, 2.0)
        body = half_planes(BOX)
        alone = [first_contact(points[i : i + 1], body, v, w, horizon=1.0, margin=0.02)[0] for i in range(len(points))]
        time, index = first_contact(points, body, v, w, horizon=1.0, margin=0.02)
        assert time == min(alone)
        assert index == (int(np.argmin(alone)) if math.isfinite(time) else -1)


@pytest.mark.parametrize(
    ("point", "v", "w", "expected"),
    [
        ((0.45, 0.0), 0.2, 0.0, 1.0),  # 0.2 m ahead of the front at 0.2 m/s
        ((-0.3, 0.1), -0.2, 0.0, 1.0),
        ((0.45, 0.2), 0.2, 0.0, math.inf),  # passes beside
        ((0.45, 0.0), -0.2, 0.0, math.inf),
        ((0.0, 0.25), 0.0, 1.0, math.asin(0.2 / 0.25)),  # turning left: it meets the left side at (0.2, 0.15)
    ],
)
def test_times_by_hand(point, v, w, expected):
    time, _ = first_contact(np.array([point]), half_planes(BOX), v, w, horizon=2.0)
    assert time == pytest.approx(expected)


def test_point_inside_the_margin_may_be_left_but_not_approached():
    body = half_planes(BOX)
    near = np.array([(0.26, 0.0)])
    stays = first_contact(near, body, 0.0, 0.0, horizon=1.0, margin=0.03, tolerance=0.002)
    away = first_contact(near, body, -0.3, 0.0, horizon=1.0, margin=0.03, tolerance=0.002)
    closer = first_contact(near, body, 0.3, 0.0, horizon=1.0, margin=0.03, tolerance=0.002)
    assert stays == away == (math.inf, -1)
    assert closer[0] == pytest.approx(0.002 / 0.3)


def test_turning_a_round_body_next_to_a_wall_is_no_contact():
    wall = np.array([(0.18, y) for y in np.arange(-0.3, 0.3, 0.01)])
    assert first_contact(wall, half_planes(ROUND), 0.0, 1.0, horizon=1.0, margin=0.03, tolerance=0.002)[1] == -1


@pytest.mark.parametrize(
    ("changes", "error"),
    [
        ({"points": np.zeros((3, 3))}, ValueError),
        ({"points": np.zeros((3, 2), np.float32)}, TypeError),
        ({"v": math.nan}, ValueError),
        ({"horizon": 0.0}, ValueError),
        ({"w": 3.0, "horizon": 3.0}, ValueError),
    ],
)
def test_wrong_arguments_are_refused(changes, error):
    given_ = {"points": np.zeros((1, 2)), "body": half_planes(BOX), "v": 0.1, "w": 0.0, "horizon": 1.0}
    with pytest.raises(error):
        first_contact(**{**given_, **changes})


def test_horizon_of_one_turn_is_allowed_at_any_rate():
    body, point = half_planes(BOX), np.array([(2.0, 0.0)])
    for w in np.linspace(-6.0, 6.0, 1000).tolist():
        assert first_contact(point, body, 0.0, w, horizon=math.tau / abs(w))[1] == -1


def test_polygon_of_another_shape_is_refused():
    with pytest.raises(ValueError, match="polygon"):
        half_planes(np.zeros((2, 2)))


def test_no_points_give_no_contact():
    assert first_contact(np.zeros((0, 2)), half_planes(BOX), 0.3, 0.0, horizon=1.0) == (math.inf, -1)
