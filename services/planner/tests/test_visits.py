"""Visits: whatever visitors, operators and robots do, an operator's word wins and no robot drives for nobody."""

from __future__ import annotations

import contextlib
import os
from typing import Any

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from fog_contracts.messages import Mode, Place, ReasonCode, RobotState
from planner.problems import PlannerProblem
from planner.visits import (
    ASKED_MAX,
    DRIVE_S,
    KEPT_S,
    PER_SOURCE,
    READY_S,
    TROUBLE_S,
    UNSEEN_S,
    WAITING_MAX,
    Act,
    Facts,
    Visit,
    VisitEnd,
    VisitError,
    Visits,
    is_free,
    why_out,
)

PLACES = {name: Place(x=float(x), y=0.0, public=name != "office") for x, name in enumerate(("hall", "lab", "office"))}
PUBLIC = {name: place for name, place in PLACES.items() if place.public}
TOUR = ("hall", "lab")
ROBOTS = ("r1", "r2")


def state(mode: Mode = "NORMAL", **fields: Any) -> RobotState:
    filled = {"reasons": [], "enabled": True, "battery": 1.0, "goal_id": None, "map_epoch": 1, "map_seq": 1, **fields}
    return RobotState(mode=mode, plan_id=None, **filled)


def free(mission: str | None = None, **fields: Any) -> Facts:
    return Facts(mission, mission is not None, free=True, **fields)


def coming(visits: Visits, owner: str = "anna", robot: str = "r1", now: float = 0.0) -> Visit:
    """Let a robot come to a visitor, as mission m1."""
    visit = visits.ask(owner, "", TOUR, PUBLIC, now)
    (act,) = visits.step(now, {robot: free()}, PUBLIC)
    assert act == Act(robot, visit, "hall")
    visits.done(act, "m1", now)
    return visit


def ready(visits: Visits) -> Visit:
    visit = coming(visits)
    visits.on_state("r1", state(goal_id="m1", goal_reached=True), 5.0)
    assert visit.state == "ready"
    return visit


def test_visitor_waits_is_led_and_arrives() -> None:
    visits = Visits(["r1"])
    visit = visits.ask("anna", "", TOUR, PUBLIC, 0.0)
    assert visits.step(0.0, {"r1": free("of an operator")._replace(of_visit=False)}, PUBLIC) == []
    (act,) = visits.step(1.0, {"r1": free()}, PUBLIC)
    visits.done(act, "m1", 1.0)
    visits.on_state("r1", state(goal_id="m1", goal_reached=True), 9.0)
    visits.go("anna", 10.0)
    assert visits.step(10.0, {"r1": free("m1")}, PUBLIC) == []  # the planner has not ended the first mission yet
    (act,) = visits.step(10.5, {"r1": free()}, PUBLIC)
    assert act == Act("r1", visit, "lab")
    visits.done(act, "m2", 10.5)
    visits.on_state("r1", state(goal_id="m1", goal_reached=True), 10.6)  # an old state
    assert visit.state == "leading"
    visits.on_state("r1", state(goal_id="m2", goal_reached=True), 20.0)
    assert (visits.of("anna", 21.0) is visit, visit.state, visit.end) == (True, "arrived", None)
    assert visits.step(21.0, {"r1": free("m2")}, PUBLIC) == []
    visits.step(20.0 + KEPT_S, {"r1": free()}, PUBLIC)
    assert visits.of("anna", 200.0) is None


def test_nearest_free_robot_comes_and_the_next_visitor_waits() -> None:
    visits = Visits(ROBOTS)
    _, bert, carl = (visits.ask(owner, "", TOUR, PUBLIC, 0.0) for owner in ("anna", "bert", "carl"))
    acts = visits.step(0.0, {"r1": free(x=50.0), "r2": free(x=3.0), "r3": free()}, PUBLIC)
    assert [(act.robot, act.visit and act.visit.owner) for act in acts] == [("r2", "anna"), ("r1", "bert")]
    assert (bert.state, carl.state, visits.ahead(carl)) == ("coming", "waiting", 0)


