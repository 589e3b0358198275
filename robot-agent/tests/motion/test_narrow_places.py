"""The path gives way to the middle of narrow places; noise can't open a gap that an earlier scan saw closed."""

import numpy as np
import pytest

from fog_contracts.costs import DEFAULT_INFLATION
from fog_kernels.clearance import clearance
from fog_kernels.course import distances
from fog_kernels.dwa import DwaLimits, DwaSettings
from fog_kernels.robot import cover
from robot_agent.footprint import Footprint
from robot_agent.localization.deskew import DeskewedScan
from robot_agent.localization.pose import Pose2
from robot_agent.motion.band import course, give_way
from robot_agent.motion.recent_scans import RecentScans

BODY = cover(Footprint.circle(0.17).polygon)
PATH = np.array([(1.0, 1.0), (3.0, 1.0)])


def around(points):
    return clearance(
        np.zeros((60, 60), np.uint8), 0.05, 0.0, 0.0, points, 1.2, 1.0, BODY, DEFAULT_INFLATION,
        DwaLimits(axle=0.235, wheel_max=0.5), DwaSettings(), at_least=1.0,
    )  # fmt: skip


def walls(*heights):
    return [(x, y) for x in np.arange(0.0, 3.0, 0.02) for y in heights]


def test_path_beside_one_wall_moves_away_until_there_is_room():
    field = around(walls(0.78))
    pushed = give_way(course(PATH, field), field, 0.30).path
    middle = pushed[(pushed[:, 0] > 1.3) & (pushed[:, 0] < 1.9)]
    assert middle[:, 1] == pytest.approx(np.full(len(middle), 1.08), abs=0.02)
    assert pushed[0] == pytest.approx(PATH[0])
    assert pushed[-1] == pytest.approx(PATH[-1])


def test_path_between_two_walls_moves_to_the_middle_and_stays_there():
    field = around(walls(0.82, 1.26))
    pushed = give_way(course(PATH, field), field, 0.30).path
    middle = pushed[(pushed[:, 0] > 1.3) & (pushed[:, 0] < 1.9)]
    assert middle[:, 1] == pytest.approx(np.full(len(middle), 1.04), abs=0.015)
    assert distances(field, middle).min() > 0.2


@pytest.mark.parametrize("beside", [-0.03, 0.01, 0.03])
@pytest.mark.parametrize("leaf", [0.0, 0.5, 1.0])
def test_path_beside_the_middle_of_a_gap_is_bent_onto_its_middle(leaf, beside):
    # A post, or the edge of a door of which the leaf leads away at an angle, 21 cm from the middle; a post opposite.
    edge = [(1.5 + 0.5 * t * leaf, 1.21 + t) for t in (np.arange(0.0, 0.8, 0.01) if leaf else (0.0,))]
    field = around([*edge, (1.5, 0.79)])
    bent = give_way(course(PATH + np.array((0.0, beside)), field), field, 0.29).path
    assert np.interp(1.5, *bent.T) == pytest.approx(1.0, abs=0.0005)


def test_path_with_room_on_both_sides_is_left_alone():
    field = around(walls(0.5, 1.5))
    assert give_way(course(PATH, field), field, 0.30).path is PATH


def test_points_of_earlier_scans_are_placed_by_odometry_and_forgotten_after_a_second():
    scans = RecentScans()
    ahead = np.array([(1.0, 0.0)])
    first, second = (DeskewedScan(ahead, Pose2(x, 0.0, 0.0), x) for x in (0.0, 0.3))
    scans.add(first, 10.0)
    scans.add(first, 10.1)
    scans.add(second, 10.2)
    # In `map` the robot looks along y.
    found = scans.points(Pose2(5.0, 5.0, np.pi / 2), 10.2)
    assert found == pytest.approx(np.array([(5.0, 5.7), (5.0, 6.0)]))
    assert len(scans.points(Pose2(5.0, 5.0, 0.0), 11.1)) == 1
    assert len(scans.points(Pose2(5.0, 5.0, 0.0), 11.3)) == 0
