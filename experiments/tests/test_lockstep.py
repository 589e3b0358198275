"""Whole drives in lockstep, from the sensor nodes to the wheels, evaluated by the simulator's ground truth."""

import math
from pathlib import Path

import msgspec
import pytest
import ring_site as ring

from fog_contracts.bus import Bus
from fog_contracts.geometry import contains_point
from fog_runtime.configuration.site import load_site
from fognav_experiments.lockstep import run_lockstep
from fognav_experiments.rigs import FogRig
from fognav_sim.barrier import BarrierError
from fognav_sim.drive.hazard import HazardRequest
from fognav_sim.floor import Floor
from fognav_sim.nodes import FirmwareError, FirmwareNode, find_compiler
from fognav_sim.world import World

ESTIG = Path(__file__).parents[2] / "sites" / "estig"
pytestmark = pytest.mark.timeout(900)


BLOCKED = HazardRequest(area="z1", trigger_m=0.5)


def drive(seed, hazard=None, **more):
    return run_lockstep(ring.ring_site(), ring.START, ring.GOAL, seed, hazard, **more)


@pytest.fixture(scope="module")
def free():
    return drive(3)


@pytest.fixture(scope="module")
def warned():
    return drive(3, BLOCKED)


def test_robot_without_a_hazard_takes_the_short_path_through_the_watched_area(free):
    assert (free.outcome, free.contacts, free.route_areas) == ("reached", 0, ["z1"]), free.reason
    assert free.min_clearance_m > 0.1
    assert free.distance_m == pytest.approx(free.planned_m, abs=1.0)


@pytest.mark.drive
def test_robot_with_another_base_and_lidar_reaches_its_goal():
    other = drive(3, base="diffdrive", lidar="ld19")
    assert (other.outcome, other.contacts) == ("reached", 0), other.reason
    assert other.pose_error_m < 0.15
    assert other.operator_commands == 1
    assert other.distance_m == pytest.approx(other.planned_m, abs=1.0)


def test_robot_in_a_watched_area_raises_no_hazard(free):
    assert not [event for event in free.events if event.description.startswith("area z1: blocked")]
    assert free.plans == 1


def test_robot_drives_around_a_blocked_area_before_its_lidar_can_see_it(warned, free):
    assert (warned.outcome, warned.contacts, warned.route_areas) == ("reached", 0, []), warned.reason
    area = ring.ring_site().site.areas[0]
    assert not any(contains_point(area.polygon, *point) for point in warned.track)
    assert warned.plans >= 2
    assert warned.distance_m > free.distance_m
    assert warned.min_clearance_m > 0.1
    assert warned.area_clearance_m > 1.0
    assert warned.success


def test_hazard_reaches_the_wheels_within_a_second_and_every_stage_is_stamped(warned):
    stages = warned.stages_ms
    assert set(stages) == {"debounce", "costmap", "plan", "deliver", "command", "total"}
    assert stages["total"] == pytest.approx(sum(v for k, v in stages.items() if k != "total"), abs=0.5)
    # Five readings at 8 to 10 a second, then the next decision and wheel command.
    assert 30.0 < stages["debounce"] < 350.0  # two clear echoes of one sonar
    assert stages["total"] < 1000.0


@pytest.mark.drive
def test_robot_without_nodes_meets_the_barrier_once_and_remembers_it():
    site = load_site(ESTIG)
    # In the corridor of the barrier, because a shorter drive shows the same.
    begin = msgspec.structs.replace(site.site.robots[0].start, x=20.0, y=39.2, theta=0.0)
    met = run_lockstep(site, begin, site.site.places["b"], 1, HazardRequest(area="z4", trigger_m=0.5), watched=False)
    assert (met.outcome, met.contacts) == ("reached", 0), met.reason
    barrier = next(area.polygon for area in site.site.areas if area.id == "z4")
    distances = [math.dist(point, barrier[0]) for point in met.track]
    nearest = distances.index(min(distances))
    assert 9.0 < min(distances) < 12.5, "the robot must turn as soon as it is sure, and not before it sees the barrier"
    assert min(distances[nearest + 60 :]) > 9.0, "the robot must not come back to the barrier"
    assert met.plans == 2, "all of the barrier must be known at once"
    assert met.distance_m < 90.0


def test_same_seed_repeats_the_drive_exactly_and_another_seed_changes_it(warned, free):
    assert msgspec.json.encode(drive(3, BLOCKED)) == msgspec.json.encode(warned)
    assert drive(4).track != free.track


def test_sensor_nodes_run_the_firmware_wherever_it_compiles():
    try:
        find_compiler()
    except FirmwareError as error:
        pytest.skip(str(error))
    site = ring.ring_site()
    rig = FogRig(
        site,
        World(Floor(site.map.geometry, site.map.cells), site.site.robots[0], 1, axle_m=0.235),
        Bus(site.site.id),
        1,
        0.0,
    )
    assert rig.nodes
    assert all(isinstance(node, FirmwareNode) for node in rig.nodes)


def test_unknown_area_is_refused_with_the_known_ones():
    with pytest.raises(BarrierError, match="no area 'z9'; it has: z1"):
        drive(1, HazardRequest(area="z9"))
