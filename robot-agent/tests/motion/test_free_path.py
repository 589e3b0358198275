"""The quick look for what blocks a path finds what the costs of all cells around it say."""

import math

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from fog_contracts.costs import DEFAULT_INFLATION
from fog_contracts.grid import GridGeometry
from fog_kernels.clearance import clearance
from fog_kernels.dwa import DwaLimits, DwaSettings
from fog_kernels.robot import cover
from robot_agent.config import LOCAL_INFLATION
from robot_agent.footprint import Footprint
from robot_agent.localization.pose import Pose2
from robot_agent.motion.path_follower import detour, free_path, local_costs

BODY = cover(Footprint.circle(0.17).polygon)
LIMITS, SETTINGS = DwaLimits(axle=0.235, wheel_max=0.5), DwaSettings()
WINDOW = GridGeometry(width=80, height=80, resolution=0.05, origin_x=-2.0, origin_y=-2.0)
POSE = Pose2(0.01, 0.02, 0.0)
NARROWEST = BODY.inscribed + SETTINGS.padding


@given(st.integers(0, 2**16), st.integers(0, 12), st.integers(0, 3), st.floats(-math.pi, math.pi), st.floats(-0.6, 0.6))
def test_path_is_the_same_as_by_all_costs(seed, seen, walls, heading, bend):
    numbers = np.random.default_rng(seed)
    cost = np.zeros(WINDOW.shape, np.uint8)
    for column, row in numbers.integers(0, 74, (walls, 2)):
        cost[row : row + 3, column : column + 6] = numbers.choice([200, 253, 254, 255])
    points = numbers.uniform(-2.2, 2.2, (seen, 2))
    far = np.array([[0.0], [0.7], [1.5], [2.3]])
    angles = heading + bend * far[:, 0]
    path = far * np.column_stack((np.cos(angles), np.sin(angles)))
    around = clearance(
        cost, WINDOW.resolution, WINDOW.origin_x, WINDOW.origin_y, points, POSE.x, POSE.y, BODY, DEFAULT_INFLATION,
        LIMITS, SETTINGS, at_least=1.0,
    )  # fmt: skip
    expected = detour(path, local_costs(cost, WINDOW, points, LOCAL_INFLATION, around, NARROWEST), WINDOW, POSE)
    found = free_path(path, cost, WINDOW, points, LOCAL_INFLATION, around, NARROWEST, POSE)
    assert (found is path) == (expected is path)
    assert found.tolist() == expected.tolist()
