"""Docking, undocking and backing off in the gate: who may begin them, what ends them, and what follows."""

from __future__ import annotations

import math

import pytest

from robot_agent.safety.conditions import SafetyInputs
from robot_agent.safety.gate import SafetyState, step
from robot_agent.safety.maneuver import RULES

DT = 0.05
CHARGES = "the base is on its charger, where it does not drive"
HEALTHY = {
    "map_loaded": True, "map_age": 0.1, "localization": "good", "lidar_age": 0.02, "scan_age": 0.1, "base_age": 0.02,
}  # fmt: skip
ON_DOCK = {"docked_for": 9.0, "base_stopped": CHARGES}
MISSION = {"mission": True, "plan_age": 0.1, "released_remaining": 5.0}
BUMPED = {"bumped": True, "base_fault": "the bumper is pressed (left)", "bumper": True}
STOPS = [
    ({"lidar_age": 0.31}, "the lidar has been silent"),
    ({"scan_age": 0.46}, "no complete scan"),
    ({"identical_scans": 3}, "the lidar repeats itself"),
    ({"empty_scans": 2}, "the lidar turns and sees nothing"),
    ({"localization": "lost"}, "the pose is lost"),
    ({"inside_blocked": "the zone x"}, "the robot is in the zone x"),
    ({"map_age": 3.01}, "the map is 3.0 s old"),
    ({"map_gap": 1.01}, "changes of the map"),
    ({"base_age": 0.31}, "no message from the guardian"),
    ({"guardian_lost": "closed"}, "the guardian is not connected"),
]
FAULTS = [{"cliff": True}, {"wheel_drop": True}, {"base_fault": "the base left its driving mode: Full"}]


class Gate:
    """A gate, enabled and healthy unless told otherwise."""

    def __init__(self, *, enabled: bool = True, **given) -> None:
        self.state, self.now, self.out, self.given = SafetyState(), 100.0, None, given
        if enabled:
            assert self.run(request="enable").refusal is None
        self.run(2.2)

    def run(self, seconds: float = DT, *, request: str | None = None, **changes):
        for _ in range(max(1, round(seconds / DT))):
            self.now += DT
            inputs = SafetyInputs(**{**HEALTHY, **self.given, **changes}, request=request)
            self.state, self.out = step(self.state, inputs, self.now)
            request = None
        return self.out


def docking() -> Gate:
    gate = Gate()
    out = gate.run(request="dock")
    assert (out.refusal, out.mode, out.cap, out.stop, out.mission_may_drive) == (None, "DOCK", 0.0, "none", False)
    return gate


def undocking(*, enabled: bool = True) -> Gate:
    gate = Gate(enabled=enabled, **ON_DOCK)
    out = gate.run(request="undock", maneuver_remaining=0.3)
    assert (out.refusal, out.mode, out.cap, out.stop) == (None, "DOCK", 0.10, "none")
    return gate


def backing_off() -> Gate:
    gate = Gate()
    assert gate.run(**BUMPED).mode == "FAULT"
    out = gate.run(request="back_off", maneuver_remaining=0.09, **BUMPED)
    assert (out.refusal, out.mode, out.cap, out.stop) == (None, "EGRESS", 0.05, "none")
    return gate


# --- docking ---


def test_docked_robot_stays_enabled_and_holds_on_its_dock_for_hours():
    gate = docking()
    assert gate.run(20.0, bumper=False).reasons == ("the base drives into its dock by itself",)
    assert gate.run(docked_for=0.0, bumper=True).mode == "DOCK"
    assert gate.run(docked_for=0.9).mode == "DOCK"
    out = gate.run(docked_for=1.0)
    assert (out.mode, gate.state.enabled, gate.state.maneuver) == ("HOLD", True, None)
    out = gate.run(300.0, **ON_DOCK)
    assert out.reasons == ("the robot is on its dock: a goal or `fognav robot undock` takes it off",)
    assert gate.state.latched == ()


def stopped_until_somebody_enables() -> Gate:
    gate = Gate()
    gate.run(1.0, localization="lost")
    out = gate.run(5.0)
    assert (out.mode, gate.state.enabled) == ("PROTECTIVE_STOP", True)
    assert gate.state.latched
    return gate


