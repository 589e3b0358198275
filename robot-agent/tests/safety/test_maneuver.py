"""Leaving a blocked area: what the gate lets pass meanwhile, and everything that ends it."""

from __future__ import annotations

import math

import pytest
from msgspec.structs import replace

from fog_contracts.robot import BaseSettings, LidarSettings, MotionSettings, RobotSettings
from robot_agent.agent.maneuvers import ADVANCE_M, UNDOCK_M
from robot_agent.config import agent_config
from robot_agent.hardware import DriveTrain, LidarTraits
from robot_agent.safety.conditions import SafetyInputs
from robot_agent.safety.gate import SafetyState, step
from robot_agent.safety.maneuver import Maneuver

DT = 0.05
HEALTHY = {
    "map_loaded": True, "map_age": 0.1, "localization": "good", "lidar_age": 0.02, "scan_age": 0.1, "base_age": 0.02,
}  # fmt: skip
INSIDE = {"inside_blocked": "the no-go zone wet"}


class Gate:
    """A gate whose robot stands in a no-go zone; `remaining` shrinks by 0.10 m/s while it leaves."""

    def __init__(self) -> None:
        self.state = SafetyState()
        self.now = 100.0
        self.remaining = math.inf
        self.out = None

    def run(self, seconds: float = DT, *, speed: float = 0.0, request: str | None = None, **changes):
        given = {**HEALTHY, **INSIDE, **changes}
        for _ in range(max(1, round(seconds / DT))):
            self.now += DT
            self.remaining = max(0.0, self.remaining - speed * DT)
            values = {"maneuver_remaining": self.remaining, **given}
            self.state, self.out = step(self.state, SafetyInputs(**values, request=request), self.now)
            request = None
        return self.out

    def leaving(self) -> Gate:
        out = self.run(request="egress")
        assert (out.refusal, out.mode) == (None, "EGRESS")
        self.remaining = 2.0
        assert self.run(0.2, speed=0.1).mode == "EGRESS"
        return self


def test_egress_ignores_only_the_blocked_area_drives_slowly_and_ends_outside_in_init():
    gate = Gate()
    assert "no-go zone wet" in gate.run(request="enable").refusal
    out = gate.leaving().out
    assert (out.cap, out.stop, out.mission_may_drive) == (0.10, "none", False)
    assert out.reasons == ("leaving a blocked area on an operator's command",)
    gate.remaining = 0.5
    assert gate.run(4.4, speed=0.1).mode == "EGRESS"
    out = gate.run(0.2, speed=0.1, inside_blocked=None)
    assert (out.mode, out.stop, out.cap) == ("INIT", "immediate", 0.0)
    assert out.reasons == ("the egress ended: the robot is out", "waiting for an operator to enable")
    assert gate.run(request="enable", inside_blocked=None).refusal is None
    assert gate.state.maneuver_end == ""


def test_egress_that_ends_inside_says_so():
    gate = Gate().leaving()
    out = gate.run(maneuver_remaining=0.05)
    assert out.mode == "INIT"
    assert "the egress ended: the way out ends, and the robot is still in the no-go zone wet" in out.reasons


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"lidar_age": 0.31}, "the lidar has been silent"),
        ({"scan_age": 0.46}, "no complete scan"),
        ({"identical_scans": 3}, "the lidar repeats itself"),
        ({"empty_scans": 2}, "the lidar turns and sees nothing"),
        ({"localization": "lost"}, "the pose is lost"),
        ({"map_age": 3.01}, "the map is 3.0 s old"),
        ({"map_gap": 1.01}, "changes of the map"),
        ({"base_age": 0.31}, "no message from the guardian"),
        ({"base_stopped": "not awake"}, "the guardian holds the wheels"),
    ],
)
def test_condition_that_stops_a_robot_refuses_an_egress_and_ends_one_for_good(changes, words):
    assert words in Gate().run(request="egress", **changes).refusal
    gate = Gate().leaving()
    out = gate.run(speed=0.1, **changes)
    assert (out.mode, out.stop) == ("INIT", "immediate")
    assert any(reason.startswith("the egress ended: ") and words in reason for reason in out.reasons)
    assert gate.run(5.0, speed=0.1).mode == "INIT"


def test_missions_conditions_do_not_concern_an_egress():
    out = Gate().leaving().run(1.0, speed=0.1, mission=True, path_problem="the path is blocked", plan_age=9.0)
    assert out.mode == "EGRESS"


@pytest.mark.parametrize("fault", ["bumper", "cliff", "wheel_drop"])
def test_fault_during_an_egress_is_latched(fault):
    gate = Gate().leaving()
    assert gate.run(**{fault: True}).mode == "FAULT"
    assert gate.run(5.0).mode == "FAULT"
    assert gate.run(request="egress").refusal.code == "fault_latched"
    assert gate.run(request="reset").mode == "INIT"


