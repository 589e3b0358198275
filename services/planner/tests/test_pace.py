"""When robots arrive: speed limits, the pace that each one shows, and the interval."""

from __future__ import annotations

import json

import numpy as np
import pytest
from msgspec import json as encoder
from ring_map import RIGHT, RingMap, goal, pose

from fog_contracts import channels as ch
from fog_contracts.grid import GridGeometry
from fog_contracts.handlers import Moment
from fog_contracts.messages import RobotState
from planner.core import PlannerCore
from planner.path_search import Route
from planner.planning_map import USUAL_SPEED
from planner.waits.pace import ARRIVAL_S, PaceRecord, Paces, Times

GEOMETRY = GridGeometry(200, 50, 0.1, 0.0, 0.0)
LINE = Route(np.array([(1.0, 2.0), (11.0, 2.0)]), 0.05)


def drive(paces: Paces, ratio: float, usual: float = 30.0, plan: int = 1, now: float = 0.0) -> None:
    for step in range(101):
        seconds = usual * step / 100.0
        paces.on_progress("r1", plan, seconds, now + ratio * seconds, drives=True)
    paces.end("r1")


def test_way_takes_its_length_at_the_usual_speed_and_longer_where_a_limit_is_lower():
    speed = np.zeros(GEOMETRY.shape, np.uint8)
    free = Times.of(LINE, speed, GEOMETRY)
    assert free.rest(0.0) == pytest.approx(10.0 / USUAL_SPEED)
    assert free.rest(4.0) == pytest.approx(6.0 / USUAL_SPEED)
    speed[:, 31:51] = 10  # 10 cm/s for 2 m
    slow = Times.of(LINE, speed, GEOMETRY)
    assert slow.rest(0.0) == pytest.approx(8.0 / USUAL_SPEED + 2.0 / 0.1, abs=0.6)
    speed[:] = 200
    assert Times.of(LINE, speed, GEOMETRY).rest(0.0) == pytest.approx(free.rest(0.0)), "never faster than the robot"


def test_arrival_follows_the_robots_own_pace_and_its_interval_how_much_that_varies():
    assert Paces().arrival("r1", 100.0).expected_s == pytest.approx(113.3 + ARRIVAL_S, abs=0.1)
    steady, varied, rng = Paces(), Paces(), np.random.default_rng(1)
    for number in range(40):
        drive(steady, 1.4, plan=number)
        drive(varied, float(rng.uniform(1.2, 1.8)), plan=number)
    assert steady.arrival("r1", 100.0).expected_s == pytest.approx(139.0 + ARRIVAL_S, abs=2.0)
    assert steady.arrival("r1", 100.0).latest_s <= 141.0 + ARRIVAL_S
    arrival = varied.arrival("r1", 100.0)
    assert (arrival.earliest_s, arrival.latest_s) == pytest.approx((123.0 + ARRIVAL_S, 177.0 + ARRIVAL_S), abs=7.0)
    assert arrival.expected_s == pytest.approx(150.0 + ARRIVAL_S, abs=5.0)
    assert steady.arrival("r2", 100.0) == Paces().arrival("r2", 100.0), "another robot has not driven"


def test_nine_in_ten_drives_are_in_the_interval_although_short_ones_differ_more_than_long_ones():
    rng = np.random.default_rng(2)
    paces, inside, drives = Paces(), 0, 400
    for number in range(drives):
        usual, spread = ((15.0, 0.15), (150.0, 0.02))[number % 2]
        ratio, arrival = float(rng.normal(1.2, spread)), paces.arrival("r1", usual)
        inside += arrival.earliest_s <= usual * ratio + ARRIVAL_S <= arrival.latest_s
        drive(paces, ratio, usual, plan=number)
    assert inside == pytest.approx(0.9 * drives, rel=0.05)


