"""Maneuvers in numbers: turns in place, straight ways, the way out of a blocked area, and who is told of them."""

from __future__ import annotations

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
from little_world import AGENT

from fog_contracts.messages import PlanReply, Refusal
from robot_agent.agent.maneuvers import Egress, Maneuvers, Straight, Turning
from robot_agent.agent.path_driving import PathDriving
from robot_agent.localization.localizer import Localizer
from robot_agent.localization.pose import Pose2
from robot_agent.safety.gate import SafetyOutputs, SafetyState
from robot_agent.safety.maneuver import Maneuver

ORIGIN = Pose2(0.0, 0.0, 0.0)
HALF_AXLE_M = 0.5 * AGENT.drive_train.axle_m


def facing(theta: float) -> Pose2:
    return Pose2(3.0, 1.0, theta)


# --- turning in place ---


def turning(first: float = 0.0) -> Turning:
    made = Turning(0.2, 2.75)
    made.begin(facing(first))
    return made


def test_robot_turns_by_0_7_rad_to_the_left_to_the_right_and_back():
    turn, headings, theta = turning(3.0), [], 3.0
    for _ in range(400):
        turn.advance(facing(theta))
        left, right = turn.wheels(facing(theta))
        if left == right == 0.0:
            break
        assert left == -right
        before, theta = theta, theta + 0.05 * (right - left) / 0.2
        headings += [before] if (theta - before) * (before - (headings[-1] if headings else 2.9)) < 0 else []
    assert theta == pytest.approx(3.0, abs=0.04)
    assert headings == pytest.approx([3.7, 2.3], abs=0.05)
    assert turn.remaining(facing(theta)) == 0.0


@pytest.mark.parametrize("rate", [0.2, 0.3])
def test_no_maneuver_turns_faster_than_the_robot_may(rate):
    slow = replace(AGENT, motion=replace(AGENT.motion, limits=replace(AGENT.motion.limits, w_max=rate)))
    turn = Turning(0.2, rate)
    turn.begin(ORIGIN)
    assert turn.wheels(ORIGIN) == pytest.approx((-0.1 * rate, 0.1 * rate))
    egress = Egress(slow)
    ask_and_reply(egress, WAY_OUT, ORIGIN, 1.0)
    for heading in (-3.0, -0.3, -0.1, 0.2, 1.5):
        left, right = egress.wheels(Pose2(0.0, 0.0, heading))
        v, w = 0.5 * (left + right), (right - left) / (2 * HALF_AXLE_M)
        assert abs(w) == pytest.approx(min(rate, 2.0 * abs(heading)))
        assert (v > 0.0) == (abs(heading) < 0.35)
    maneuvers = Maneuvers(slow, MeasuredWheels(), Guard())
    maneuvers.inputs(state("turn"), None, ORIGIN, 1.0)
    assert maneuvers._wheels("turn", 1.0) == pytest.approx((-rate * HALF_AXLE_M, rate * HALF_AXLE_M))


def test_turn_without_odometry_neither_moves_nor_ends():
    turn = Turning(0.2, 2.75)
    assert turn.remaining(ORIGIN) == math.inf
    assert turn.wheels(ORIGIN) == (0.0, 0.0)
    turn.begin(None)
    assert turn.remaining(ORIGIN) == math.inf
    turn.begin(ORIGIN)
    assert turn.remaining(None) == math.inf
    assert turn.wheels(None) == (0.0, 0.0)


# --- straight ways ---


def test_straight_way_ahead_ends_where_its_length_is_driven():
    way = Straight(0.4, 0.1)
    assert way.wheels == (0.1, 0.1)
    assert way.remaining(ORIGIN) == math.inf
    way.begin(facing(math.pi))
    assert way.remaining(facing(math.pi)) == pytest.approx(0.4)
    assert way.remaining(Pose2(2.7, 1.2, math.pi)) == pytest.approx(0.1)
    way.begin(None)
    assert way.remaining(ORIGIN) == math.inf


def ahead(x: float) -> Pose2:
    return Pose2(x, 0.0, 0.0)