@pytest.mark.parametrize(
    ("told", "end"),
    [
        (state("INIT", enabled=False), VisitEnd.OPERATOR),
        (state("TELEOP"), VisitEnd.OPERATOR),
        (state("FAULT", awaits_operator=True), VisitEnd.ROBOT),
        (state(wants_dock=True), VisitEnd.ROBOT),
    ],
)
def test_visit_ends_with_what_its_robot_says_and_its_mission_with_it(told: RobotState, end: VisitEnd) -> None:
    visits = Visits(["r1"])
    visit = coming(visits)
    visits.on_state("r1", told, 1.0)
    assert (visit.state, visit.end) == ("ended", end)
    assert visits.step(1.0, {"r1": free("m1")}, PUBLIC) == [Act("r1", mission="m1")]


def test_mission_that_is_cancelled_at_the_robot_or_at_the_planner_ends_the_visit() -> None:
    for cancel_at_robot in (True, False):
        visits = Visits(["r1"])
        visit = coming(visits)
        visits.on_state("r1", state(), 1.0)  # it has not heard of it yet
        visits.on_state("r1", state(goal_id="m1"), 1.5)
        assert visit.state == "coming"
        if cancel_at_robot:
            visits.on_state("r1", state(), 2.0)
        else:
            visits.step(2.0, {"r1": free()}, PUBLIC)
        assert visit.end == VisitEnd.OPERATOR


def test_operator_who_sends_the_waiting_robot_elsewhere_keeps_it() -> None:
    visits = Visits(["r1"])
    visit = ready(visits)
    elsewhere = Facts("of an operator", free=True)
    assert visits.step(6.0, {"r1": elsewhere}, PUBLIC) == []
    assert visit.end == VisitEnd.OPERATOR
    with pytest.raises(VisitError):
        visits.go("anna", 6.5)


def test_robot_that_an_operator_takes_first_leaves_the_visitor_waiting() -> None:
    visits = Visits(["r1"])
    visit = visits.ask("anna", "", TOUR, PUBLIC, 0.0)
    (act,) = visits.step(0.0, {"r1": free()}, PUBLIC)
    visits.done(act, VisitEnd.OPERATOR, 0.1)
    assert (visit.state, visit.robot) == ("waiting", None)


def test_visitor_who_does_not_come_or_look_or_whose_way_stays_closed_frees_the_robot() -> None:
    visits = Visits(["r1"])
    visit = ready(visits)
    visits.step(5.1 + READY_S, {"r1": free()}, PUBLIC)
    assert visit.end == VisitEnd.EXPIRED
    unseen = visits.ask("bert", "", TOUR, PUBLIC, 100.0)
    visits.step(101.0 + UNSEEN_S, {}, PUBLIC)
    assert unseen.end == VisitEnd.EXPIRED
    for facts, end in ((free("m1", refused=True), VisitEnd.NO_WAY), (free("m1", heard=False), VisitEnd.ROBOT)):
        visits = Visits(["r1"])
        visit = coming(visits)
        visits.step(1.0, {"r1": facts}, PUBLIC)
        visits.step(2.0, {"r1": free("m1")}, PUBLIC)
        visits.step(3.0, {"r1": facts}, PUBLIC)
        visits.step(2.0 + TROUBLE_S, {"r1": facts}, PUBLIC)
        assert visit.state == "coming"
        visits.step(3.1 + TROUBLE_S, {"r1": facts}, PUBLIC)
        assert visit.end == end


