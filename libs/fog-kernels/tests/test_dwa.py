"""DWA in a closed loop: a unicycle follows paths through corridors and a doorway, turns round and brakes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from compiler import compiled_only

from fog_contracts.costs import DEFAULT_INFLATION
from fog_kernels.clearance import clearance
from fog_kernels.dwa import DwaLimits, DwaResult, DwaSettings, dwa
from fog_kernels.inflation import inflate, inflation_table
from fog_kernels.robot import cover

if TYPE_CHECKING:
    from numpy.typing import NDArray

RESOLUTION = 0.05
PERIOD = 0.2
ROOMBA = DwaLimits(axle=0.235, wheel_max=0.5)
BODY = cover([(0.17 * math.cos(a), 0.17 * math.sin(a)) for a in np.arange(32) * math.tau / 32])
Point = tuple[float, float]


def world(*rooms: tuple[float, float, float, float]) -> NDArray[np.uint8]:
    """Return an inflated costmap: 8 x 8 m of wall with free boxes x0, y0, x1, y1."""
    raw = np.full((160, 160), 254, np.uint8)
    for x0, y0, x1, y1 in rooms:
        raw[round(y0 / RESOLUTION) : round(y1 / RESOLUTION), round(x0 / RESOLUTION) : round(x1 / RESOLUTION)] = 0
    return inflate(raw, inflation_table(RESOLUTION, DEFAULT_INFLATION))


L_CORRIDOR = world((0.5, 0.5, 6.0, 2.0), (4.5, 0.5, 6.0, 7.0))
DOORWAY = world((0.5, 0.5, 4.0, 4.0), (4.0, 1.8, 4.3, 2.7), (4.3, 0.5, 7.5, 4.0))
OPEN = world((0.5, 0.5, 7.5, 7.5))


@dataclass
class Drive:
    """One row per decision: t, x, y, theta, v, w, cost under the centre, admissible arcs."""

    log: NDArray[np.float64]

    def distance_to(self, goal: Point) -> float:
        return math.hypot(self.log[-1, 1] - goal[0], self.log[-1, 2] - goal[1])


def decide(  # noqa: PLR0913  # the kernel's inputs
    costmap: NDArray[np.uint8],
    pose: tuple[float, float, float],
    speeds: tuple[float, float],
    path: list[Point],
    goal: Point,
    goal_theta: float | None = None,
    settings: DwaSettings | None = None,
    limits: DwaLimits | None = None,
) -> DwaResult:
    x, y, theta = pose
    column = max(int(x / RESOLUTION) - 20, 0)
    row = max(int(y / RESOLUTION) - 20, 0)
    window = np.ascontiguousarray(costmap[row : row + 40, column : column + 40])
    limits, settings = limits or ROOMBA, settings or DwaSettings()
    around = clearance(
        window, RESOLUTION, column * RESOLUTION, row * RESOLUTION, [], x, y, BODY, DEFAULT_INFLATION, limits, settings
    )
    return dwa(*speeds, x, y, theta, around, path, *goal, goal_theta, BODY, limits, settings)


def drive(  # noqa: PLR0913  # the kernel's inputs, and how long
    costmap: NDArray[np.uint8],
    pose: tuple[float, float, float],
    path: list[Point],
    goal: Point,
    goal_theta: float | None = None,
    noise: float = 0.0,
    seconds: float = 90.0,
) -> Drive:
    """Run the controller at 5 Hz on noisy poses and integrate the unicycle at 100 Hz until it stops."""
    x, y, theta = pose
    v = w = t = 0.0
    rng = np.random.default_rng(1)
    rows = []
    while t < seconds:
        seen = (x + noise * rng.normal(), y + noise * rng.normal(), theta + noise * rng.normal())
        result = decide(costmap, seen, (v, w), path, goal, goal_theta)
        assert result.v >= 0.0
        assert result.v + 0.5 * ROOMBA.axle * abs(result.w) <= ROOMBA.wheel_max + 1e-6
        assert abs(result.v - v) <= 2.5 * PERIOD + 1e-9
        rows.append((t, x, y, theta, result.v, result.w, costmap[int(y / 0.05), int(x / 0.05)], result.n_admissible))
        v, w = result.v, result.w
        if v == 0.0 and w == 0.0:
            break
        for _ in range(20):
            theta += 0.5 * w * 0.01
            x += v * math.cos(theta) * 0.01
            y += v * math.sin(theta) * 0.01
            theta += 0.5 * w * 0.01
        t += PERIOD
    return Drive(np.array(rows))


def off_path(run: Drive, path: list[Point]) -> float:
    points = np.array(path)
    worst = 0.0
    for position in run.log[:, 1:3]:
        starts, ends = points[:-1], points[1:]
        along = ends - starts
        part = np.clip(((position - starts) * along).sum(1) / (along**2).sum(1), 0, 1)
        worst = max(worst, float(np.hypot(*(starts + part[:, None] * along - position).T).min()))
    return worst


@compiled_only
@pytest.mark.parametrize("noise", [0.0, 0.01, 0.03])
@pytest.mark.parametrize("theta", [0.0, math.pi, -2.0])
def test_robot_follows_an_l_shaped_corridor_to_its_end(noise: float, theta: float) -> None:
    path = [(1.0, 1.25), (5.25, 1.25), (5.25, 6.5)]
    run = drive(L_CORRIDOR, (1.0, 1.25, theta), path, path[-1], noise=noise)
    assert run.distance_to(path[-1]) < 0.10 + 2 * noise
    assert run.log[:, 6].max() < 200  # never near a wall
    assert off_path(run, path) < 0.25
    assert run.log[-1, 0] < 9.5 / 0.3 + 6.0  # nearly as fast as the path at full speed
    straight = run.log[(run.log[:, 1] > 2.0) & (run.log[:, 1] < 4.0)]
    assert np.abs(straight[:, 4] - 0.3).max() < 1e-6
    if noise == 0.0:
        assert np.abs(straight[:, 5]).max() < 0.1  # no weaving


@compiled_only
def test_dense_and_sparse_points_of_a_path_give_the_same_drive() -> None:
    sparse = [(1.0, 1.25), (5.25, 1.25), (5.25, 6.5)]
    dense = [(1 + i * 0.05, 1.25) for i in range(85)] + [(5.25, 1.25 + i * 0.05) for i in range(105)]
    runs = [drive(L_CORRIDOR, (1.0, 1.25, 0.0), path, (5.25, 6.5)) for path in (sparse, dense)]
    assert abs(runs[0].log[-1, 0] - runs[1].log[-1, 0]) < 1.0


@compiled_only
@pytest.mark.parametrize("noise", [0.0, 0.01, 0.03])
@pytest.mark.parametrize(
    "path",
    [
        [(1.0, 3.2), (3.3, 2.25), (5.0, 2.25), (6.5, 1.2)],
        [(2.0, 0.8), (3.7, 0.8), (3.7, 2.25), (5.0, 2.25)],  # hugs the wall, then a right angle into the doorway
    ],
)
def test_robot_passes_a_doorway_of_90_cm_without_contact(noise: float, path: list[Point]) -> None:
    run = drive(DOORWAY, (*path[0], 1.5), path, path[-1], noise=noise)
    assert run.distance_to(path[-1]) < 0.10 + 2 * noise
    assert run.log[:, 6].max() < 254


@compiled_only
def test_robot_turns_in_place_to_a_path_that_starts_behind_it() -> None:
    run = drive(OPEN, (3.0, 3.0, math.pi), [(3.0, 3.0), (6.0, 3.0)], (6.0, 3.0))
    moving = run.log[run.log[:, 4] > 0.02]
    first = moving[0]
    assert math.hypot(first[1] - 3.0, first[2] - 3.0) < 0.02
    assert abs(math.remainder(first[3], 2 * math.pi)) < 1.1
    assert run.distance_to((6.0, 3.0)) < 0.1


@compiled_only
def test_robot_stops_within_the_tolerance_and_turns_to_the_goals_heading() -> None:
    run = drive(OPEN, (3.0, 3.0, 0.0), [(3.0, 3.0), (5.0, 3.0)], (5.0, 3.0), goal_theta=2.0)
    assert run.distance_to((5.0, 3.0)) < 0.10
    assert abs(math.remainder(run.log[-1, 3] - 2.0, 2 * math.pi)) < 0.17
    assert run.log[-1, 4] == run.log[-1, 5] == 0.0


@compiled_only
def test_goal_is_reached_from_beside_the_end_of_the_path() -> None:
    run = drive(OPEN, (5.05, 3.3, 0.0), [(3.0, 3.0), (5.0, 3.0)], (5.0, 3.0))
    assert run.distance_to((5.0, 3.0)) < 0.10


@compiled_only
def test_robot_stops_without_contact_before_an_unmapped_wall() -> None:
    costmap = world((0.5, 0.5, 4.0, 7.5), (4.2, 0.5, 7.5, 7.5))
    run = drive(costmap, (1.0, 3.0, 0.0), [(1.0, 3.0), (7.0, 3.0)], (7.0, 3.0), seconds=40)
    assert run.log[:, 6].max() < 253
    assert run.log[-1, 4] == pytest.approx(0.0, abs=0.02)
    assert run.log[:, 7].min() > 0


def test_low_deceleration_gives_a_longer_stopping_distance() -> None:
    """With 0.05 m/s^2 of braking, 0.3 m/s needs 0.9 m: more than the arcs' 0.45 m."""
    costmap = world((0.5, 2.7, 4.0, 3.3))  # a dead end too narrow to circle in
    limits = replace(ROOMBA, acc_v=0.05)
    pose = (3.15, 3.0, 0.0)  # 0.68 m before the inscribed band
    path = [(1.0, 3.0), (7.0, 3.0)]
    assert decide(costmap, pose, (0.3, 0.0), path, (7.0, 3.0), limits=limits).n_admissible == 0
    strong = decide(costmap, pose, (0.3, 0.0), path, (7.0, 3.0))
    assert strong.n_admissible > 0
    assert strong.v > 0.25


