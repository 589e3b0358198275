"""Leases of robots that fall silent, stand, get lost, are driven by hand, or appear in another one's corridor."""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field

import numpy as np
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from ring_map import RingMap, goal, pose
from test_corridor_leases import CLEAR_M, Floor

from fog_contracts import channels as ch
from fog_contracts.geometry import lengths_along
from fog_contracts.handlers import Moment
from fog_contracts.messages import RobotPath, RobotState
from planner.core import PlannerCore
from planner.leases.corridor_leases import FORGET_S, MOST_ROBOTS, PATIENCE_S, SILENT_S, WITHDRAWN_S


def wait(floor: Floor, seconds: float, *heard: str, able: tuple[str, ...] = ()) -> None:
    """Let time pass, half a second at a time; those who are `heard` tell where they are, and ask."""
    for _ in range(round(seconds / 0.5)):
        floor.now += 0.5
        for robot in heard:
            floor.leases.place(robot, *floor.at(robot, floor.along[robot]), floor.now)
            floor.leases.on_state(robot, floor.ids[robot], floor.now, able=robot in able, strays=False)
        for robot in heard:
            floor.ask(robot)


def test_a_path_that_may_still_arrive_stays_leased_when_the_robot_names_an_older_one():
    floor = Floor()
    floor.put("r1", (0.0, 0.0), (0.0, 10.0))
    floor.put("r2", (5.0, -5.0), (5.0, 5.0))
    first = floor.ids["r1"]
    floor.ask("r1")
    floor.send("r1", (0.0, 0.0), (10.0, 0.0))
    floor.ask("r1")
    floor.send("r1", (0.0, 0.0), (0.0, 10.0))
    floor.ask("r1")
    # It has not got the second one yet, and may drive that until it has the third.
    floor.leases.on_state("r1", first, floor.now, able=True, strays=False)
    assert floor.ask("r2") < 5.0


def test_figures_tell_who_waits_and_how_much_is_leased():
    floor = Floor()
    floor.put("r1", (-6.0, 0.0), (6.0, 0.0))
    floor.put("r2", (0.0, 0.6), (0.0, -6.0))
    floor.leases.place("parked", 0.0, 20.0, floor.now)
    floor.ask("r1")
    floor.ask("r2")
    assert floor.leases.waits_for("r2") == "r1"
    assert floor.leases.figures() == (1, pytest.approx(12.0 + floor.released["r2"]))


def test_a_robot_that_falls_silent_while_it_waits_is_no_longer_waited_for():
    floor = Floor()
    floor.put("r1", (-6.0, 0.0), (6.0, 0.0))
    floor.put("r2", (0.0, 5.0), (0.0, -6.0))
    floor.put("r3", (0.0, 8.0), (0.0, -3.0))
    for robot in ("r1", "r2", "r3"):
        floor.ask(robot)
    floor.drive("r2", 5.0)
    floor.ask("r2")
    assert floor.leases.waits_for("r2") == "r1"
    floor.drive("r3", 5.0)
    wait(floor, PATIENCE_S + WITHDRAWN_S + 1.0, "r1", "r3", able=("r1", "r3"))
    assert [disc.points.tolist() for disc in floor.leases.obstacles("r3")] != [], "r2 is an obstacle"
    wait(floor, FORGET_S, "r1", "r3", able=("r1", "r3"))
    assert "r2" not in floor.leases._robots


def test_a_robot_with_a_fault_just_before_the_end_of_its_lease_is_gone_round():
    floor = Floor()
    floor.put("r1", (0.0, 0.0), (5.0, 0.0))
    floor.put("r2", (10.0, 0.0), (-5.0, 0.0))
    floor.ask("r1")
    floor.drive("r1", 4.7)
    floor.ask("r2")
    wait(floor, PATIENCE_S + WITHDRAWN_S + 1.0, "r1", "r2", able=("r2",))
    assert [disc.points.tolist() for disc in floor.leases.obstacles("r2")] == [[[4.7, 0.0]]]


def test_whoever_appears_on_another_ones_lease_only_leaves_it():
    floor = Floor()
    floor.put("r1", (0.0, 0.0), (40.0, 0.0))
    floor.put("r3", (0.0, 20.0), (1.0, 20.0))
    assert floor.ask("r1") == 15.0
    floor.put("r2", (10.0, 0.0), (-5.0, 0.0))
    assert floor.ask("r2") == 0.0, "r1 may be anywhere on its lease"
    floor.send("r2", (10.0, 0.0), (10.0, 5.0))
    floor.leases.on_state("r2", floor.ids["r2"], floor.now, able=True, strays=False)
    assert floor.ask("r2") == 5.0
    floor.send("r2", (10.0, 0.0), (10.0, 0.3), (0.0, 0.3))
    floor.leases.on_state("r2", floor.ids["r2"], floor.now, able=True, strays=False)
    assert floor.ask("r2") < 0.5