def test_robot_that_waits_for_an_operator_does_not_go_to_its_dock_by_itself():
    gate = stopped_until_somebody_enables()
    out = gate.run(request="dock")
    assert (out.refusal.code, out.mode) == ("not_enabled", "PROTECTIVE_STOP")
    assert gate.state.latched


def test_robot_that_waits_for_an_operator_waits_for_one_after_leaving_its_dock_too():
    gate = stopped_until_somebody_enables()
    out = gate.run(request="undock", maneuver_remaining=0.3, **ON_DOCK)
    assert (out.refusal, out.mode) == (None, "DOCK")
    out = gate.run(maneuver_remaining=0.0)
    assert (gate.state.enabled, gate.state.maneuver) == (False, None)
    assert gate.run(5.0).mode == "INIT"


@pytest.mark.parametrize(("changes", "words"), [*STOPS, ({"dock_problem": "a chair"}, "a chair"),
                                                ({"base_stopped": "60 s"}, "holds the wheels: 60 s")])  # fmt: skip
def test_condition_that_stops_a_robot_refuses_a_docking_and_ends_one_as_it_stops_any_drive(changes, words):
    assert words in Gate().run(request="dock", **changes).refusal
    gate, drive = docking(), Gate()
    out = gate.run(**changes)
    assert (out.mode, out.stop, gate.state.enabled, gate.state.maneuver) == ("HOLD", "ramp", True, None)
    assert gate.state.maneuver_end.startswith("the docking ended: ")
    assert words in gate.state.maneuver_end
    drive.run(**changes)
    assert gate.run(**changes).mode == drive.run(**changes).mode
    assert gate.run(5.0).mode == drive.run(5.0).mode
    assert gate.state.latched == drive.state.latched


@pytest.mark.parametrize("fault", [*FAULTS, {"bumper": True}])
def test_fault_during_a_docking_is_latched(fault):
    gate = docking()
    assert gate.run(**fault).mode == "FAULT"
    assert gate.run(5.0).mode == "FAULT"
    assert gate.run(request="dock").refusal.code == "fault_latched"


def test_docking_ends_after_sixty_seconds():
    gate = docking()
    assert gate.run(59.9).mode == "DOCK"
    gate.run(0.2)
    assert gate.state.maneuver_end == "the docking ended: it took longer than 60 s"
    assert gate.run(2.2).mode == "NORMAL"
    assert gate.run(request="dock").mode == "DOCK"
    gate.run(docked_for=1.0)
    assert gate.state.maneuver_end == ""


def test_docking_is_refused_to_a_robot_that_is_not_enabled_or_on_its_dock():
    assert Gate(enabled=False).run(request="dock").refusal.code == "not_enabled"
    assert Gate(**ON_DOCK).run(request="dock").refusal.code == "on_dock"


@pytest.mark.parametrize("make", [docking, undocking])
def test_disable_ends_a_docking_or_undocking_at_once(make):
    out = make().run(request="disable")
    assert (out.mode, out.stop) == ("INIT", "immediate")


@pytest.mark.parametrize(("make", "given"), [(docking, {}), (undocking, ON_DOCK), (backing_off, BUMPED)])
def test_enable_and_other_maneuvers_are_refused_during_one(make, given):
    gate = make()
    mode = gate.state.mode
    for request in ("enable", *RULES):
        assert gate.run(request=request, maneuver_remaining=0.05, **given).refusal is not None
        assert gate.out.mode == mode


def test_robot_may_be_enabled_on_its_dock():
    gate = Gate(enabled=False, **ON_DOCK)
    assert gate.run(request="enable").refusal is None
    assert gate.run(3.0).mode == "HOLD"


# --- undocking ---


@pytest.mark.parametrize("enabled", [True, False])
def test_robot_leaves_its_dock_and_is_enabled_afterwards_only_if_it_was_before(enabled):
    gate = undocking(enabled=enabled)
    gate.given = {}
    assert gate.run(1.0, maneuver_remaining=0.2, base_stopped="not ready").mode == "DOCK"
    assert gate.run(maneuver_remaining=0.0).mode == ("HOLD" if enabled else "INIT")
    assert gate.run(2.2).mode == ("NORMAL" if enabled else "INIT")
    assert gate.run(request="undock").refusal.code == "not_on_dock"


