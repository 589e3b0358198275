"""The simulated floor against geometry computed by hand."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fog_contracts.geometry import GeometryError
from fog_contracts.grid import GridGeometry
from fog_contracts.messages import Pose, SimObstacle
from fog_contracts.site import NodeSite, RobotSite, Sonar
from fognav_sim.floor import Floor
from fognav_sim.sensors import Noise
from fognav_sim.world import World

IDEAL = Noise(
    wheel_diameter=0.0, slip=0.0, range_sigma=0.0, range_share=0.0, lidar_dropout=0.0, sonar_sigma=0.0, sonar_spike=0.0
)
WALL = 0.2
AXLE_M = 0.3


def hall(x=2.0, y=2.0, theta=0.0, *, noise=IDEAL, seed=1, wheel_lag=0.0):
    """A hall of 6 x 4 m with walls 0.2 m thick inside these bounds."""
    geometry = GridGeometry(120, 80, 0.05, 0.0, 0.0)
    cells = np.zeros(geometry.shape, np.uint8)
    cells[:4], cells[-4:], cells[:, :4], cells[:, -4:] = 254, 254, 254, 254
    robot = RobotSite(id="r1", start=Pose(x=x, y=y, theta=theta), radius=0.17)
    return World(Floor(geometry, cells), robot, seed, axle_m=AXLE_M, noise=noise, wheel_lag=wheel_lag)


def box(left, bottom, right, top, height=1.0, name="box"):
    return SimObstacle(id=name, polygon=[(left, bottom), (right, bottom), (right, top), (left, top)], height=height)


def run(world, seconds, left, right):
    world.set_wheels(left, right)
    rolled = [0.0, 0.0]
    for _ in range(round(seconds / 0.01)):
        a, b = world.step(0.01)
        rolled[0] += a
        rolled[1] += b
    return rolled


def test_robot_slides_on_where_its_wheels_do_not_hold():
    world = hall(2.0, 2.0, noise=dataclasses.replace(IDEAL, grip=1.0))
    rolled = run(world, 2.0, 0.3, 0.3)
    assert world.pose[0] == pytest.approx(2.0 + rolled[0] - 0.045, abs=0.005)
    assert run(world, 1.0, 0.0, 0.0) == [0.0, 0.0]
    assert world.pose[0] == pytest.approx(2.0 + rolled[0], abs=0.005)


@settings(deadline=None)
@given(v=st.floats(0.05, 0.3), w=st.floats(-1.5, 1.5), theta=st.floats(-3.1, 3.1))
def test_constant_wheel_speeds_drive_the_exact_arc(v, w, theta):
    world = hall(3.0, 2.0, theta)
    seconds = 2.0
    run(world, seconds, v - AXLE_M / 2 * w, v + AXLE_M / 2 * w)
    turn = w * seconds
    chord = v * seconds * (math.sin(turn / 2) / (turn / 2) if abs(turn) > 1e-9 else 1.0)
    x, y, heading = world.pose
    assert x == pytest.approx(3.0 + chord * math.cos(theta + turn / 2), abs=1e-4)
    assert y == pytest.approx(2.0 + chord * math.sin(theta + turn / 2), abs=1e-4)
    assert math.remainder(heading - theta - turn, math.tau) == pytest.approx(0.0, abs=1e-6)


def test_wheels_lag_behind_the_command_and_then_reach_it():
    world = hall(wheel_lag=0.05)
    world.set_wheels(0.3, 0.3)
    first = world.step(0.01)[0] / 0.01
    assert 0.02 < first < 0.15
    run(world, 0.5, 0.3, 0.3)
    assert world.step(0.01) == pytest.approx((0.003, 0.003))


def test_odometry_error_is_repeatable_by_the_seed():
    paths = []
    for seed in (1, 1, 2):
        world = hall(1.0, 2.0, noise=Noise(), seed=seed)
        rolled = run(world, 10.0, 0.3, 0.3)
        assert rolled == pytest.approx([3.0, 3.0])
        assert world.distance == pytest.approx(3.0, abs=0.1)
        paths.append(world.pose)
    assert paths[0] == paths[1] != paths[2]
    assert paths[0][1] != 2.0


@settings(deadline=None, max_examples=50)
@given(x=st.floats(0.5, 5.5), y=st.floats(0.5, 3.5))
def test_clearance_is_the_distance_to_the_nearest_wall(x, y):
    world = hall(x, y)
    nearest = min(x - WALL, 6.0 - WALL - x, y - WALL, 4.0 - WALL - y) - 0.17
    # Beyond 0.6 m the distance is measured from the cell's centre.
    assert world.clearance() == pytest.approx(nearest, abs=1e-6 if nearest < 0.35 else 0.06)


def test_obstacles_limit_the_clearance_and_none_can_be_placed_on_the_robot():
    world = hall()
    world.place(box(2.5, 1.5, 2.7, 2.5))
    assert world.clearance() == pytest.approx(0.33)
    with pytest.raises(ValueError, match="would stand on robot r1"):
        world.place(box(1.9, 1.9, 2.1, 2.1, name="trap"))
    with pytest.raises(GeometryError):
        world.place(SimObstacle(id="line", polygon=[(4.0, 1.0), (5.0, 1.0), (4.5, 1.0)]))
    assert [obstacle.id for obstacle in world.obstacles] == ["box"]
    assert world.remove("box")
    assert not world.remove("box")


@pytest.mark.parametrize(("bearing", "pressed"), [(0.0, (True, True)), (0.6, (False, True)), (-0.6, (True, False))])
def test_contact_counts_once_stops_the_robot_and_presses_the_bumper_on_its_side(bearing, pressed):
    world = hall(5.0, 2.0, bearing, noise=Noise(), wheel_lag=0.05)
    run(world, 6.0, 0.2, 0.2)
    assert world.contacts == 1
    assert world.pose[0] == pytest.approx(6.0 - WALL - 0.17, abs=0.01)
    assert world.bumpers == pressed
    assert world.truth(0.0).contacts == 1
    run(world, 2.0, -0.2, -0.2)
    assert world.bumpers == (False, False)
    run(world, 4.0, 0.2, 0.2)
    assert world.contacts == 2


def test_robot_can_be_kidnapped_but_not_into_a_wall():
    world = hall()
    with pytest.raises(ValueError, match="not free"):
        world.kidnap(Pose(x=0.1, y=0.1, theta=0.0))
    assert world.pose == (2.0, 2.0, 0.0)
    world.kidnap(Pose(x=4.0, y=1.0, theta=1.0))
    assert world.pose == (4.0, 1.0, 1.0)


def test_start_inside_a_wall_is_refused_with_the_remedy():
    with pytest.raises(ValueError, match=r"move its start in site\.toml"):
        hall(0.25, 2.0)


@settings(deadline=None, max_examples=50)
@given(theta=st.floats(-3.1, 3.1), angle=st.floats(-3.1, 3.1))
def test_lidar_measures_the_distance_to_the_first_wall(theta, angle):
    world = hall(2.0, 2.0, theta)
    direction = theta + angle
    c, s = math.cos(direction), math.sin(direction)
    to_x = (5.8 - 2.0) / c if c > 0 else (0.2 - 2.0) / c if c < 0 else math.inf
    to_y = (3.8 - 2.0) / s if s > 0 else (0.2 - 2.0) / s if s < 0 else math.inf
    assert world.lidar(np.array([angle]), 0.0)[0] == pytest.approx(min(to_x, to_y), abs=1e-6)


def test_lidar_does_not_see_obstacles_below_its_plane():
    world = hall()
    world.place(box(3.0, 1.5, 3.2, 2.5, height=0.2))
    assert world.lidar(np.zeros(1), 0.0)[0] == pytest.approx(3.8)
    world.place(box(3.0, 1.5, 3.2, 2.5, height=1.0))
    assert world.lidar(np.zeros(1), 0.0)[0] == pytest.approx(1.0)


def test_lidar_noise_and_dropout_rate_are_as_configured():
    world = hall(noise=Noise(range_sigma=0.01, range_share=0.0, lidar_dropout=0.1))
    ranges = np.concatenate([world.lidar(np.zeros(100), 0.0) for _ in range(50)])
    assert np.isnan(ranges).mean() == pytest.approx(0.1, abs=0.02)
    assert np.nanmean(ranges) == pytest.approx(3.8, abs=0.002)
    assert np.nanstd(ranges) == pytest.approx(0.01, rel=0.1)


def test_lidar_gets_no_return_beyond_twelve_metres():
    geometry = GridGeometry(400, 80, 0.05, 0.0, 0.0)
    cells = np.zeros(geometry.shape, np.uint8)
    cells[:, -4:] = 254
    robot = RobotSite(id="r1", start=Pose(x=7.0, y=2.0, theta=0.0), radius=0.17)
    world = World(Floor(geometry, cells), robot, 1, axle_m=AXLE_M, noise=IDEAL)
    assert np.isnan(world.lidar(np.zeros(1), 0.0)[0])
    world.kidnap(Pose(x=8.0, y=2.0, theta=0.0))
    assert world.lidar(np.zeros(1), 0.0)[0] == pytest.approx(11.8)


# --- sonars ---


def node(x=3.0, y=0.25, theta=math.pi / 2, angle=0.0, height=0.3):
    return NodeSite(
        id="n1", area="z1", x=x, y=y, theta=theta, height=height, sonars=[Sonar(angle=angle, range_limit=3)]
    )


def test_wall_at_a_right_angle_echoes_from_its_nearest_point():
    assert hall(1.0, 1.0).sonar(node(), 0) == pytest.approx(3.55, abs=0.01)


def test_surface_at_a_grazing_angle_gives_no_echo():
    # Only a tilted board is in front: at 30 degrees it echoes, at 70 degrees it reflects the sound away.
    for tilt, has_echo in ((math.radians(30.0), True), (math.radians(70.0), False)):
        world = hall(1.0, 1.0)
        c, s = math.cos(tilt), math.sin(tilt)
        corners = [(-1.2, 0.0), (1.2, 0.0), (1.2, 0.05), (-1.2, 0.05)]
        ring = [(3.0 + c * u - s * v, 1.6 + s * u + c * v) for u, v in corners]
        world.place(SimObstacle(id="board", polygon=ring, height=1.0))
        measured = world.sonar(node(), 0)
        if has_echo:
            assert measured == pytest.approx(1.2, abs=0.25)
        else:
            assert measured is None or measured > 3.0


def test_sonar_sees_the_robot_only_if_it_reaches_up_to_the_node():
    world = hall(3.0, 2.0)
    assert world.sonar(node(height=0.3), 0) == pytest.approx(2.0 - 0.25 - 0.17, abs=0.01)
    assert world.sonar(node(height=1.5), 0) == pytest.approx(3.55, abs=0.01)


def test_obstacles_beside_or_below_the_cone_are_not_seen():
    world = hall(1.0, 1.0)
    world.place(box(4.0, 1.5, 4.4, 2.0))
    assert world.sonar(node(), 0) == pytest.approx(3.55, abs=0.01)
    world.place(box(2.8, 1.0, 3.2, 1.2, height=0.1))
    assert world.sonar(node(height=0.5), 0) == pytest.approx(3.55, abs=0.01)
    world.place(box(2.8, 1.0, 3.2, 1.2, height=1.0))
    assert world.sonar(node(height=0.5), 0) == pytest.approx(0.75, abs=0.01)


def test_sonar_outliers_are_single_samples_at_their_rate():
    world = hall(1.0, 1.0, noise=Noise(sonar_spike=0.05, sonar_sigma=0.004))
    measured = np.array([world.sonar(node(), 0) for _ in range(2000)])
    outliers = np.abs(measured - 3.55) > 0.05
    assert outliers.mean() == pytest.approx(0.05, abs=0.02)
    assert measured[~outliers].std() == pytest.approx(0.004, rel=0.2)


@settings(deadline=None)
@given(
    x=st.floats(0.5, 5.0), y=st.floats(0.5, 3.0), width=st.floats(0.05, 0.9), height=st.floats(0.05, 0.9),
    reach=st.floats(0.1, 4.0), direction=st.floats(-3.1, 3.1),
)  # fmt: skip
def test_an_obstacle_that_a_ray_meets_within_a_sensor_s_reach_is_never_left_out(x, y, width, height, reach, direction):
    floor = Floor(GridGeometry(120, 80, 0.05, 0.0, 0.0), np.zeros((80, 120), np.uint8))
    floor.place(box(x, y, x + width, y + height))
    rays = direction + np.linspace(-0.5, 0.5, 16)
    everything = [ranges for _, ranges, _ in floor.obstacle_ranges(2.0, 2.0, rays, 1e3)]
    within = [ranges for _, ranges, _ in floor.obstacle_ranges(2.0, 2.0, rays, reach)]
    if np.any(everything[0] <= reach):
        assert np.array_equal(within[0], everything[0])


def test_an_obstacle_that_was_taken_away_is_measured_no_more():
    world = hall(1.0, 1.0)
    world.place(box(2.8, 1.0, 3.2, 1.2))
    assert world.sonar(node(), 0) == pytest.approx(0.75, abs=0.01)
    assert world.remove("box")
    assert world.sonar(node(), 0) == pytest.approx(3.55, abs=0.01)
