"""A robot that was put down elsewhere, where two rooms look alike, finds out where it is by a turn: all cores."""

import math
from pathlib import Path

import numpy as np
import ring_site as ring

from fog_contracts.grid import GridGeometry, StaticMap
from fog_contracts.messages import Place, Pose
from fog_contracts.site import RobotSite, Site
from fog_runtime.configuration.site import LoadedSite

ROOMS = [(1.0, 1.0, 4.5, 4.0), (6.0, 1.0, 9.5, 4.0), (7.6, 4.0, 8.4, 4.3)]
"""Left, bottom, right, top (m); the last one is a niche that is too shallow to tell the rooms apart by one scan."""


def two_rooms() -> LoadedSite:
    geometry = GridGeometry(220, 120, 0.05, 0.0, 0.0)
    cells = np.full(geometry.shape, 254, np.uint8)
    for room in ROOMS:
        left, bottom, right, top = (round(20 * value) for value in room)
        cells[bottom:top, left:right] = 0
    robot = RobotSite(id="r1", start=Pose(x=2.5, y=1.5, theta=-0.5), radius=0.17)
    site = Site(id="rooms", places={"a": Place(x=8.8, y=3.3, theta=0.0)}, areas=[], nodes=[], robots=[robot])
    return LoadedSite(site, StaticMap(geometry, cells), Path())


def test_turn_decides_where_the_robot_is_so_that_it_may_be_enabled():
    run = ring.Run(two_rooms())

    def until(condition, seconds):
        run.until(lambda: run.state and condition(run.state), seconds)

    run.system.world.kidnap(Pose(x=7.3, y=2.3, theta=1.2))
    until(lambda state: len(state.places) > 1, 40.0)
    assert any(math.dist((place.x, place.y), (7.3, 2.3)) < 0.2 for place in run.state.places)
    assert "the pose is lost" in run.system.robot.command("enable").reason
    assert run.system.robot.command("turn").accepted
    until(lambda state: state.mode == "EGRESS", 1.5)
    until(lambda state: state.mode == "INIT", 20.0)
    until(lambda state: not state.places, 1.5)
    assert math.dist(run.system.world.pose[:2], (7.3, 2.3)) < 0.05
    pose = run.system.robot.agent.localizer.pose(run.system.now)
    assert math.dist((pose.x, pose.y), run.system.world.pose[:2]) < 0.1
    until(lambda _: run.system.robot.agent.localizer.status == "good", 3.0)
    assert run.system.robot.command("enable").accepted
    until(lambda state: state.mode == "NORMAL", 5.0)
    assert run.system.world.contacts == 0
