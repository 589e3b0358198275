"""What the safety gate is told of maneuvers: of the one that runs, and of no other."""

from __future__ import annotations

import math
from types import SimpleNamespace

import pytest
from little_world import AGENT

from fog_contracts.messages import PlanReply
from robot_agent.agent.maneuvers import Maneuvers
from robot_agent.localization.localizer import Localizer
from robot_agent.localization.pose import Pose2
from robot_agent.safety.gate import SafetyOutputs, SafetyState
from robot_agent.safety.maneuver import Maneuver

END = Pose2(1.0, 0.0, 0.0)


def state(kind=None) -> SafetyState:
    return SafetyState(maneuver=None if kind is None else Maneuver(0.0, math.inf, 0.0, kind))


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