def test_mission_takes_a_robot_off_its_dock_only_after_it_has_been_there_for_a_second():
    gate = Gate()
    assert gate.run(docked_for=0.0, **MISSION).mode == "HOLD", "one frame may be wrong"
    assert gate.run(docked_for=0.9, **MISSION).mode == "HOLD"
    assert gate.run(docked_for=1.0, **MISSION).mode == "DOCK"
    gate = Gate()
    gate.run(docked_for=0.0, **MISSION)
    assert gate.run(2.2, **MISSION).mode == "NORMAL"


@pytest.mark.parametrize(("changes", "words"), STOPS)
def test_condition_that_stops_a_robot_refuses_an_undocking_and_ends_one_as_it_stops_any_drive(changes, words):
    assert words in Gate(**ON_DOCK).run(request="undock", **changes).refusal
    gate, drive = undocking(), Gate(**ON_DOCK)
    assert gate.run(maneuver_remaining=0.2, **changes).stop == "ramp"
    assert words in gate.state.maneuver_end
    assert (gate.run(**changes).mode, gate.state.latched) == (drive.run(**changes).mode, drive.state.latched)
    leaves = "HOLD" if gate.state.latched == () else "PROTECTIVE_STOP"
    assert gate.run(2.2).mode == leaves
    assert gate.out.reasons[-1] == gate.state.maneuver_end
    assert gate.run(**MISSION).mode == ("DOCK" if leaves == "HOLD" else leaves), "a mission begins it anew"


def test_third_protective_stop_within_a_minute_of_a_robot_on_its_dock_is_a_fault_as_on_any_drive():
    gate = Gate(**ON_DOCK)
    for _ in range(3):
        assert gate.run(2.2, **MISSION).mode == "DOCK"
        gate.run(2 * DT, **MISSION, lidar_age=0.31)
    assert gate.out.mode == "FAULT", "a loose plug would let it start and stop all day"


@pytest.mark.parametrize("fault", [*FAULTS, {"bumper": True, "docked_for": None}])
def test_fault_during_an_undocking_is_latched(fault):
    gate = undocking()
    assert gate.run(bumper=True, maneuver_remaining=0.3).mode == "DOCK"
    assert gate.run(**{"maneuver_remaining": 0.3, **fault}).mode == "FAULT"


def test_undocking_without_progress_ends_after_ten_seconds():
    gate = undocking()
    assert gate.run(9.8, maneuver_remaining=0.3).mode == "DOCK"
    out = gate.run(0.4, maneuver_remaining=0.3, maneuver_problem="an obstacle behind")
    assert "no nearer to its end for 10 s: an obstacle behind" in "; ".join(out.reasons)
    assert not gate.state.enabled, "it would try for ever"


def test_undocking_ends_after_fifteen_seconds():
    gate = undocking()
    for tenth in range(149):
        assert gate.run(0.1, maneuver_remaining=0.3 - 0.0015 * tenth).mode == "DOCK"
    gate.run(0.3, maneuver_remaining=0.01)
    assert "longer than 15 s" in "; ".join(gate.out.reasons)


# --- a mission takes an enabled robot off its dock ---


def test_mission_with_released_path_takes_an_enabled_robot_off_its_dock():
    gate = Gate(**ON_DOCK)
    out = gate.run(**MISSION)
    assert (out.mode, out.reasons[-1]) == ("DOCK", "leaving the dock, straight back")
    gate.given = {}
    gate.run(**MISSION, maneuver_remaining=0.0)
    assert gate.run(2.2, **MISSION).mode == "NORMAL"


@pytest.mark.parametrize(
    "changes",
    [
        {"mission": False},
        {"released_remaining": 0.15},
        {"released_remaining": math.nan},
        {"path_problem": "blocked"},
        {"plan_age": math.inf, "released_remaining": 0.0},
        {"resting": "waking up"},
        {"blind_behind": "the lidar sees nothing behind"},
        *(changes for changes, _ in STOPS),
        {"base_stopped": "not ready"},
    ],
)
def test_nothing_moves_a_robot_off_its_dock_without_a_released_path_and_all_well(changes):
    gate = Gate(**ON_DOCK)
    assert gate.run(0.5, **{**MISSION, **changes}).mode != "DOCK"
    assert gate.out.stop != "none"


