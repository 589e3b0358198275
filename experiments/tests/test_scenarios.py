"""Scenarios: every file can be played on its site, and what deviates from its expectation is found.

FOGNAV_SCENARIOS=all plays all of them (about 10 minutes), otherwise some short ones."""

from __future__ import annotations

import math
import os
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest
import ring_site as ring

from fog_contracts.messages import NodeReading, Pose, ReasonCode
from fog_contracts.site import RobotSite
from fog_runtime.configuration.site import load_site
from fognav_experiments.lockstep import DriveEvent
from fognav_experiments.machine import CpuMeter
from fognav_experiments.scenarios.description import Expected, FaultyNode, LinkGap, Scenario, SilentNode, deviations
from fognav_experiments.scenarios.play import (
    Fleet,
    FleetResult,
    Mission,
    Played,
    ScenarioError,
    markdown_page,
    play,
    read_scenario,
)
from fognav_experiments.scenarios.stage import LateNodeSim, SlewedNodeSim, Stage
from fognav_sim.world import World

ROOT = Path(__file__).parents[2]
FILES = {file.stem: file for file in sorted((ROOT / "experiments" / "scenarios").glob("*.toml"))}
PLAYED = (
    sorted(FILES)
    if os.environ.get("FOGNAV_SCENARIOS") == "all"
    else [
        "box-stays",
        "map-restarts",
        "no-way-left",
        "person-stands-8s",
        "robots-2",
        "watched-cone-wifi-0.7s",
        "watched-cone-wifi-2s",
        "wifi-gap-5s",
    ]
)

pytestmark = pytest.mark.timeout(900)


@pytest.mark.parametrize("name", FILES)
def test_every_scenario_is_about_its_site(name):
    scenario = read_scenario(FILES[name])
    site = load_site(ROOT / "sites" / scenario.site)
    assert scenario.title
    others = [point for other in scenario.others for point in (other.start[:2], other.goal)]
    for x, y in (scenario.start[:2], scenario.goal, *others):
        column, row = site.map.geometry.cell(x, y)
        assert site.map.cells[row, column] == 0
    nodes = {node.id for node in site.site.nodes}
    assert {event.node for event in scenario.events if isinstance(event, (FaultyNode, SilentNode))} <= nodes


@pytest.mark.parametrize("name", PLAYED)
@pytest.mark.drive
def test_a_scenario_ends_as_expected(name):
    played = play(read_scenario(FILES[name]), ROOT / "sites")
    assert played.deviations == [], played.result


@pytest.mark.drive
def test_robots_that_meet_at_a_place_for_one_are_never_in_it_together():
    played = play(read_scenario(FILES["narrow-place"]), ROOT / "sites")
    assert played.deviations == [], played.result
    assert isinstance(played.result, FleetResult)
    assert played.result.most_in_place == 1


def test_a_file_with_an_unknown_event_is_refused(tmp_path):
    file = tmp_path / "flood.toml"
    file.write_text('title = "t"\nstart = [0, 0, 0]\ngoal = [1, 1]\n[[events]]\nkind = "flood"\n[expected]\n')
    with pytest.raises(ScenarioError, match=r"flood\.toml: Invalid value 'flood'"):
        read_scenario(file)


def test_several_robots_and_an_event_do_not_go_together(tmp_path):
    file = tmp_path / "both.toml"
    file.write_text(
        'title = "t"\nstart = [0, 0, 0]\ngoal = [1, 1]\n[[others]]\nstart = [5, 5, 0]\ngoal = [6, 6]\n'
        '[[events]]\nkind = "silent-node"\nnode = "n1"\n[expected]\n'
    )
    with pytest.raises(ScenarioError, match="a scenario with others has no events"):
        read_scenario(file)


def test_what_nobody_records_of_several_robots_cannot_be_expected_of_them(tmp_path):
    file, two = tmp_path / "two.toml", FILES["robots-2"].read_text("utf-8")
    for line in ('never = ["PROTECTIVE_STOP"]', 'modes = ["NORMAL"]', 'reason = "pose_lost"'):
        file.write_text(f"{two}{line}\n")
        with pytest.raises(ScenarioError, match=r"two\.toml: .*has no modes, never or reason"):
            read_scenario(file)


def test_the_paths_of_one_robot_are_not_counted(tmp_path):
    file = tmp_path / "one.toml"
    file.write_text('title = "t"\nstart = [0, 0, 0]\ngoal = [1, 1]\n[expected]\nplans = 3\n')
    with pytest.raises(ScenarioError, match="without others expects has no plans"):
        read_scenario(file)


def test_several_robots_that_have_not_ended_are_driving_as_one_is():
    two = read_scenario(FILES["robots-2"])
    short = msgspec.structs.replace(two, seconds=0.5, expected=Expected(outcome="driving"))
    played = play(short, ROOT / "sites")
    assert (played.outcome, played.deviations) == ("driving", [])
    assert "robot r1 is at (30." in played.result.reason


