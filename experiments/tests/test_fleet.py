"""Robots of a fleet, each in a world of its own, are in one another's way: bodies that touch are a contact."""

from __future__ import annotations

import importlib.util
import math
from pathlib import Path

import numpy as np
import pytest

from fog_contracts.messages import Pose
from fog_contracts.site import RobotSite
from fognav_experiments.machine import CpuMeter
from fognav_experiments.scenarios.fleet import Fleet, Mission
from fognav_sim.world import World

_spec = importlib.util.spec_from_file_location("ring_site", Path(__file__).parent / "ring_site.py")
ring = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(ring)

APART_M = 0.8


def fleet_of(*starts):
    missions = [
        Mission(RobotSite(id=f"r{n}", start=Pose(x=x, y=1.5, theta=t), radius=0.17), (7.5, 1.5)) for n, (x, t) in starts
    ]
    return Fleet(ring.ring_site(), missions, 1, CpuMeter())


def facing():
    return fleet_of((1, (7.0, 0.0)), (2, (7.0 + APART_M, math.pi)))


def drive_whatever_is_commanded(monkeypatch, vehicle, speed):
    vehicle.world.set_wheels(speed, speed)
    monkeypatch.setattr(vehicle.world, "set_wheels", lambda *_: None)


def gap_of(fleet):
    one, other = (vehicle.world for vehicle in fleet.vehicles)
    return math.dist(one.pose[:2], other.pose[:2]) - one.robot.radius - other.robot.radius


@pytest.mark.parametrize(("first", "second"), [(0.3, 0.3), (0.3, 0.05), (0.3, 0.0), (0.3, -0.1)])
def test_robot_that_drives_into_another_has_a_contact_and_their_bodies_never_overlap(monkeypatch, first, second):
    fleet = facing()
    for vehicle, speed in zip(fleet.vehicles, (first, second), strict=True):
        drive_whatever_is_commanded(monkeypatch, vehicle, speed)
    while fleet.now < 4.0 and not fleet.vehicles[0].world.contacts:
        fleet.step()
        assert gap_of(fleet) >= 0.0
    assert fleet.vehicles[0].world.contacts == 1
    assert fleet.vehicles[0].world.bumpers == (True, True)
    assert fleet.vehicles[1].world.contacts == (1 if second == first else 0)
    assert fleet.least_gap_m == pytest.approx(0.0, abs=0.01)
    for _ in range(100):
        fleet.step()
        assert gap_of(fleet) >= 0.0


def test_robot_that_stops_two_centimetres_before_another_has_none(monkeypatch):
    fleet = facing()
    drive_whatever_is_commanded(monkeypatch, fleet.vehicles[0], 0.1)
    while gap_of(fleet) > 0.02:
        assert fleet.now < 60.0, f"the two robots have come no nearer than {gap_of(fleet):.3f} m in a minute"
        fleet.step()
    World.set_wheels(fleet.vehicles[0].world, 0.0, 0.0)
    for _ in range(100):
        fleet.step()
    assert 0.0 < fleet.least_gap_m <= 0.02
    assert [vehicle.world.contacts for vehicle in fleet.vehicles] == [0, 0]


def test_lidar_sees_another_robot_where_it_has_come_nearer_than_three_centimetres(monkeypatch):
    fleet = facing()
    drive_whatever_is_commanded(monkeypatch, fleet.vehicles[1], 0.1)
    while gap_of(fleet) > 0.02:
        assert fleet.now < 60.0, f"the two robots have come no nearer than {gap_of(fleet):.3f} m in a minute"
        fleet.step()
    seen = fleet.vehicles[0].world.lidar(np.array([0.0]), fleet.now)[0]
    assert seen == pytest.approx(0.17 + gap_of(fleet), abs=0.03)


def test_robots_that_start_in_one_another_are_refused():
    with pytest.raises(ValueError, match="robot r1 stands in another one: move its start"):
        fleet_of((1, (7.0, 0.0)), (2, (7.3, 0.0)))
