"""From rendered pictures of markers to the robot's place: the detector, the fit, the edge, and the real agent."""

from __future__ import annotations

import asyncio
import math
import os
from types import SimpleNamespace

import numpy as np
import pyapriltags
import pytest
from agent_rig import ROBOT, SITE, Robot, until
from marker_pictures import pgm, picture
from secured_servers import secured_router
from test_markers import MARKERS, Seeing

from fog_contracts.robot import CameraSettings
from fog_contracts.site import MarkerSite
from robot_agent.agent.edges.camera_edge import CameraEdge, CameraError, pictures
from robot_agent.localization.marker_pose import projected, sighting_of
from robot_agent.localization.pose import Pose2, wrap

CAMERA = CameraSettings(width_px=480, height_px=360, focal_px=420.0, x_m=0.1, y_m=0.02, latency_s=0.0, rate_hz=10.0)
MARKER = MarkerSite(id=7, x=0.0, y=0.0, theta=0.0)


def seen_from(distance, incidence, camera=CAMERA, turned=0.1, **more):
    """Return the sighting of the marker by a robot at this distance and angle from its normal, and the true pose."""
    x, y = distance * math.cos(incidence), distance * math.sin(incidence)
    robot = Pose2(x, y, wrap(incidence + math.pi + turned - camera.yaw_rad))
    (found,) = pyapriltags.Detector(families="tag36h11").detect(picture(robot, [MARKER], camera, **more))
    sighting = sighting_of(found.tag_id, found.corners, MARKER.size, camera, 1.5)
    assert (sighting.marker, sighting.stamp) == (7, 1.5)
    return sighting, Pose2(0.0, 0.0, 0.0).relative_to(robot)


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"yaw_rad": 0.5, "pitch_rad": 0.2},
        {"distortion": (-0.2, 0.05)},
        {"centre_px": [250.0, 170.0]},
        {"yaw_rad": -1.5, "x_m": -0.1},
    ],
    ids=["ahead", "turned and up", "wide lens", "off the middle", "to the right"],
)
@pytest.mark.parametrize(("distance", "incidence"), [(0.8, 0.3), (1.5, -0.8), (2.2, 1.0)])
def test_marker_in_a_picture_is_where_it_hangs_within_its_covariance(changes, distance, incidence):
    given = {name: getattr(CAMERA, name) for name in CameraSettings.__struct_fields__}
    sighting, true = seen_from(distance, incidence, CameraSettings(**given | changes), height=0.05)
    error = np.array((sighting.pose.x - true.x, sighting.pose.y - true.y, wrap(sighting.pose.theta - true.theta)))
    assert math.hypot(*error[:2]) < 0.02
    assert abs(error[2]) < 0.03
    assert error @ np.linalg.solve(sighting.covariance, error) < 11.3
    assert np.sqrt(np.diag(sighting.covariance))[:2].max() < 0.06


def noisy_corners(distance, incidence, rng):
    """Return the corners (4, 2; px) of the marker by a robot that looks past it by 0.1 rad, and its true pose."""
    robot = Pose2(distance * math.cos(incidence), distance * math.sin(incidence), wrap(incidence + math.pi + 0.1))
    seen = Pose2(0.0, 0.0, 0.0).relative_to(robot.compose(Pose2(CAMERA.x_m, CAMERA.y_m, 0.0)))
    tangents = projected(np.array((seen.x, seen.y, 0.05, seen.theta)), MARKER.size, 0.0)
    middle = np.array((CAMERA.width_px - 1, CAMERA.height_px - 1)) / 2
    noise = 0.3 * rng.standard_normal((4, 2))
    return CAMERA.focal_px * tangents + middle + noise, Pose2(0.0, 0.0, 0.0).relative_to(robot)


@pytest.mark.parametrize("incidence", [0.0, 0.2, 0.4, 0.8])
@pytest.mark.parametrize("distance", [1.0, 2.0, 3.0])
def test_errors_of_sightings_are_no_larger_than_their_covariance_says(distance, incidence):
    rng = np.random.default_rng(1)
    squares = []
    for _ in range(40):
        corners, true = noisy_corners(distance, incidence, rng)
        sighting = sighting_of(7, corners, MARKER.size, CAMERA, 0.0)
        error = np.array((sighting.pose.x - true.x, sighting.pose.y - true.y, wrap(sighting.pose.theta - true.theta)))
        squares.append(error @ np.linalg.solve(sighting.covariance, error))
    assert np.mean(squares) < 3.0
    assert max(squares) < 16.3


def test_face_that_may_be_turned_to_either_side_is_as_uncertain_as_both_differ():
    rng = np.random.default_rng(1)
    far, near = (sighting_of(7, noisy_corners(each, 0.4, rng)[0], MARKER.size, CAMERA, 0.0) for each in (3.0, 1.0))
    assert math.sqrt(far.covariance[2, 2]) > 0.5
    assert math.sqrt(near.covariance[2, 2]) < 0.05


