"""Robots in the cone of a node: which echoes they explain, and for how long."""

import math
from collections import deque

import msgspec
import pytest
from fusion_rig import PERIOD, START, Rig, area, pose, site
from hypothesis import given, settings
from hypothesis import strategies as st

from fog_contracts.messages import CircleShape, NodeReading, Reported, RobotPose
from fog_contracts.site import NodeSite, RobotSite, Sonar
from hazard_aggregator.fusion import AreaFusion
from hazard_aggregator.registry import find_rule


def read_beside_robot(rig: Rig, robot: RobotPose, ranges: tuple[float, float], times: int = 20) -> None:
    for _ in range(times):
        rig.core.on_pose("r1", robot, rig.now)
        rig.read(*ranges)
        rig.wait(0.0)


@pytest.mark.parametrize("height", [0.3, 0.45])  # above a robot of 0.35 m the cone comes down to it from 0.76 m on
def test_echo_of_a_robot_in_the_cone_does_not_block_a_clear_area(height):
    rig = Rig(site("n1", height))
    rig.read(3.0, 3.0, times=5)
    read_beside_robot(rig, pose(1.0, 0.5), (0.83, 3.0), times=60)
    assert (rig.hazard.state, rig.hazard.explained_by) == ("clear", "r1")
    rig.read(3.0, 3.0, times=5)
    assert (rig.hazard.state, rig.hazard.explained_by) == ("clear", None)


def test_echo_of_a_robot_of_others_does_not_block_a_clear_area_and_no_other_report_explains_one():
    for kind, robot in (("robot", "tb4"), ("obstacle", "tb4"), ("robot", "r1")):
        rig = Rig(site("n1"), robots=[RobotSite(id="r1", start=START, radius=0.17)])
        told = Reported(kind=kind, shape=CircleShape(centre=(1.0, 0.5), radius=0.17), ttl=3.0)
        rig.read(3.0, 3.0, times=5)
        for _ in range(60):
            rig.core.on_reported(robot, told, rig.now)
            rig.read(0.83, 3.0)
            rig.wait(0.0)
        expected = ("clear", "tb4") if (kind, robot) == ("robot", "tb4") else ("blocked", None)
        assert (rig.hazard.state, rig.hazard.explained_by) == expected


def test_echo_of_a_robot_in_the_cone_does_not_clear_a_blocked_area():
    rig = Rig(site("n1"))
    rig.read(0.8, 3.0, times=5)
    read_beside_robot(rig, pose(1.0, 0.5), (0.83, 3.0), times=60)
    assert rig.hazard.state == "blocked"


@pytest.mark.parametrize("stood", [12, 80])  # the second: for longer than the robot explains echoes
def test_area_is_clear_again_when_somebody_has_walked_between_the_node_and_a_robot(stood):
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    before = "clear" if stood == 12 else "unknown"
    for seen, times, expected in ((0.83, stood, before), (0.45, 12, "blocked"), (0.83, 12, "clear")):
        read_beside_robot(rig, pose(1.0, 0.5), (seen, 3.0), times=times)
        assert rig.hazard.state == expected
    assert rig.hazard.explained_by == "r1"
    read_beside_robot(rig, pose(1.0, 0.5), (0.83, 3.0), times=80)
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 200)


@pytest.mark.parametrize(
    ("robot", "ranges"),
    [
        (pose(1.0, 0.5), (0.45, 3.0)),  # a person in front of the robot
        (pose(1.0, 1.3), (0.83, 3.0)),  # the robot beside the cone
        (pose(1.0, 0.5, localized=False), (0.83, 3.0)),  # a robot that is not localized
        (pose(-1.0, 0.5), (0.83, 3.0)),  # a robot behind the node
    ],
)
def test_echo_that_no_robot_explains_blocks(robot, ranges):
    rig = Rig(site("n1"))
    read_beside_robot(rig, robot, ranges, times=5)
    assert rig.hazard.state == "blocked"


def test_pose_older_than_three_seconds_explains_no_echo():
    rig = Rig(site("n1"))
    rig.core.on_pose("r1", pose(1.0, 0.5), rig.now)
    rig.now += 3.01
    rig.read(0.83, 3.0, times=5)
    assert rig.hazard.state == "blocked"


@pytest.mark.parametrize(
    ("robot", "of_the_site"),
    [
        (pose(1.0, 0.5, height=0.35), RobotSite(id="r1", start=START, height=0.1, radius=0.17)),  # below the cone
        (msgspec.structs.replace(pose(1.0, 0.5), radius=0.9), RobotSite(id="r1", start=START, radius=0.17)),
    ],
)
def test_echo_is_explained_by_a_robots_body_of_the_site_not_by_the_one_that_it_claims(robot, of_the_site):
    rig = Rig(site("n1"), robots=[of_the_site])
    rig.read(3.0, 3.0, times=5)
    read_beside_robot(rig, robot, (robot.x - robot.radius, 3.0), times=5)
    assert rig.hazard.state == "blocked"