def test_a_robot_is_told_to_stop_before_one_that_has_appeared_on_its_lease():
    floor = Floor()
    floor.put("r1", (0.0, 0.0), (40.0, 0.0))
    floor.put("r3", (0.0, 20.0), (1.0, 20.0))
    assert floor.ask("r1") == 15.0
    floor.leases.place("r2", 10.0, 0.0, floor.now)
    assert floor.ask("r1") < 10.0 - CLEAR_M + 0.15


def test_a_robot_that_is_carried_away_is_in_nobodys_way_any_more():
    floor = Floor()
    floor.put("r1", (-8.0, 0.0), (12.0, 0.0))
    floor.put("r2", (12.0, 1.0), (12.0, 0.0), (-8.0, 0.0), (-8.0, 1.0))
    floor.leases.place("r3", 2.0, 0.0, floor.now)
    floor.ask("r1")
    floor.ask("r2")
    assert "r1" in floor.leases.standstills.stuck()
    floor.put("r2", (12.0, 5.0), (12.0, 6.0))
    floor.leases.standstills.stuck()
    floor.leases.place("r3", 2.0, 20.0, floor.now)
    assert not floor.leases.standstills.stuck()


def test_robots_beyond_the_most_with_a_path_get_what_a_robot_alone_gets_but_parked_ones_do_not_count():
    floor = Floor()
    for number in range(MOST_ROBOTS):
        floor.put(f"r{number}", (0.0, 3.0 * number), (10.0, 3.0 * number))
    for number in range(5):
        floor.leases.place(f"parked{number}", 20.0, 3.0 * number, floor.now)
    assert floor.leases.release("r0", 10.0, floor.now) < math.inf
    floor.put("one-more", (0.0, -5.0), (10.0, -5.0))
    assert floor.leases.release("r0", 10.0, floor.now) == math.inf


def test_leases_that_overlap_since_robots_were_too_many_are_withdrawn_as_soon_as_they_are_few_enough():
    floor = Floor(most_robots=2)
    floor.put("r1", (0.0, 0.0), (20.0, 0.0))
    floor.put("r2", (20.0, 0.0), (7.0, 0.0), (7.0, 5.0))
    floor.put("r3", (0.0, 9.0), (20.0, 9.0))
    assert floor.ask("r1") == floor.ask("r2") == 15.0
    floor.drive("r1", 4.0)
    floor.leases.stop("r3")
    assert (floor.ask("r1"), floor.ask("r2")) == (4.0, 0.0), "both are told to stay where they are"
    wait(floor, WITHDRAWN_S - 1.0, "r1", "r2", able=("r1", "r2"))
    assert (floor.released["r1"], floor.released["r2"]) == (4.0, 0.0)
    wait(floor, 2.0, "r1", "r2", able=("r1", "r2"))
    assert floor.released["r2"] == 15.0, "once both have heard, one of them drives on"
    assert floor.apart("r1", "r2") > CLEAR_M - 0.02


def test_robots_that_met_while_they_were_too_many_for_leases_are_found_afterwards():
    floor = Floor(most_robots=10)
    floor.put("r1", (0.0, 0.0), (20.0, 0.0))
    floor.put("r2", (20.0, 0.0), (0.0, 0.0))
    for number in range(9):
        floor.put(f"x{number}", (0.0, 5.0 + 3.0 * number), (10.0, 5.0 + 3.0 * number))
    assert floor.ask("r1") == floor.ask("r2") == 15.0
    floor.drive("r1", 9.0)
    floor.drive("r2", 9.0)
    for number in range(9):
        floor.leases.stop(f"x{number}")
    wait(floor, WITHDRAWN_S + 2.0, "r1", "r2", able=("r1", "r2"))
    assert floor.leases.standstills.stuck() == {"r1": {"r2"}, "r2": {"r1"}}
    assert floor.released["r1"] + floor.released["r2"] <= 20.0 - CLEAR_M + 0.2


