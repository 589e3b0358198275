"""What the dynamic window approach is told about base and scoring, and what it answers; kernel in `fog_kernels.dwa`."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

from fog_kernels import _arrays

MAX_STEPS = 200
"""The longest arc, in steps."""


@dataclass(frozen=True, slots=True)
class DwaLimits:
    """Limits of the base: the distance of the wheels (m), the limit of each wheel (m/s), m/s, rad/s, m/s^2, rad/s^2.

    `acc_lateral` (m/s^2) limits v * w, so that the wheels don't slip in a curve. The other defaults are the speeds and
    accelerations of the thesis that Fognav builds on.
    """

    axle: float
    wheel_max: float
    v_max: float = 0.3
    w_max: float = 2.75
    acc_v: float = 2.5
    acc_w: float = 3.2
    acc_lateral: float = 0.4

    def __post_init__(self) -> None:
        for name in ("w_max", "acc_v", "acc_w", "acc_lateral", "wheel_max", "axle"):
            _arrays.positive(getattr(self, name), name)
        if not 0.0 <= self.v_max < math.inf:
            raise ValueError(f"v_max must not be negative, not {self.v_max}")


@dataclass(frozen=True, slots=True)
class DwaSettings:
    """How arcs are sampled, rolled out and scored; lengths in metres, times in seconds.

    `period` is the time until the next decision. Weights: `w_path` per metre of distance from the path, `w_goal` per
    metre to go, `w_heading` per radian between the heading at the arc's end and the path ahead of it, `w_cost` for the
    highest cost on the arc (0..1), `w_turn` per rad/s of change in angular speed. `lookahead` is the distance ahead on
    the path of the point at which the heading aims; heading errors above `turn_in_place` are corrected by turning in
    place. Towards the goal the speed follows sqrt(2 * approach * distance).

    `padding`: the swept footprint comes no nearer than this to anything known. A robot that is nearer already, because
    something moved or the map changed, may drive at up to `escape_v` on arcs on which its clearance never shrinks and
    that regain the padding within 0.3 m; with an `escape_v` of 0 it may not move.
    """

    n_v: int = 25
    n_w: int = 35
    sim_time: float = 1.5
    dt: float = 0.1
    period: float = 0.2
    w_path: float = 2.0
    w_goal: float = 1.0
    w_heading: float = 0.25
    w_cost: float = 0.1
    w_turn: float = 0.01
    lookahead: float = 0.3
    turn_in_place: float = 1.0
    approach: float = 0.15
    goal_tolerance: float = 0.10
    heading_tolerance: float = 0.17
    escape_v: float = 0.1
    padding: float = 0.008

    def __post_init__(self) -> None:
        for name in ("sim_time", "dt", "period", "lookahead", "turn_in_place", "approach", "goal_tolerance", "padding"):
            _arrays.positive(getattr(self, name), name)
        if self.n_v < 2 or self.n_w < 3:
            raise ValueError(f"n_v must be at least 2 and n_w at least 3, not {self.n_v} and {self.n_w}")
        if self.sim_time / self.dt > MAX_STEPS:
            raise ValueError(f"sim_time / dt must not exceed {MAX_STEPS} steps")

    def horizon(self, limits: DwaLimits) -> float:
        """Return how long (s) an arc is rolled out: also long enough to brake before an obstacle at its end."""
        return max(self.sim_time, self.period + limits.v_max / limits.acc_v)


class DwaResult(NamedTuple):
    """The chosen speeds (m/s, rad/s), the score of their arc (higher is better) and the number of admissible arcs.

    With no admissible arc, or at the goal, both speeds are 0; `n_admissible` 0 means that every arc was blocked.
    """

    v: float
    w: float
    score: float
    n_admissible: int


DEFAULT_SETTINGS = DwaSettings()