def test_way_back_of_a_robot_that_still_rolls_ahead_counts_from_where_it_turns_round():
    way = Straight(-0.09, 0.05)
    way.advance(ORIGIN)
    assert way.remaining(ORIGIN) == math.inf, "it has not begun"
    way.begin(ORIGIN)
    for x, left in ((0.02, 0.09), (0.03, 0.09), (0.02, 0.08), (-0.05, 0.01)):
        way.advance(ahead(x))
        way.advance(None)
        assert way.remaining(ahead(x)) == pytest.approx(left)


def test_robot_that_is_moved_the_other_way_by_more_than_5_cm_has_all_of_that_to_go_back():
    way = Straight(0.4, 0.1)
    for _ in range(2):
        way.begin(ORIGIN)
        way.advance(ahead(-0.03))
        way.advance(ahead(-0.05))
        assert way.remaining(ahead(-0.05)) == pytest.approx(0.4)
        way.advance(ahead(-0.06))
        assert way.remaining(ahead(-0.06)) == pytest.approx(0.41)


# --- the way out ---


def outputs(mode="EGRESS") -> SafetyOutputs:
    return SafetyOutputs(mode, (), 0.1, "none", changed=False, refusal=None)


WAY_OUT = PlanReply(points=[(0.0, 0.0), (1.0, 0.0)])


def ask_and_reply(egress, reply, pose, now):
    """Let the planner answer at once."""
    egress.on_reply(egress.request(ORIGIN, outputs(), now), reply, pose, now)


def test_planner_is_asked_once_a_second_until_it_gives_a_way_out():
    egress = Egress(AGENT)
    assert egress.request(ORIGIN, outputs("INIT"), 5.0) is None
    assert egress.request(None, outputs(), 5.0) is None
    asked = egress.request(Pose2(1.0, 2.0, 0.5), outputs(), 5.0)
    assert asked is not None
    assert (asked.robot, asked.pose.x, asked.pose.y, asked.pose.theta) == (AGENT.robot, 1.0, 2.0, 0.5)
    assert egress.request(ORIGIN, outputs(), 5.99) is None
    assert egress.request(ORIGIN, outputs(), 6.0) is not None
    egress.begin()
    newest = egress.request(ORIGIN, outputs(), 6.1)
    assert newest is not None, "a new egress asks at once"
    egress.on_reply(newest, WAY_OUT, ORIGIN, 6.2)
    assert egress.request(ORIGIN, outputs(), 60.0) is None


def test_what_keeps_the_robot_from_a_way_out_is_told_until_there_is_one():
    egress = Egress(AGENT)
    assert egress.problem(None) is None
    assert egress.problem("a chair") == "a chair"
    ask_and_reply(egress, None, ORIGIN, 1.0)
    assert egress.problem("a chair") == "the planner does not answer"
    ask_and_reply(egress, PlanReply(refusal=Refusal(code=208, reason="walled in")), ORIGIN, 2.0)
    assert egress.problem(None) == "walled in"
    ask_and_reply(egress, PlanReply(points=[(0.0, 0.0)]), ORIGIN, 3.0)
    assert egress.remaining == math.inf, "one point is no way"
    ask_and_reply(egress, WAY_OUT, None, 4.0)
    assert egress.remaining == math.inf, "it can't tell whether the way begins here"
    assert egress.problem(None) == "the robot does not know where it is"
    earlier = egress.request(Pose2(0.1, 0.0, 0.0), outputs(), 5.0)
    ask_and_reply(egress, WAY_OUT, ORIGIN, 6.0)
    assert egress.problem(None) is None
    egress.on_reply(earlier, None, ORIGIN, 7.0)
    assert egress.problem(None) is None, "a later reply changes nothing"
    egress.begin()
    assert (egress.remaining, egress.problem(None)) == (math.inf, None)