def test_robot_that_is_disabled_or_waits_for_an_operator_stays_on_its_dock():
    assert Gate(enabled=False, **ON_DOCK).run(5.0, **MISSION).mode == "INIT"
    gate = Gate(**ON_DOCK)
    gate.run(localization="lost")
    assert gate.run(5.0, **MISSION).mode == "PROTECTIVE_STOP"


def test_robot_stays_on_its_dock_until_two_seconds_after_a_protective_stop():
    gate = Gate(**ON_DOCK)
    gate.run(lidar_age=1.0)
    assert gate.run(1.9, **MISSION).mode == "PROTECTIVE_STOP"
    assert gate.run(0.2, **MISSION).mode == "DOCK"


# --- backing off ---


def test_robot_that_backed_off_has_its_fault_still():
    gate = backing_off()
    assert gate.run(1.0, maneuver_remaining=0.05, **BUMPED).mode == "EGRESS"
    out = gate.run(maneuver_remaining=0.0, bumped=True, base_fault="the bumper is pressed (left)")
    assert (out.mode, out.stop) == ("FAULT", "immediate")
    assert "the bumper is pressed" in out.reasons[0]
    assert gate.run(request="reset").refusal is None
    assert gate.run().mode == "INIT"


@pytest.mark.parametrize("changes", [
    {"localization": "lost"}, {"inside_blocked": "x"}, {"map_loaded": False}, {"map_age": 9.0}, {"map_gap": 9.0},
    {"base_stopped": "x"}, MISSION, {"mission": True, "path_problem": "x"},
])  # fmt: skip
def test_place_map_and_plan_do_not_keep_a_robot_from_backing_off(changes):
    gate = backing_off()
    assert gate.run(1.0, maneuver_remaining=0.09, **{**BUMPED, **changes}).mode == "EGRESS"


@pytest.mark.parametrize(("changes", "words"), [
    *(stop for stop in STOPS if not {"localization", "inside_blocked", "map_age", "map_gap"} & stop[0].keys()),
    ({"cliff": True}, "cliff"), ({"wheel_drop": True}, "wheel"),
])  # fmt: skip
def test_base_and_lidar_refuse_a_back_off_and_end_one_in_fault(changes, words):
    gate = Gate()
    gate.run(**BUMPED)
    assert words in gate.run(request="back_off", **{**BUMPED, **changes}).refusal
    gate = backing_off()
    out = gate.run(maneuver_remaining=0.09, **{**BUMPED, **changes})
    assert (out.mode, out.stop) == ("FAULT", "immediate")


def test_other_fault_during_a_back_off_is_latched():
    gate = backing_off()
    gate.run(maneuver_remaining=0.09, cliff=True, base_fault="a cliff sensor sees no floor")
    assert gate.out.mode == "FAULT"
    assert any("cliff" in finding.reason for finding in gate.state.latched)


def test_disabled_back_off_leaves_the_fault():
    out = backing_off().run(request="disable", **BUMPED)
    assert (out.mode, out.stop) == ("FAULT", "immediate")


def test_back_off_ends_after_five_seconds():
    gate = backing_off()
    assert gate.run(4.9, maneuver_remaining=0.09, **BUMPED).mode == "EGRESS"
    assert gate.run(0.2, maneuver_remaining=0.09, **BUMPED).mode == "FAULT"


@pytest.mark.parametrize(("problem", "told"), [(None, "backing off was ended"), ("a chair", "a chair")])
def test_back_off_that_takes_too_long_tells_what_stops_it_or_why_the_guardian_ended_it(problem, told):
    gate = backing_off()
    gate.run(5.1, maneuver_remaining=0.09, maneuver_problem=problem, base_stopped="backing off was ended", **BUMPED)
    assert gate.run(request="reset", base_fault="the bumper is pressed (left)").mode == "INIT"
    assert f"the back-off ended: it took longer than 5 s: {told}" in gate.out.reasons