@pytest.mark.parametrize("heard", [1.0, 0.5])
def test_robot_that_says_that_it_stands_where_an_echo_comes_from_keeps_an_area_clear_for_seconds_only(heard):
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    clear = 0
    for turn in range(250):
        # Something stands there from now on that swallows a part of the echoes.
        read_beside_robot(rig, pose(1.0, 0.5), (0.83, 3.0) if heard == 1.0 or turn % 2 == 0 else (3.0, 3.0), times=1)
        clear += rig.hazard.state == "clear"
    assert clear * PERIOD <= 10.0
    assert rig.hazard.state == "unknown"
    report = rig.core.node_reports(rig.now)[0]
    assert report.state == "unknown"  # which is an alert after a while
    assert report.reason.code == "robot_stays"
    read_beside_robot(rig, pose(-3.0, 0.5), (0.83, 3.0), times=5)
    assert rig.hazard.state == "blocked"


def drive_by(rig: Rig, delay: float, *, box: bool = False, since: float = -1.0) -> list[str]:
    """Drive across the beam at 0.3 m/s; each pose takes `delay` (s) from y = `since` (m) on. Return the states."""
    on_the_way: list[tuple[float, RobotPose]] = []
    first = rig.now
    for _ in range(100):
        y = -1.0 + 0.3 * (rig.now - first)
        moving = msgspec.structs.replace(pose(1.0, y), theta=math.pi / 2, v=0.3, clock=rig.now + 5000.0)
        on_the_way.append((rig.now + (delay if y >= since else 0.0), moving))
        while on_the_way and on_the_way[0][0] <= rig.now:
            rig.core.on_pose("r1", on_the_way.pop(0)[1], rig.now)
        seen = 0.83 if abs(y - 0.5) < 0.3 else 0.9 if box else 3.0
        rig.read(seen, 3.0)
        rig.wait(0.0)
    return [hazard.state for hazard in rig.changes]


@pytest.mark.parametrize("delay", [0.3, 0.5, 0.7, 1.0, 1.5, 2.0])
@pytest.mark.parametrize("since", [-0.9, 0.0, 0.25, 0.5])
def test_robot_whose_poses_come_late_does_not_block_the_corridor_that_it_passes(delay, since):
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    with_and_without_explanation = ["clear", "clear", "clear"]
    assert drive_by(rig, delay, since=since) == ["unknown", *with_and_without_explanation]


def test_block_of_which_late_poses_explain_all_is_taken_back():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    before = msgspec.structs.replace(pose(1.0, -2.0), clock=rig.now + 5000.0)
    rig.core.on_pose("r1", before, rig.now)
    rig.wait(3.5)  # the network holds back what the robot says
    began = rig.now
    rig.read(0.83, 3.0, times=5)
    assert (rig.hazard.state, rig.hazard.penalty) == ("blocked", 254)
    rig.wait(0.1)
    for moment in (began - 0.1, began + 0.2, began + 0.4, rig.now):
        rig.core.on_pose("r1", msgspec.structs.replace(pose(1.0, 0.5), clock=moment + 5000.0), rig.now)
    rig.wait(0.1)
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 200)
    assert rig.hazard.cause == "node n1: it saw the robot r1, whose pose came late"
    rig.read(3.0, 3.0, times=5)
    assert rig.hazard.state == "clear"


def test_robot_that_stands_in_a_cone_is_not_shut_in_because_the_network_held_its_poses_back():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    held: deque[RobotPose] = deque()

    def stand(seconds: float, arriving: int) -> None:
        for _ in range(round(seconds / PERIOD)):
            held.append(msgspec.structs.replace(pose(1.0, 0.5), clock=rig.now + 5000.0))
            for _ in range(min(arriving, len(held))):
                rig.core.on_pose("r1", held.popleft(), rig.now)
            rig.read(0.83, 3.0)
            rig.wait(0.0)

    stand(9.0, arriving=1)
    assert rig.hazard.state == "unknown"  # for it sees nothing else
    stand(3.6, arriving=0)
    assert rig.hazard.state == "blocked"
    stand(3.0, arriving=3)
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 200)


@pytest.mark.parametrize(("others", "penalty"), [((), 200), ((0.4,), 254)])
def test_robot_that_nobody_heard_for_long_is_not_shut_in_by_its_own_echoes_alone(others, penalty):
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    read_beside_robot(rig, pose(1.0, 0.5), (0.83, 3.0), times=5)
    rig.read(0.83, 3.0, times=200)  # the network is away, and the robot stands
    for other in others:
        rig.read(other, 3.0)  # somebody passed meanwhile
    rig.read(0.83, 3.0, times=200)
    assert (rig.hazard.state, rig.hazard.penalty) == ("blocked", 254)
    read_beside_robot(rig, pose(1.0, 0.5), (0.83, 3.0), times=30)
    rig.wait(0.1)
    assert rig.hazard.penalty == penalty