@pytest.mark.parametrize(("moved_m", "followed"), [(0.2, True), (0.3, False), (2.0, False)])
def test_way_out_that_was_asked_for_elsewhere_is_not_followed_and_asked_for_anew(moved_m, followed):
    egress = Egress(AGENT)
    request = egress.request(ORIGIN, outputs(), 1.0)
    here = Pose2(0.6 * moved_m, -0.8 * moved_m, 2.0)
    egress.on_reply(request, WAY_OUT, here, 3.9)
    assert math.isfinite(egress.remaining) == followed
    if not followed:
        assert f"the robot is {moved_m:.1f} m from where it asked" in egress.problem(None)
        assert egress.wheels(here) == (0.0, 0.0)
        again = egress.request(here, outputs(), 4.0)
        assert (again.pose.x, again.pose.y) == (here.x, here.y)
        egress.on_reply(again, PlanReply(points=[(here.x, here.y), (here.x + 1.0, here.y)]), here, 4.5)
        assert egress.remaining == pytest.approx(1.0)
        assert egress.problem(None) is None


@pytest.mark.parametrize("reply", [WAY_OUT, None, PlanReply(refusal=Refusal(code=208, reason="walled in"))])
def test_reply_to_what_an_earlier_egress_asked_is_nobodys(reply):
    egress = Egress(AGENT)
    request = egress.request(ORIGIN, outputs(), 1.0)
    egress.begin()
    egress.request(Pose2(0.1, 0.0, 0.0), outputs(), 1.5)
    egress.on_reply(request, reply, ORIGIN, 2.0)
    assert (egress.remaining, egress.problem(None)) == (math.inf, None)


def test_way_that_remains_is_counted_by_way_of_its_nearest_point():
    egress = Egress(AGENT)
    egress.advance(ORIGIN, 1.0)
    assert egress.remaining == math.inf
    ask_and_reply(egress, WAY_OUT, Pose2(0.15, 0.1, 0.0), 2.0)
    assert egress.remaining == pytest.approx(0.85 + 0.1)
    egress.advance(None, 3.0)
    assert egress.remaining == pytest.approx(0.85 + 0.1)
    egress.advance(Pose2(0.5, 0.0, 0.0), 3.0)
    assert egress.remaining == pytest.approx(0.5)


def test_robot_follows_its_way_out_at_the_speed_of_an_egress():
    egress = Egress(AGENT)
    assert egress.wheels(ORIGIN) == (0.0, 0.0)
    ask_and_reply(egress, WAY_OUT, ORIGIN, 1.0)
    assert egress.wheels(None) == (0.0, 0.0)
    assert egress.wheels(ORIGIN) == pytest.approx((0.1, 0.1))
    left, right = egress.wheels(facing(math.pi / 2)._replace(x=0.0, y=0.0))
    assert left == -right == pytest.approx(0.8 * HALF_AXLE_M)


# --- all of them ---


class Guard:
    reason = "a chair"

    def blindness(self, wheels):
        return f"nothing at {wheels}"

    def limit(self, wheels, _now):
        return wheels

    def hazard(self, wheels, without, _now):
        self.asked = wheels, without
        return "a person"


class MeasuredWheels:
    """The localizer of a robot at rest, whose wheels have turned as far as its pose in `odom` says."""

    def __init__(self) -> None:
        self.odom: Pose2 | None = ORIGIN
        self.place: Pose2 | None = ORIGIN
        self.speeds = (0.0, 0.0)

    def odom_at(self, _now):
        return self.odom

    def latest_odom(self):
        return self.odom

    def pose(self, _now):
        return self.place

    def twist(self):
        return self.speeds

    def points_in_map(self):
        return None


def state(kind=None, **more) -> SafetyState:
    return SafetyState(maneuver=None if kind is None else Maneuver(0.0, math.inf, 0.0, kind), **more)


@pytest.fixture
def localizer():
    return MeasuredWheels()


@pytest.fixture
def maneuvers(localizer):
    return Maneuvers(AGENT, localizer, Guard())


@pytest.mark.parametrize(("kind", "length", "sign"), [("undock", 0.3, -1), ("back_off", 0.09, -1), ("advance", 0.4, 1)])
def test_gate_is_told_how_much_of_a_straight_way_is_left_and_what_stops_it(maneuvers, localizer, kind, length, sign):
    begun = maneuvers.inputs(state(kind), None, None, 1.0)
    assert begun.remaining == pytest.approx(length)
    assert begun.problem == "a chair"
    localizer.odom = Pose2(sign * 0.05, 0.0, 0.0)
    assert maneuvers.inputs(state(kind), None, None, 2.0).remaining == pytest.approx(length - 0.05)
    maneuvers.inputs(state(), None, None, 3.0)
    assert maneuvers.inputs(state(kind), None, None, 4.0).remaining == pytest.approx(length), "it begins anew"