def test_square_that_does_not_hang_upright_is_no_sighting_and_one_on_its_side_is():
    lower = np.array([(200.0, 200.0), (240.0, 200.0), (240.0, 160.0), (200.0, 160.0)])
    upright = sighting_of(7, lower, 0.16, CAMERA, 0.0)
    on_its_side = sighting_of(7, np.roll(lower, 1, axis=0), 0.16, CAMERA, 0.0)
    assert upright.pose == pytest.approx(on_its_side.pose)
    cos, sin = math.cos(0.5), math.sin(0.5)
    tilted = (lower - 200.0) @ np.array(((cos, sin), (-sin, cos))) + 200.0
    assert sighting_of(7, tilted, 0.16, CAMERA, 0.0) is None


class Camera:
    """A camera edge that reads rendered pictures from a named pipe, on the clock of a little world."""

    def __init__(self, folder, robot):
        self.pipe = folder / "pictures"
        os.mkfifo(self.pipe)
        given = {name: getattr(CAMERA, name) for name in CameraSettings.__struct_fields__}
        self.settings = CameraSettings(**given | {"source": str(self.pipe)})
        clock = SimpleNamespace(now=lambda: robot.world.now, real=lambda seconds: seconds)
        self.robot, self.seen = robot, []
        self.edge = CameraEdge(self.settings, MARKERS, clock, self._on_sighting)

    def _on_sighting(self, sighting, now):
        self.seen.append(sighting.marker)
        self.robot.world.agent.on_sighting(sighting, now)

    async def __aenter__(self):
        self.task = asyncio.create_task(self.edge.run())
        self.writer = await asyncio.to_thread(self.pipe.open, "wb", buffering=0)
        return self

    async def __aexit__(self, *details):
        self.task.cancel()
        await asyncio.gather(self.task, return_exceptions=True)
        self.writer.close()

    async def look(self):
        """Take a picture in which there is a marker, and wait until it was seen."""
        world, count = self.robot.world, len(self.seen)
        grey = picture((world.x, world.y, world.theta), self.robot.hang, self.settings)
        await asyncio.to_thread(self.writer.write, pgm(grey))
        await until(lambda: len(self.seen) > count, "the marker was seen in the picture")


async def test_robot_that_believes_to_be_in_the_other_of_two_equal_corridors_sees_by_its_camera_where_it_is(tmp_path):
    robot = Seeing((5.6, 6.0, -0.4)).begin(5.6, 2.0, -0.4)
    assert robot.world.error()[0] == pytest.approx(4.0, abs=0.1)
    async with Camera(tmp_path, robot) as camera:
        for _ in range(2):
            robot.world.run(0.5)
            await camera.look()
    robot.world.run(1.0)
    assert set(camera.seen) == {2}
    assert robot.status == "good"
    assert robot.world.error()[0] < 0.1


@pytest.mark.parametrize(
    ("data", "problem"),
    [
        (b"P6\n480 360\n255\n", "no grey PGM of 8 bits"),
        (b"\x89PNG" + bytes(99), "no grey PGM of 8 bits"),
        (b"P5\n640 480\n255\n" + bytes(99), "640 x 480 pixels, and [camera] says 480 x 360"),
    ],
)
def test_pictures_of_another_format_or_size_are_refused_with_what_is_expected(tmp_path, data, problem):
    (tmp_path / "pictures").write_bytes(data)
    given = {name: getattr(CAMERA, name) for name in CameraSettings.__struct_fields__}
    with pytest.raises(CameraError) as error:
        list(pictures(CameraSettings(**given | {"source": str(tmp_path / "pictures")})))
    assert problem in str(error.value)


def test_camera_that_is_not_plugged_in_or_none_is_named_with_a_remedy():
    with pytest.raises(CameraError, match="/dev/v4l/by-id/none does not exist: plug the camera in"):
        list(pictures(CameraSettings(source="/dev/v4l/by-id/none", focal_px=500.0)))
    with pytest.raises(CameraError, match=r"/dev/null gives no pictures: .*, or name another device"):
        list(pictures(CameraSettings(source="/dev/null", focal_px=500.0)))


@pytest.fixture
def router(tmp_path_factory):
    with secured_router(tmp_path_factory.mktemp("router"), SITE, robots=[ROBOT]) as running:
        yield running


@pytest.mark.live
async def test_agent_with_a_camera_looks_for_the_markers_of_its_site(tmp_path, router):
    pipe, file = tmp_path / "pictures", tmp_path / "robot.toml"
    os.mkfifo(pipe)
    file.write_text(
        '[base]\ndriver = "roomba600"\n[lidar]\ndriver = "rplidar-a1"\n[camera]\nwidth_px = 480\nheight_px = 360\n'
        f'focal_px = 420.0\nx_m = 0.1\ny_m = 0.02\nsource = "{pipe}"\n'
    )
    robot = Robot(tmp_path, router, FOGNAV_ROBOT_FILE=str(file))
    marker = MarkerSite(id=7, x=4.0, y=2.1, theta=2.8)
    with (tmp_path / "site" / "site.toml").open("a") as site:
        site.write(f"[[markers]]\nid = 7\nx = {marker.x}\ny = {marker.y}\ntheta = {marker.theta}\n")
    async with robot:
        await robot.localized()
        grey = pgm(picture(robot.body.pose, [marker], CAMERA))

        with await asyncio.to_thread(pipe.open, "wb", buffering=0) as writer:
            await asyncio.to_thread(writer.write, grey)
            seen = 'fognav_marker_sightings_total{marker="7"} 1.0'
            await until(lambda: seen in robot.agent.get("/metrics")[1], "the marker was seen")
        assert robot.error() < 0.2