@pytest.mark.parametrize("blocked", [254, 255])
def test_robot_on_a_lethal_or_unknown_cell_does_not_move(blocked: int) -> None:
    costmap = np.full((160, 160), blocked, np.uint8)
    assert decide(costmap, (3.0, 3.0, 0.0), (0.2, 0.0), [(3.0, 3.0)], (5.0, 3.0)) == (0.0, 0.0, -math.inf, 0)


def test_robot_on_inscribed_cells_escapes_slowly_away_from_the_wall() -> None:
    costmap = world((0.5, 0.5, 4.0, 7.5))
    band = (3.88, 3.0)
    assert costmap[int(band[1] / 0.05), int(band[0] / 0.05)] == 253
    path = [(3.88, 3.0), (2.0, 3.0)]
    away = decide(costmap, (*band, math.pi), (0.0, 0.0), path, path[-1])
    assert 0.0 < away.v <= 0.1
    towards = decide(costmap, (*band, 0.0), (0.0, 0.0), [(3.88, 3.0), (4.5, 3.0)], (4.5, 3.0))
    assert towards.v == 0.0
    strict = replace(DwaSettings(), escape_v=0.0)
    assert decide(costmap, (*band, math.pi), (0.0, 0.0), path, path[-1], settings=strict).n_admissible == 0


def test_escaping_arc_does_not_return_to_inscribed_cells() -> None:
    costmap = np.zeros((160, 160), np.uint8)
    costmap[:, 58:62] = costmap[:, 64:] = 253  # columns 58 to 61, 10 cm of free floor, and inscribed ever after
    chosen = decide(costmap, (3.07, 3.0, 0.0), (0.0, 0.0), [(3.0, 3.0), (7.0, 3.0)], (7.0, 3.0))
    assert 3.10 < 3.07 + 3.0 * chosen.v < 3.20


def test_non_finite_or_malformed_inputs_are_refused() -> None:
    with pytest.raises(ValueError, match="finite"):
        decide(OPEN, (3.0, 3.0, math.inf), (0.0, 0.0), [], (4.0, 3.0))
    with pytest.raises(ValueError, match="acc_v"):
        replace(ROOMBA, acc_v=0.0)
    with pytest.raises(ValueError, match="n_v"):
        DwaSettings(n_v=1)