def test_gate_is_told_how_far_a_turn_has_to_go_and_what_stops_it(maneuvers, localizer):
    begun = maneuvers.inputs(state("turn"), None, None, 1.0)
    assert (begun.remaining, begun.problem) == (pytest.approx(2.8), "a chair")
    localizer.odom = Pose2(0.0, 0.0, 0.69)
    assert maneuvers.inputs(state("turn"), None, None, 2.0).remaining == pytest.approx(1.39 + 0.7)


def test_gate_is_told_what_stops_an_egress_and_nothing_without_a_maneuver(maneuvers):
    assert maneuvers.inputs(state(), None, ORIGIN, 1.0) == type(maneuvers.inputs(state(), None, ORIGIN, 1.0))()
    ask_and_reply(maneuvers.egress, WAY_OUT, ORIGIN, 1.0)
    running = maneuvers.inputs(state("egress"), None, Pose2(0.25, 0.0, 0.0), 1.0)
    assert (running.remaining, running.problem) == (pytest.approx(0.75), "a chair")


def test_gate_is_told_whether_a_robot_that_is_asked_to_drive_back_could(maneuvers):
    for asked, seen in (
        ("undock", "nothing at (-0.1, -0.1)"),
        ("back_off", "nothing at (-0.05, -0.05)"),
        ("turn", None),
    ):
        assert maneuvers.inputs(state(), None, None, 1.0, asked).blind_behind == seen
        assert maneuvers.inputs(state("turn"), None, None, 1.0, asked).blind_behind is None


def test_only_an_advance_has_a_way_ahead(maneuvers, localizer):
    none = maneuvers.inputs(state(), None, None, 0.5)
    assert maneuvers.way_ahead(None, none) == 0.0
    assert maneuvers.way_ahead("turn", none) == 0.0
    assert maneuvers.way_ahead("advance", none) == 0.4
    for driven, left in ((0.0, 0.4), (0.1, 0.3), (-0.1, 0.4), (0.45, 0.0)):
        localizer.odom = ORIGIN
        maneuvers.inputs(state(), None, None, 1.0)
        maneuvers.inputs(state("advance"), None, None, 1.0)
        localizer.odom = Pose2(driven, 0.0, 0.0)
        inputs = maneuvers.inputs(state("advance"), None, None, 2.0)
        assert maneuvers.way_ahead(None, inputs) == pytest.approx(left)


@pytest.mark.parametrize(
    ("kind", "wheels", "by_guardian"),
    [
        ("dock", (0.0, 0.0), "seek_dock"),
        ("undock", (-0.1, -0.1), "leave_dock"),
        ("back_off", (-0.05, -0.05), "back_off"),
        ("advance", (0.1, 0.1), None),
        ("turn", (-0.4 * HALF_AXLE_M, 0.4 * HALF_AXLE_M), None),
        ("egress", (0.1, 0.1), None),
    ],
)
def test_command_of_a_maneuver_has_its_speeds_and_the_guardians_name_of_it(maneuvers, kind, wheels, by_guardian):
    ask_and_reply(maneuvers.egress, WAY_OUT, ORIGIN, 1.0)
    maneuvers.inputs(state(kind), None, ORIGIN, 1.0)
    driving, mode = PathDriving(AGENT), "EGRESS" if kind != "dock" else "DOCK"
    command = None
    for tick in range(60):
        command = maneuvers.command(state(kind), outputs(mode), driving, 1.0 + 0.05 * tick)
    assert command is not None
    assert (command.left, command.right) == pytest.approx(wheels)
    assert command.maneuver == by_guardian
    assert maneuvers.command(state(kind), outputs("NORMAL"), driving, 9.0) is None
    assert maneuvers.command(state(), outputs(mode), driving, 9.0) is None


@pytest.mark.parametrize("request_", ["disable", "reset", "egress", "undock", "turn", "advance", "enable", "back_off"])
def test_wish_for_the_dock_ends_with_every_other_order(maneuvers, request_):
    given_up = []
    maneuvers.docking.give_up = lambda: given_up.append(request_)
    maneuvers.on_request(request_, state())
    assert bool(given_up) == (request_ not in {"enable", "back_off"})