@pytest.mark.parametrize("heard", [False, True])
def test_a_robot_that_has_told_no_state_yet_may_be_driving_by_an_older_planners_path(heard):
    floor = Floor()
    floor.put("r1", (0.0, 0.0), (10.0, 0.0))
    floor.leases.place("r2", 5.0, 1.0, floor.now)
    if heard:
        floor.leases.on_state("r2", None, floor.now, able=True, strays=False)
    assert (floor.ask("r1") == 10.0) is heard


def test_what_a_robot_may_still_drive_of_a_former_leaders_path_stays_free_until_it_names_a_new_one():
    floor = Floor()
    floor.leases.place("r1", 0.0, 0.0, floor.now)
    floor.leases.on_state("r1", (1, 77), floor.now, able=True, strays=False)
    floor.plans = 100
    floor.put("r2", (0.9, -5.0), (0.9, 5.0))
    assert floor.ask("r2") < 5.0
    floor.send("r1", (0.0, 0.0), (-5.0, 0.0))
    floor.ask("r1")
    assert floor.ask("r2") < 5.0
    floor.leases.on_state("r1", floor.ids["r1"], floor.now, able=True, strays=False)
    assert floor.ask("r2") == 10.0


def test_others_may_pass_beside_a_refused_robot_but_not_beside_one_driven_by_hand():
    core, ring_map = PlannerCore(epoch=1), RingMap()
    core.load(ring_map.master.snapshot(), 10.0)
    for delta in ring_map.put("closed", (12.0, 10.0, 13.0, 12.0)):
        core.handlers()[ch.MAP_DELTA]({}, delta, Moment(10.0, 10.0))
    core.set_goal("r1", goal(9.0, 10.7))
    core.set_goal("r2", goal(12.5, 11.0))
    plans: dict[str, int] = {}
    released: dict[str, float] = {}
    for step in range(60):
        at = Moment(10.0 + 0.1 * step, 10.0 + 0.1 * step)
        core.handlers()[ch.MAP_HEARTBEAT]({}, ring_map.master.heartbeat(at.now), at)
        for robot, (x, y) in (("r1", (1.0, 10.7)), ("r2", (5.0, 11.6))):
            core.handlers()[ch.ROBOT_POSE]({"robot": robot}, pose(x, y), at)
            state = RobotState(
                mode="TELEOP" if robot == "r2" and step >= 40 else "NORMAL", reasons=[], enabled=True, battery=None,
                goal_id="g1", map_epoch=1, map_seq=1, plan_id=plans.get(robot), planner_epoch=1,
            )  # fmt: skip
            core.handlers()[ch.ROBOT_STATE]({"robot": robot}, state, at)
        for publication in core.tick(at):
            if isinstance(publication.message, RobotPath):
                plans[publication.ids["robot"]] = publication.message.plan_id
        released["r1"] = core.missions.of("r1").plan.released_length(core.config)
        if step == 39:
            assert core.missions.of("r2").plan.refusal is not None
            assert released["r1"] > 7.9
    assert [disc.reach > 1.0 for disc in core.leases.obstacles("r1")] == [True]


places = st.tuples(st.integers(0, 4), st.integers(0, 4)).map(lambda cell: (1.0 * cell[0], 1.0 * cell[1]))


@dataclass
class Radio:
    """What is on its way to a robot, and the robot's own knowledge; messages may be late, or get lost."""

    path: tuple[int, int] | None
    released: float
    coming: list[tuple[float, tuple[int, int], float]] = field(default_factory=list)
    told: list[tuple[int, int] | None] = field(default_factory=list)