def test_time_in_which_a_robot_must_not_drive_or_is_not_heard_is_no_pace():
    paces = Paces()
    for number in range(40):
        for now, seconds, drives in ((0.0, 0.0, True), (2.0, 5.0, True), (500.0, 5.0, True), (502.0, 15.0, True)):
            paces.on_progress("r1", number, seconds, now, drives=drives)
        for now in (503.0, 504.0):
            paces.on_progress("r1", number, 15.0, now, drives=False)
        paces.end("r1", 20.0)
    (record,) = paces.to_store().values()
    assert np.array(record.stretches) == pytest.approx(np.array([(20.0, (4.0 - ARRIVAL_S) / 20.0)] * 40))


def test_way_that_a_robot_drives_slowly_on_purpose_or_unheard_is_left_out_of_its_pace_with_its_time():
    paces = Paces()
    seconds, now = 0.0, 0.0
    for drives, gap, ratio in ((True, 1.0, 1.8), (False, 1.0, 3.0), (True, 30.0, 2.0), (True, 1.0, 1.8)):
        for _ in range(60):
            paces.on_progress("r1", 1, seconds, now, drives=drives)
            now, seconds = now + gap, seconds + gap / ratio
    paces.end("r1")
    (record,) = paces.to_store().values()
    ((usual, ratio),) = record.stretches
    assert usual == pytest.approx(2 * 60.0 / 1.8, rel=0.05)
    assert ratio == pytest.approx(1.8, rel=0.05)


def test_paces_are_the_same_after_a_restart():
    paces, again = Paces(), Paces()
    drive(paces, 1.5)
    stored = {
        robot: encoder.decode(encoder.encode(record), type=PaceRecord) for robot, record in paces.to_store().items()
    }
    assert json.loads(encoder.encode(stored))["r1"]["stretches"] == [[30.0, pytest.approx(1.5)]]
    again.restore(stored)
    assert again.arrival("r1", 50.0) == paces.arrival("r1", 50.0)
    assert again.to_store() == paces.to_store() == {}
    paces.store_again(stored)
    assert set(paces.to_store()) == {"r1"}


def test_robot_that_drives_a_path_teaches_its_pace_and_has_an_arrival_only_while_it_has_a_path():
    ring = RingMap()
    core, now = PlannerCore(epoch=7), 100.0
    core.load(ring.master.snapshot(), now)
    core.set_goal("r1", goal(*RIGHT))
    assert core.arrival("r1") is None

    def tell(x: float, y: float, *, reached: str | None = None) -> None:
        at = Moment(now, now + 1e9)
        core.handlers()[ch.MAP_HEARTBEAT]({}, ring.master.heartbeat(now), at)
        core.handlers()[ch.ROBOT_POSE]({"robot": "r1"}, pose(x, y), at)
        state = RobotState(
            mode="NORMAL", reasons=[], enabled=True, battery=None, goal_id=reached or "g1", map_epoch=1, map_seq=0,
            plan_id=1, planner_epoch=7, goal_reached=reached is not None,
        )  # fmt: skip
        core.handlers()[ch.ROBOT_STATE]({"robot": "r1"}, state, at)
        core.tick(at)

    assert core.arrival("nobody") is None
    assert [robot for robot, _ in core.missions.items()] == ["r1"], "who asks changes nothing"
    tell(1.0, 6.0)
    plan = core.missions.of("r1").plan
    assert plan is not None
    assert plan.route is not None
    arrivals = []
    before = plan.route.points[0]
    for point in plan.route.points:
        now += float(np.hypot(*(point - before))) / 0.2  # m/s
        before = point
        tell(float(point[0]), float(point[1]))
        arrivals.append(core.arrival("r1"))
    tell(*before, reached="g0")
    assert core.paces.to_store() == {}, "the goal before: the robot drives on"
    assert arrivals[0].expected_s > arrivals[100].expected_s > arrivals[-1].expected_s
    tell(*RIGHT, reached="g1")
    assert core.arrival("r1") is None
    (record,) = core.paces.to_store().values()
    ((usual, ratio),) = record.stretches
    assert usual == pytest.approx(plan.route.length / USUAL_SPEED, rel=0.02)
    assert ratio * usual + ARRIVAL_S == pytest.approx(plan.route.length / 0.2, rel=0.03)