def test_only_a_new_egress_forgets_the_way_out(maneuvers):
    ask_and_reply(maneuvers.egress, WAY_OUT, ORIGIN, 1.0)
    for request_, running, kept in (("turn", None, True), ("egress", "egress", True), ("egress", None, False)):
        maneuvers.on_request(request_, state(running))
        assert math.isfinite(maneuvers.egress.remaining) == kept


def test_base_is_watched_for_what_the_lidar_sees_at_the_speeds_that_its_wheels_turn(maneuvers, localizer):
    maneuvers.docking.problem = lambda _replica, _now, *, running: None if running else "not in front"
    localizer.speeds = (0.2, 0.5)
    assert maneuvers.inputs(state("dock"), None, None, 1.0).dock_problem == "a person"
    wheels, without = maneuvers._guard.asked
    assert wheels == pytest.approx((0.2 - HALF_AXLE_M * 0.5, 0.2 + HALF_AXLE_M * 0.5))
    assert without.keywords == {"pose": ORIGIN}
    localizer.place = None
    assert maneuvers.inputs(state("dock"), None, None, 1.0).dock_problem is None
    maneuvers.docking.problem = lambda _replica, _now, *, running: f"something, {running}"
    assert maneuvers.inputs(state("dock"), None, None, 1.0).dock_problem == "something, True"
    maneuvers.docking._ordered_at = 1.0
    assert maneuvers.inputs(state(), None, None, 1.0).dock_problem == "something, False"
    assert maneuvers.inputs(state("dock"), None, None, 1.0).remaining == math.inf


END = Pose2(1.0, 0.0, 0.0)


@pytest.fixture
def at_the_end_of_a_way_out():
    """Maneuvers of a robot that has just arrived at the end of its way out of a blocked area."""
    maneuvers = Maneuvers(AGENT, Localizer(), SimpleNamespace(reason=None))
    maneuvers.egress.begin()
    begun = Pose2(0.0, 0.0, 0.0)
    request = maneuvers.egress.request(
        begun, SafetyOutputs("EGRESS", (), 0.1, "none", changed=False, refusal=None), 0.0
    )
    maneuvers.egress.on_reply(request, PlanReply(points=[(0.0, 0.0), (1.0, 0.0)]), begun, 0.0)
    assert maneuvers.inputs(state("egress"), None, Pose2(0.5, 0.0, 0.0), 1.0).remaining == pytest.approx(0.5)
    assert maneuvers.inputs(state("egress"), None, END, 5.0).remaining == pytest.approx(0.0, abs=0.01)
    return maneuvers


def test_next_maneuver_does_not_begin_with_the_way_that_was_left_of_an_egress(at_the_end_of_a_way_out):
    assert at_the_end_of_a_way_out.inputs(state(), None, END, 5.1).remaining == math.inf


def test_way_straight_back_without_odometry_has_no_end(at_the_end_of_a_way_out):
    assert at_the_end_of_a_way_out.inputs(state("undock"), None, END, 5.1).remaining == math.inf


def test_way_back_from_a_bump_counts_from_where_the_robot_stands_however_fast_it_drove_a_moment_ago():
    localizer, period = Localizer(), 0.045
    for number in range(21):
        localizer.on_odometry(number * period, 0.3 * number * period, 0.0, 0.0)
    stood_at = 0.3 * 20 * period
    localizer.on_odometry(21 * period, stood_at, 0.0, 0.0)
    now = 22.9 * period  # at rest the base is heard half as often
    assert localizer.odom_at(now).x > stood_at + 0.015, "the twist is still that of the drive"
    maneuvers = Maneuvers(AGENT, localizer, SimpleNamespace(reason=None))
    maneuvers.inputs(state("back_off"), None, None, now)
    for number in range(23, 70):
        x = stood_at - 0.05 * period * max(0, number - 26)
        localizer.on_odometry(number * period, x, 0.0, 0.0)
        left = maneuvers.inputs(state("back_off"), None, None, number * period).remaining
        assert left == pytest.approx(0.09 - (stood_at - x), abs=1e-9)