def test_reset_of_a_base_fault_that_comes_in_the_same_step_ends_the_egress_in_init():
    gate = Gate().leaving()
    out = gate.run(request="reset", base_fault="the bumper is pressed (left)")
    assert (out.refusal, out.mode, out.stop) == (None, "INIT", "immediate")
    assert "the egress ended: base: the bumper is pressed (left)" in out.reasons
    assert gate.run(5.0).mode == "INIT"


RESTING = {"resting": "waking up: its lidar starts", "lidar_age": 700.0, "scan_age": 700.0}


def test_egress_of_a_resting_robot_waits_for_its_lidar_and_counts_from_then():
    gate = Gate()
    out = gate.run(request="egress", **RESTING)
    assert (out.refusal, out.mode, out.stop) == (None, "INIT", "immediate")
    assert out.reasons[-1] == "as soon as its lidar runs: leaving a blocked area on an operator's command"
    assert gate.run(70.0, **RESTING).stop == "immediate"
    assert gate.run().mode == "EGRESS"
    assert gate.run(9.8).mode == "EGRESS"
    assert gate.run(0.4).mode == "INIT"


def test_lidar_that_does_not_start_ends_an_egress_that_waits_for_it():
    gate = Gate()
    gate.run(request="egress", **RESTING)
    assert "the lidar has been silent" in "; ".join(gate.run(lidar_age=700.0, scan_age=700.0).reasons)
    assert gate.run(5.0).mode == "INIT"


def test_egress_is_refused_outside_and_an_enable_during_one():
    assert Gate().run(request="egress", inside_blocked=None).refusal.code == "not_blocked_in"
    gate = Gate().leaving()
    assert gate.run(speed=0.1, request="enable").refusal.code == "maneuver_runs"
    assert gate.run(speed=0.1, request="egress").refusal.code == "maneuver_runs"
    assert gate.out.mode == "EGRESS"


def test_disable_ends_an_egress_at_once():
    out = Gate().leaving().run(request="disable")
    assert (out.mode, out.stop) == ("INIT", "immediate")


def test_distance_to_the_edge_must_shrink():
    gate = Gate().leaving()
    assert gate.run(9.0).mode == "EGRESS"
    out = gate.run(1.5, maneuver_problem="an obstacle ahead")
    assert out.mode == "INIT"
    assert "no nearer to its end for 10 s: an obstacle ahead" in "; ".join(out.reasons)
    gate = Gate().leaving()
    gate.remaining += 0.09
    assert gate.run().mode == "EGRESS"
    gate.remaining += 0.04
    assert "moved away from the end of the egress" in "; ".join(gate.run().reasons)


def test_egress_without_a_way_out_ends_after_ten_seconds():
    gate = Gate()
    gate.run(request="egress")
    assert gate.run(9.8).mode == "EGRESS"
    assert "no nearer" in "; ".join(gate.run(0.3, maneuver_problem="the planner does not answer").reasons)


def test_egress_ends_after_sixty_seconds():
    gate = Gate().leaving()
    gate.remaining = 1e3
    gate.state = replace(gate.state, maneuver=Maneuver(gate.now, 1e3, gate.now))
    assert gate.run(59.9, speed=0.1).mode == "EGRESS"
    assert "longer than 60 s" in "; ".join(gate.run(0.2, speed=0.1).reasons)


@pytest.mark.parametrize("remaining", [math.nan, -math.inf])
def test_impossible_distance_ends_an_egress(remaining):
    assert Gate().leaving().run(maneuver_remaining=remaining).mode == "INIT"


@pytest.mark.parametrize("degraded_m_s", [0.15, 0.05, 0.02])
@pytest.mark.parametrize(("kind", "way"), [("undock", UNDOCK_M), ("advance", ADVANCE_M)])
def test_robot_that_may_only_creep_comes_to_the_end_of_a_straight_way(kind, way, degraded_m_s):
    parts = {"base": BaseSettings(driver="b"), "lidar": LidarSettings(driver="l")}
    settings = RobotSettings(**parts, motion=MotionSettings(degraded_speed_m_s=degraded_m_s))
    base, lidar = (
        DriveTrain(axle_m=0.2, wheel_speed_max_m_s=0.5),
        LidarTraits(range_min_m=0.1, range_max_m=8.0, scan_period_s=0.2),
    )
    config = agent_config("r1", b"", base, lidar, boot="b", settings=settings).safety
    where = {"docked_for": 9.0} if kind == "undock" else {"localization": "weak"}
    state, out = step(SafetyState(), SafetyInputs(**HEALTHY | where, request=kind), 100.0, config)
    assert out.refusal is None
    # Half a second to get going, and the stop field slows it down by a fifth.
    now, left = 100.5, way
    while state.maneuver is not None:
        now, left = now + DT, left - 0.8 * out.cap * DT
        state, out = step(state, SafetyInputs(**HEALTHY | where, maneuver_remaining=left), now, config)
    assert left <= 0.0, state.maneuver_end
    assert "longer than" not in state.maneuver_end