class LateAndLost(RuleBasedStateMachine):
    """Paths, releases and states arrive late or never; wherever robots may drive then, no two of them meet."""

    @initialize(starts=st.lists(places, min_size=2, max_size=4, unique=True), data=st.data())
    def begin(self, starts: list[tuple[float, float]], data: st.DataObject) -> None:
        self.floor, self.radios, self.lines = Floor(), {}, {}
        for number, start in enumerate(starts):
            robot = f"r{number}"
            self.floor.put(robot, start, *data.draw(st.lists(places, min_size=1, max_size=2)))
            self.radios[robot] = Radio(self.floor.ids[robot], 0.0)
            self.lines[self.floor.ids[robot]] = self.floor.paths[robot]
        self.at = dict(zip(self.radios, starts, strict=True))
        self.along = dict.fromkeys(self.radios, 0.0)
        self.robots = list(self.radios)
        self.apart = self._apart()

    def _robot(self, number: int) -> str:
        return self.robots[number % len(self.robots)]

    @rule(number=st.integers(0, 3))
    def release(self, number: int) -> None:
        robot = self._robot(number)
        for other in self.robots:
            self.hear(self.robots.index(other))
        self.radios[robot].coming.append((self.floor.now, self.floor.ids[robot], self.floor.ask(robot)))

    @rule(number=st.integers(0, 3), corners=st.lists(places, min_size=1, max_size=2))
    def replan(self, number: int, corners: list[tuple[float, float]]) -> None:
        robot = self._robot(number)
        self.tell(number)
        self.floor.send(robot, self.at[robot], *corners)
        self.lines[self.floor.ids[robot]] = self.floor.paths[robot]
        self.release(number)

    @rule(number=st.integers(0, 3))
    def deliver(self, number: int) -> None:
        robot = self._robot(number)
        radio = self.radios[robot]
        if not radio.coming:
            return
        _, path, released = radio.coming.pop(0)
        if radio.path is None or path > radio.path:
            if math.dist(self.lines[path][0], self.at[robot]) > 1e-6:
                return  # the planner finds it off its path, and sends another one
            radio.path, self.along[robot] = path, 0.0
        elif path < radio.path:
            return
        radio.released = released

    @rule(number=st.integers(0, 3))
    def lose(self, number: int) -> None:
        del self.radios[self._robot(number)].coming[:1]

    @rule(number=st.integers(0, 3), metres=st.floats(0.05, 3.0))
    def drive(self, number: int, metres: float) -> None:
        robot = self._robot(number)
        radio = self.radios[robot]
        self.floor.now += 0.2
        for other in self.radios.values():
            other.coming = [each for each in other.coming if self.floor.now - each[0] < SILENT_S - 0.1]
        if radio.path is None:
            return
        line = self.lines[radio.path]
        lengths = lengths_along(line)
        self.along[robot] = max(self.along[robot], min(self.along[robot] + metres, radio.released, lengths[-1]))
        x, y = (float(np.interp(self.along[robot], lengths, line[:, i])) for i in (0, 1))
        self.at[robot] = x, y
        self.floor.leases.place(robot, x, y, self.floor.now)
        if radio.path == self.floor.ids[robot]:
            self.floor.along[robot] = self.along[robot]
            self.floor.leases.advance(robot, self.along[robot])

    @rule(number=st.integers(0, 3))
    def restart(self, number: int) -> None:
        radio = self.radios[self._robot(number)]
        radio.path, radio.released = None, 0.0

    @rule(number=st.integers(0, 3))
    def tell(self, number: int) -> None:
        radio = self.radios[self._robot(number)]
        radio.told.append(radio.path)

    @rule(number=st.integers(0, 3))
    def hear(self, number: int) -> None:
        robot = self._robot(number)
        if told := self.radios[robot].told:
            self.floor.leases.on_state(robot, told.pop(0), self.floor.now, able=True, strays=False)

    def _where(self, robot: str) -> np.ndarray:
        """Every place to which a robot may drive by what it knows, or may still receive."""
        radio = self.radios[robot]
        ways: dict[tuple[int, int], tuple[float, float]] = {}
        if radio.path is not None:
            ways[radio.path] = self.along[robot], radio.released
        for _, path, released in radio.coming:
            reachable = path == radio.path or math.dist(self.lines[path][0], self.at[robot]) < 1e-6
            if (radio.path is None or path >= radio.path) and reachable:
                begin, end = ways.get(path, (0.0, 0.0))
                ways[path] = begin, max(end, released)
        found = [np.array([self.at[robot]])]
        for path, (begin, end) in ways.items():
            lengths, reach = lengths_along(self.lines[path]), np.linspace(begin, max(begin, end), 60)
            found.append(np.column_stack([np.interp(reach, lengths, self.lines[path][:, i]) for i in (0, 1)]))
        return np.concatenate(found)

    def _apart(self) -> dict[tuple[str, str], float]:
        where = {robot: self._where(robot) for robot in self.robots}
        return {
            (a, b): float(np.hypot(*(where[a][:, None, :] - where[b][None, :, :]).transpose(2, 0, 1)).min())
            for i, a in enumerate(self.robots)
            for b in self.robots[i + 1 :]
        }

    @invariant()
    def no_two_meet(self) -> None:
        for pair, apart in self._apart().items():
            assert apart >= min(CLEAR_M, self.apart[pair]) - 0.02, (pair, apart)


LateAndLost.TestCase.settings = settings(
    max_examples=int(os.environ.get("FOGNAV_HISTORIES", "20")), stateful_step_count=40, deadline=None
)
TestLateAndLost = LateAndLost.TestCase