def test_undocking_that_the_guardian_has_ended_tells_why_when_it_ends():
    gate = undocking()
    out = gate.run(10.1, maneuver_remaining=0.3, base_stopped="leaving the dock was ended")
    assert "no nearer to its end for 10 s: leaving the dock was ended" in "; ".join(out.reasons)


@pytest.mark.parametrize("kind", ["turn", "advance"])
@pytest.mark.parametrize("changes", STOPS[:4] + STOPS[8:] + [(fault, "") for fault in FAULTS])
def test_base_and_lidar_refuse_looking_around_and_end_it(kind, changes):
    values, words = changes
    gate = Gate(enabled=False, localization="lost")
    assert words in gate.run(request=kind, maneuver_remaining=1.0, **values).refusal
    gate = Gate(enabled=False, localization="lost")
    assert gate.run(request=kind, maneuver_remaining=1.0).refusal is None
    out = gate.run(maneuver_remaining=0.9, **values)
    assert out.stop == "immediate"
    assert gate.state.maneuver is None


@pytest.mark.parametrize("kind", ["turn", "advance"])
def test_looking_around_without_a_pose_needs_no_map_and_ends_once_the_place_is_known(kind):
    unknown = {"localization": "none", "map_loaded": False, "map_age": math.inf, "inside_blocked": "the zone x"}
    gate = Gate(enabled=False, **unknown)
    out = gate.run(request=kind, maneuver_remaining=1.0)
    assert (out.refusal, out.mode, out.cap, out.mission_may_drive) == (None, "EGRESS", 0.10, False)
    assert gate.run(1.0, maneuver_remaining=0.5).mode == "EGRESS"
    assert gate.run(maneuver_remaining=0.4, localization="weak", inside_blocked=None).mode == "EGRESS"
    out = gate.run(maneuver_remaining=0.3, localization="good")
    assert (out.mode, gate.state.enabled, out.stop) == ("INIT", False, "immediate")
    assert any("the robot knows where it is" in reason for reason in out.reasons)


@pytest.mark.parametrize("kind", ["turn", "advance"])
@pytest.mark.parametrize(("changes", "words"), [
    ({"inside_blocked": "the zone x"}, "the robot is in the zone x"),
    ({"blocked_ahead": "the zone x"}, "the zone x is on the way ahead"),
])  # fmt: skip
def test_zone_refuses_and_ends_looking_around_by_an_uncertain_pose(kind, changes, words):
    gate = Gate(enabled=False, localization="weak")
    assert words in gate.run(request=kind, maneuver_remaining=1.0, **changes).refusal
    assert gate.run(request=kind, maneuver_remaining=1.0).refusal is None
    out = gate.run(maneuver_remaining=0.9, **changes)
    assert (out.mode, out.stop, gate.state.maneuver) == ("INIT", "immediate", None)
    assert any(words in reason for reason in out.reasons)


@pytest.mark.parametrize("kind", ["turn", "advance"])
@pytest.mark.parametrize("localization", ["weak", "lost", "none"])
def test_robot_on_its_dock_does_not_look_around(kind, localization):
    out = Gate(enabled=False, localization=localization, **ON_DOCK).run(request=kind, maneuver_remaining=1.0)
    assert out.refusal.code == "on_dock"


@pytest.mark.parametrize(("kind", "longest"), [("turn", 30.0), ("advance", 15.0)])
def test_looking_around_ends_after_its_way_after_its_time_and_when_nothing_moves(kind, longest):
    gate = Gate(enabled=False, localization="lost", localization_detail="2 places look alike")
    gate.run(request=kind, maneuver_remaining=1.0)
    reasons = gate.run(maneuver_remaining=0.0).reasons
    assert any("it is done, and the pose is unknown: 2 places look alike" in reason for reason in reasons)
    gate.run(request=kind, maneuver_remaining=1.0)
    reasons = gate.run(10.1, maneuver_remaining=1.0, maneuver_problem="an obstacle is near").reasons
    assert any("came no nearer to its end for 10 s: an obstacle is near" in reason for reason in reasons)
    gate.run(request=kind, maneuver_remaining=100.0)
    for second in range(int(longest) + 1):
        gate.run(1.0, maneuver_remaining=99.0 - second)
    assert any(f"longer than {longest:.0f} s" in reason for reason in gate.out.reasons)