def test_refusals_of_a_visit() -> None:
    def refusal(visits: Visits, owner: str, source: str, ends: tuple[str, str], now: float = 0.0) -> PlannerProblem:
        with pytest.raises(VisitError) as refused:
            visits.ask(owner, source, ends, PUBLIC, now)
        return refused.value.code

    assert refusal(Visits([]), "anna", "", TOUR) == PlannerProblem.VISITS_OFF
    visits = Visits(["r1"])
    assert refusal(visits, "anna", "", ("hall", "office")) == PlannerProblem.PLACE_NOT_PUBLIC
    assert refusal(visits, "anna", "", ("nowhere", "lab")) == PlannerProblem.PLACE_NOT_PUBLIC
    assert refusal(visits, "anna", "", ("lab", "lab")) == PlannerProblem.VISIT_SAME_PLACE
    first = visits.ask("anna", "", TOUR, PUBLIC, 0.0)
    assert visits.ask("anna", "", TOUR, PUBLIC, 0.0) is first
    assert refusal(visits, "anna", "", ("lab", "hall")) == PlannerProblem.VISIT_OTHER
    for number in range(1, WAITING_MAX):
        visits.ask(f"o{number}", f"source {number // PER_SOURCE}", TOUR, PUBLIC, 0.0)
    assert refusal(visits, "zoe", "elsewhere", TOUR) == PlannerProblem.VISITS_FULL
    visits = Visits(["r1"])
    for _ in range(ASKED_MAX):
        visits.ask("anna", "", TOUR, PUBLIC, 0.0)
        visits.cancel("anna", 0.0)
    assert refusal(visits, "anna", "", TOUR, 1.0) == PlannerProblem.VISITS_TOO_OFTEN
    for number in range(PER_SOURCE):
        visits.ask(f"o{number}", "lobby", TOUR, PUBLIC, 0.0)
    assert refusal(visits, "zoe", "lobby", TOUR) == PlannerProblem.VISITS_FULL


def test_resting_robot_may_be_taken_and_one_that_is_held_may_not() -> None:
    assert is_free(state("HOLD", codes=[ReasonCode.AT_REST, ReasonCode.ON_DOCK]))
    assert not is_free(state("HOLD", codes=[ReasonCode.MAP_OLD]))
    assert not is_free(state("DEGRADED", codes=[ReasonCode.BATTERY_LOW]))
    assert not is_free(state("INIT", enabled=False))
    assert why_out(state("HOLD", codes=[ReasonCode.MAP_OLD])) is None


