"""An empty floor of 3 x 3 m with things on it, as a robot's local planner sees it."""

from __future__ import annotations

import numpy as np

from fog_contracts.costs import DEFAULT_INFLATION
from fog_kernels.clearance import clearance
from fog_kernels.dwa import DwaLimits, DwaSettings
from fog_kernels.robot import cover
from robot_agent.footprint import Footprint

ROUND = cover(Footprint.circle(0.17).polygon)
LONG = cover(Footprint(((-0.3, -0.12), (0.15, -0.12), (0.15, 0.12), (-0.3, 0.12))).polygon)
PADDING = DwaSettings().padding


def around(points, body=ROUND, x=1.5, y=1.5):
    """Return the distances around a robot at (x, y) from points (n, 2; m)."""
    return clearance(
        np.zeros((60, 60), np.uint8), 0.05, 0.0, 0.0, np.array(points, dtype=np.float64).reshape(-1, 2), x, y, body,
        DEFAULT_INFLATION, DwaLimits(axle=0.235, wheel_max=0.5), DwaSettings(), at_least=1.0,
    )  # fmt: skip