def test_the_table_says_how_many_robots_arrived_and_what_they_cost_the_planner():
    scenario = read_scenario(FILES["robots-2"])
    result = FleetResult(
        contacts=0, reason="", distance_m=28.7, time_s=51.6, arrived=1, gap_m=0.063, plans=2, planner_percent=0.46
    )
    page = markdown_page({"robots-2": Played(scenario, result, "reached", [])}, {"commit": "c"})
    assert "| reached | 28.7 | 52 | yes; 1 of 2 arrived, nearest 0.06 m, 2 paths, planner 0.5 % of a core |" in page


class Result(msgspec.Struct):
    contacts: int = 0
    reason: str = "the robot stands at its goal"
    distance_m: float = 10.0
    time_s: float | None = 40.0


@pytest.mark.parametrize(
    ("expected", "result", "outcome", "words"),
    [
        (Expected(), Result(contacts=1), "reached", "1 contacts"),
        (Expected(outcome="refused"), Result(), "reached", "outcome reached"),
        (Expected(distance_m=(0.0, 9.0)), Result(), "reached", "10.0 m driven"),
        (Expected(time_s=(0.0, 30.0)), Result(), "reached", "it took 40.0 s"),
        (Expected(modes=["FAULT"]), Result(), "reached", "never in FAULT"),
        (Expected(never=["HOLD"]), Result(), "reached", "was in HOLD"),
        (Expected(reason=ReasonCode.BUMPER), Result(), "reached", "no reason bumper"),
    ],
)
def test_each_deviation_from_what_is_expected_is_found(expected, result, outcome, words):
    events = [DriveEvent(time_s=1.0, distance_m=1.0, description="robot: HOLD (the map is old)", codes=["map_old"])]
    (found,) = deviations(expected, result, outcome, events)
    assert words in found
    assert deviations(Expected(modes=["HOLD"], reason=ReasonCode.MAP_OLD), Result(), "reached", events) == []


def test_scenarios_can_be_told_from_one_another():
    titles = [read_scenario(file).title for file in FILES.values()]
    assert len(set(titles)) == len(titles) >= 25
    assert isinstance(read_scenario(FILES["kidnapped"]), Scenario)


def test_nodes_that_fail_at_the_same_time_come_back_each_at_its_own_end():
    again = []
    nodes = [
        SimpleNamespace(node=SimpleNamespace(id=name), on_connected=partial(again.append, name))
        for name in ("n1", "n2", "n3")
    ]
    fog = SimpleNamespace(nodes=nodes)
    drive = SimpleNamespace(now=0.0, driven=0.0, system=SimpleNamespace(fog=fog), log_event=lambda _text: None)
    events = [SilentNode(node="n1", seconds=10.0), SilentNode(node="n2", seconds=20.0)]
    stage = Stage(drive, events)

    def heard(now):
        drive.now = now
        stage.step()
        return sorted(node.node.id for node in fog.nodes)

    assert [heard(now) for now in (0.0, 10.0, 20.0)] == [["n3"], ["n1", "n3"], ["n1", "n2", "n3"]]
    assert again == ["n1", "n2"], "their connection has come back"


def test_gaps_of_the_radio_that_overlap_end_each_at_its_own_end():
    link = SimpleNamespace(hears=True, is_heard=True)
    robot = SimpleNamespace(process=SimpleNamespace(link=link))
    drive = SimpleNamespace(now=0.0, driven=0.0, robot=robot, log_event=lambda _text: None)
    events = [
        LinkGap(seconds=10.0),
        LinkGap(at_s=2.0, seconds=1.0, down=False),
        LinkGap(at_s=8.0, seconds=9.0, up=False),
    ]
    stage = Stage(drive, events)

    def open_ways(now):
        drive.now = now
        stage.step()
        return link.hears, link.is_heard

    both = [open_ways(now) for now in (0.0, 2.0, 3.0, 8.0, 10.0, 17.0)]
    assert both == [(False, False)] * 4 + [(False, True), (True, True)]


def test_the_page_of_scenarios_says_on_what_they_were_played():
    played = Played(read_scenario(FILES["wifi-gap-5s"]), Result(), "reached", [])
    page = markdown_page({"wifi-gap-5s": played}, {"commit": "3baacc2", "machine cores": 2})
    assert "1 in one go, in lockstep; measured on: commit 3baacc2, machine cores 2." in page
    assert "| reached | 10.0 | 40 | yes |" in page


class Readings:
    """A healthy node that has a reading each 0.1 s."""

    node = SimpleNamespace(id="n1")

    def poll(self, _world, now):
        return [NodeReading(seq=1, boot=1, uptime_ms=round(now * 1000), range_m=[1.0], status=["ok"], state="clear")]


def test_readings_of_a_slewed_clock_and_of_a_busy_radio():
    slewed, times = SlewedNodeSim(Readings(), 0.1), iter([0.25, 0.0, 0.0, 0.0])
    assert [slewed.poll(None, now)[0].uptime_ms for now in (5.0, 6.0, 7.0)] == [5000, 6100, 7200]
    late = LateNodeSim(Readings(), lambda: next(times))
    arrived = [[reading.uptime_ms for reading in late.poll(None, now)] for now in (1.0, 1.1, 1.2, 1.3)]
    assert arrived == [[], [], [], [1000, 1100, 1200, 1300]]


# --- several robots ---


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