@pytest.mark.parametrize(("localization", "word"), [("weak", "uncertain"), ("lost", "unknown"), ("none", "unknown")])
def test_looking_around_that_found_nothing_out_says_how_well_the_place_is_known(localization, word):
    gate = Gate(enabled=False, localization=localization)
    gate.run(request="turn", maneuver_remaining=1.0)
    assert gate.run(maneuver_remaining=0.0).reasons[0] == f"the turn ended: it is done, and the pose is {word}"


@pytest.mark.parametrize("kind", ["turn", "advance"])
def test_robot_that_was_enabled_waits_for_an_operator_after_it_looked_around(kind):
    gate = Gate(localization="weak")
    assert gate.run(request=kind, maneuver_remaining=1.0).mode == "EGRESS"
    gate.run(maneuver_remaining=0.5, localization="good")
    assert (gate.out.mode, gate.state.enabled) == ("INIT", False)


@pytest.mark.parametrize(
    ("kind", "given"),
    [("dock", {}), ("undock", ON_DOCK), ("turn", {"localization": "lost"}), ("advance", {"localization": "lost"})],
)
def test_blocked_path_of_a_mission_does_not_keep_a_robot_from_a_maneuver(kind, given):
    gate = Gate(enabled=kind == "dock", **given)
    blocked = {**MISSION, "path_problem": "the path is blocked", "maneuver_remaining": 1.0}
    assert gate.run(request=kind, **blocked).refusal is None
    assert gate.run(0.5, **blocked).mode == RULES[kind].mode
    if kind == "dock":
        assert gate.run(0.5, **blocked, docked_for=0.1).mode == "DOCK"


@pytest.mark.parametrize("kind", ["turn", "advance"])
def test_looking_around_that_goes_the_wrong_way_ends_and_says_so_by_its_name(kind):
    gate = Gate(enabled=False, localization="lost")
    gate.run(request=kind, maneuver_remaining=1.0)
    gate.run(maneuver_remaining=0.5)
    reasons = gate.run(maneuver_remaining=0.65).reasons
    assert any(f"the robot moved away from the end of the {kind}" in reason for reason in reasons)


def test_latched_fault_and_known_place_refuse_looking_around():
    assert Gate().run(request="turn", maneuver_remaining=1.0).refusal.code == "pose_known"
    gate = Gate()
    gate.run(cliff=True)
    refusal = gate.run(request="advance", maneuver_remaining=1.0, localization="lost").refusal
    assert (refusal.code, refusal.causes) == ("fault_latched", ("cliff",))


def test_back_off_needs_a_bump():
    assert Gate().run(request="back_off").refusal.code == "not_bumped"
    gate = Gate()
    gate.run(cliff=True)
    assert gate.run(request="back_off", base_fault="a cliff").refusal.code == "not_bumped"


@pytest.mark.parametrize(("request_", "given"), [("back_off", BUMPED), ("undock", ON_DOCK)])
def test_robot_that_sees_nothing_behind_refuses_to_drive_back(request_, given):
    gate = Gate(enabled=False, **given)
    blind = "the lidar sees nothing behind"
    assert gate.run(request=request_, blind_behind=blind).refusal == blind
    assert gate.out.mode != RULES[request_].mode
    assert gate.run(request=request_).refusal is None
    assert gate.run(blind_behind=blind, maneuver_remaining=0.05).mode == RULES[request_].mode, "it has begun"


def test_back_off_of_an_agent_that_was_restarted_leads_to_init():
    gate = Gate(enabled=False)
    assert gate.run(request="back_off", maneuver_remaining=0.09, **BUMPED).mode == "EGRESS"
    assert gate.run(maneuver_remaining=0.0, bumped=True, base_fault="the bumper is pressed").mode == "INIT"
    assert gate.run(request="enable", base_fault="the bumper is pressed").refusal.code == "cause_remains"