def test_robot_that_says_late_again_and_again_that_it_stood_there_unblocks_an_area_a_few_times_only():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)

    def say(x: float, moment: float) -> None:
        rig.core.on_pose("r1", msgspec.structs.replace(pose(x, 0.5), clock=moment + 5000.0), rig.now)

    say(-3.0, rig.now)
    rig.changes.clear()
    before, passable = rig.now, 0
    for _ in range(300):
        rig.read(0.83, 3.0)  # a box
        rig.now += 0.02
        for x, moment in ((1.0, before + 0.002), (1.0, rig.now - 0.002), (-3.0, rig.now - 0.001)):
            say(x, moment)
        before = rig.now
        rig.wait(0.0)
        passable += rig.hazard.penalty < 254
    assert passable * PERIOD <= 3.0
    assert rig.hazard.state == "blocked"
    rig.read(3.0, 3.0, times=5)
    assert rig.hazard.state == "clear"


def test_block_that_late_poses_explain_in_part_stays():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    rig.core.on_pose("r1", msgspec.structs.replace(pose(1.0, -2.0), clock=rig.now + 5000.0), rig.now)
    rig.wait(3.5)
    rig.read(0.4, 3.0)  # somebody before the robot, once
    began = rig.now
    rig.read(0.83, 3.0, times=5)
    rig.wait(0.1)
    for moment in (began - 0.2, began, rig.now):
        rig.core.on_pose("r1", msgspec.structs.replace(pose(1.0, 0.5), clock=moment + 5000.0), rig.now)
    rig.wait(0.5)
    assert (rig.hazard.state, rig.hazard.penalty) == ("blocked", 254)


def test_box_that_one_node_saw_stays_impassable_when_late_poses_explain_another_nodes_block():
    rig = Rig(site("n1"), site("n2"))
    for node in ("n1", "n2"):
        rig.read(3.0, 3.0, node=node, times=5)
    rig.core.on_pose("r1", msgspec.structs.replace(pose(1.0, -2.0), clock=rig.now + 5000.0), rig.now)
    rig.wait(3.5)
    rig.read(0.4, 3.0, node="n2", times=5)  # a box, and the node is never heard again
    began = rig.now
    for _ in range(19):
        rig.read(0.83, 3.0, node="n1", times=2)
        rig.wait(0.1)
    assert rig.hazard.state == "blocked"
    for moment in (began - 0.2, began, began + 1.5, rig.now):
        rig.core.on_pose("r1", msgspec.structs.replace(pose(1.0, 0.5), clock=moment + 5000.0), rig.now)
    rig.wait(0.1)
    assert rig.hazard.nodes == {"n1": "unknown", "n2": "unknown"}
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 254)


@pytest.mark.parametrize("delay", [0.0, 0.7, 2.0])
def test_box_in_a_corridor_stays_blocked_while_a_robot_passes_it(delay):
    rig = Rig(site("n1"))
    rig.read(0.9, 3.0, times=5)
    rig.changes.clear()
    assert "clear" not in drive_by(rig, delay, box=True)
    assert (rig.hazard.state, rig.hazard.penalty) == ("blocked", 254)


def test_unexplained_echo_of_one_sonar_blocks_although_a_robot_explains_the_other():
    rig = Rig(site("n1"))
    read_beside_robot(rig, pose(1.0, 0.47), (0.83, 0.4), times=5)
    assert rig.hazard.state == "blocked"


@given(st.floats(-math.pi, math.pi), st.floats(0.3, 1.3), st.floats(-0.6, 0.6))
@settings(max_examples=60, deadline=None)
def test_explained_echoes_do_not_depend_on_the_sites_rotation(rotation, distance, bearing):
    def outcome(theta: float) -> str:
        x, y = distance * math.cos(theta + bearing), distance * math.sin(theta + bearing)
        node = NodeSite(id="n1", area="hall", x=0.0, y=0.0, theta=theta, sonars=[Sonar(range_limit=1.25)])
        core = AreaFusion([area("n1")], [node], 1, registry=find_rule, default_rule="consecutive")
        core.on_pose("r1", pose(x, y), 0.0)
        for seq in range(5):
            echo = NodeReading(
                seq=seq,
                boot=1,
                uptime_ms=100 * seq,
                range_m=[max(distance - 0.17, 0.05)],
                status=["ok"],
                state="blocked",
            )
            core.on_reading("n1", echo, 0.0, 0.0)
        return core.hazards()[0].state

    edge = abs(abs(bearing) - math.asin(0.17 / distance) - math.radians(7.5))
    if edge > 1e-6:
        assert outcome(0.0) == outcome(rotation)