class World(RuleBasedStateMachine):
    """Visitors, operators, two robots and a planner that stores their missions, in any order."""

    owners = st.sampled_from(("anna", "bert", "carl"))
    robots = st.sampled_from(ROBOTS)
    ends = st.sampled_from((TOUR, TOUR[::-1], TOUR, ("hall", "office"), ("nowhere", "lab")))

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0
        self.visits = Visits(ROBOTS)
        self.public = dict(PUBLIC)
        self.missions: dict[str, tuple[str, bool]] = {}
        """By robot: the mission in force, and whether it is a visit's."""
        self.enabled = dict.fromkeys(ROBOTS, True)
        self.acts: list[Act] = []
        self.numbers = 0
        self.reached: set[str] = set()

    def new_mission(self, robot: str, *, of_visit: bool) -> str:
        self.numbers += 1
        self.missions[robot] = f"m{self.numbers}", of_visit
        return f"m{self.numbers}"

    def told(self, robot: str, goal: str | None = None, *, reached: bool = False) -> None:
        on = self.enabled[robot]
        told = state("NORMAL" if on else "INIT", enabled=on, goal_id=goal, goal_reached=reached)
        self.visits.on_state(robot, told, self.now)

    def open_on(self, robot: str) -> list[Visit]:
        return [visit for visit in self.visits._visits if visit.robot == robot and not visit.is_over]

    @initialize()
    def robots_come_to_two_and_one_waits(self) -> None:
        for owner in ("anna", "bert", "carl"):
            self.ask(owner, TOUR)
        self.step(seconds=1.0, lost=None, closed=None, quick=True)

    @rule(owner=owners, ends=ends)
    def ask(self, owner: str, ends: tuple[str, str]) -> None:
        try:
            visit = self.visits.ask(owner, owner, ends, self.public, self.now)
        except VisitError:
            return
        assert {visit.start, visit.goal} <= set(self.public)

    @rule(owner=owners, cancel=st.booleans())
    def go_or_cancel(self, *, owner: str, cancel: bool) -> None:
        with contextlib.suppress(VisitError):
            self.visits.cancel(owner, self.now) if cancel else self.visits.go(owner, self.now)

    @rule(robot=robots, word=st.sampled_from(("goal", "cancel", "stop", "stop at the robot", "enable")))
    def operator(self, robot: str, word: str) -> None:
        if word == "stop at the robot":
            self.enabled[robot] = False
            self.told(robot)
        else:
            if word == "goal":
                self.new_mission(robot, of_visit=False)
            elif word == "cancel":
                self.missions.pop(robot, None)
            else:
                self.enabled[robot] = word == "enable"
            self.visits.commanded(robot, self.now)
        assert self.open_on(robot) == []

    @rule(robot=robots, reached=st.booleans())
    def drive(self, *, robot: str, reached: bool) -> None:
        if self.enabled[robot] and robot in self.missions:
            self.told(robot, self.missions[robot][0], reached=reached)
            if reached:
                self.reached.add(self.missions[robot][0])

    @rule(robot=robots)
    def planner_ends_what_was_reached(self, robot: str) -> None:
        if self.missions.get(robot, ("", False))[0] in self.reached:
            del self.missions[robot]

    @rule(
        seconds=st.sampled_from((0.1, *[1.0] * 8, 100.0)), lost=st.sampled_from((None, None, *ROBOTS)),
        closed=st.sampled_from((None, None, *ROBOTS)), quick=st.booleans(),
    )  # fmt: skip
    def step(self, *, seconds: float, lost: str | None, closed: str | None, quick: bool) -> None:
        self.now += seconds
        fleet = {}
        for robot in ROBOTS:
            mission, of_visit = self.missions.get(robot, (None, False))
            on = self.enabled[robot]
            fleet[robot] = Facts(mission, of_visit, robot == closed, robot != lost, on)
        acts = self.visits.step(self.now, fleet, self.public)
        for act in acts:
            assert act.robot not in {other.robot for other in self.acts}
            if act.visit is None:
                assert self.missions[act.robot] == (act.mission, True), "only a visit's mission is ended"
            else:
                assert act.robot not in self.missions, "a robot with a mission is not taken"
                assert self.enabled[act.robot] or act.visit.state == "leading"
                assert act.place in self.public
        self.acts += acts
        wanted = {v.mission for v in self.visits._visits if v.state != "ended"}
        for robot, (mission, of_visit) in self.missions.items():
            ends = mission in wanted or any(act.robot == robot for act in self.acts)
            assert not of_visit or ends, "no robot drives for nobody"
        while quick and self.acts:
            self.carry_out(None)

    @rule(failed=st.sampled_from((None, VisitEnd.FAILED, VisitEnd.NO_WAY)))
    def carry_out(self, failed: VisitEnd | None) -> None:
        if not self.acts:
            return
        act = self.acts.pop(0)
        outcome: str | VisitEnd = VisitEnd.OPERATOR
        if act.visit is None:
            if self.missions.get(act.robot, ("", False))[0] == act.mission:
                del self.missions[act.robot]
        elif failed is not None:
            outcome = failed
        elif act.robot not in self.missions:
            outcome = self.new_mission(act.robot, of_visit=True)
        self.visits.done(act, outcome, self.now)

    @rule(name=st.sampled_from(TOUR), is_public=st.booleans())
    def place_is_changed(self, *, name: str, is_public: bool) -> None:
        self.public.pop(name, None)
        if is_public:
            self.public[name] = PLACES[name]

    @rule()
    def restart(self) -> None:
        self.visits = Visits(ROBOTS)
        self.acts.clear()

    @invariant()
    def robot_has_one_visit_at_most(self) -> None:
        assert all(len(self.open_on(robot)) <= 1 for robot in ROBOTS)

    def teardown(self) -> None:
        for _ in range(6):
            self.step(seconds=DRIVE_S + 1.0, lost=None, closed=None, quick=True)
        assert all(visit.is_over for visit in self.visits._visits), "every visit ends"
        assert not any(of_visit for _, of_visit in self.missions.values())


World.TestCase.settings = settings(max_examples=int(os.environ.get("FOGNAV_HISTORIES", "100")), stateful_step_count=40)
TestAnyHistory = World.TestCase
