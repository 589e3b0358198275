"""Leases of path corridors: no two overlap whatever happens, and whoever waits drives on in the end."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from ring_map import RingMap, goal, pose

from fog_contracts import channels as ch
from fog_contracts.geometry import lengths_along
from fog_contracts.handlers import Moment
from fog_contracts.messages import RectangleShape, RobotPath, RobotRelease, Zone, ZoneSet
from planner.core import PlannerCore
from planner.leases.corridor_leases import FORGET_S, MOST_ROBOTS, PATIENCE_S, SILENT_S, WITHDRAWN_S, CorridorLeases
from planner.leases.corridors import DEFAULT_RADIUS_M, MARGIN_M
from planner.leases.standstills import Standstills

CLEAR_M = 2.0 * DEFAULT_RADIUS_M + MARGIN_M
WAY_M = 15.0


def line(*corners: tuple[float, float]) -> np.ndarray:
    return np.array(corners, dtype=np.float64)


class Floor:
    """Robots that drive exactly what is released, in any order and at any speed."""

    def __init__(self, most_robots: int = MOST_ROBOTS) -> None:
        self.leases, self.now, self.plans = CorridorLeases(most_robots), 100.0, 0
        self.paths: dict[str, np.ndarray] = {}
        self.lengths: dict[str, np.ndarray] = {}
        self.ids: dict[str, tuple[int, int]] = {}
        self.along: dict[str, float] = {}
        self.released: dict[str, float] = {}

    def put(self, robot: str, *corners: tuple[float, float], priority: int = 0) -> None:
        """Put a robot at the beginning of a path, and let it have that path."""
        self.leases.place(robot, *corners[0], self.now)
        self.send(robot, *corners, priority=priority)
        self.leases.on_state(robot, self.ids[robot], self.now, able=True, strays=False)

    def send(self, robot: str, *corners: tuple[float, float], priority: int = 0) -> None:
        """Give a robot another path, of which it does not know yet."""
        self.plans += 1
        self.paths[robot], self.ids[robot], self.along[robot] = line(*corners), (1, self.plans), 0.0
        self.lengths[robot] = lengths_along(self.paths[robot])
        self.leases.follow(robot, self.ids[robot], self.paths[robot], f"to-{corners[-1]}", priority)
        self.released[robot] = 0.0

    def length(self, robot: str) -> float:
        return float(self.lengths[robot][-1])

    def at(self, robot: str, along: float) -> tuple[float, float]:
        x, y = (float(np.interp(along, self.lengths[robot], self.paths[robot][:, i])) for i in (0, 1))
        return x, y

    def ask(self, robot: str) -> float:
        wanted = min(self.length(robot), self.along[robot] + WAY_M)
        released = min(self.leases.release(robot, wanted, self.now), wanted)
        self.released[robot] = released
        return released

    def drive(self, robot: str, metres: float) -> None:
        self.along[robot] = max(self.along[robot], min(self.along[robot] + metres, self.released[robot]))
        self.leases.place(robot, *self.at(robot, self.along[robot]), self.now)
        self.leases.advance(robot, self.along[robot])

    def stretch(self, robot: str) -> np.ndarray:
        """Where a robot may be: the stretch that is released and not driven yet."""
        reach = np.linspace(self.along[robot], max(self.released[robot], self.along[robot]), 60)
        return np.column_stack([np.interp(reach, self.lengths[robot], self.paths[robot][:, i]) for i in (0, 1)])

    def apart(self, one: str, other: str) -> float:
        """The least distance between the middles of two robots, wherever they are on what is released to them."""
        a, b = self.stretch(one), self.stretch(other)
        return float(np.hypot(*(a[:, None, :] - b[None, :, :]).transpose(2, 0, 1)).min())

    def drive_all(self, steps: int = 400) -> None:
        """Let all robots drive until they have arrived."""
        for _ in range(steps):
            self.now += 1.0
            for robot in self.paths:
                self.ask(robot)
                self.drive(robot, 0.3)
            if all(self.arrived(robot) for robot in self.paths):
                return

    def arrived(self, robot: str) -> bool:
        return self.along[robot] > self.length(robot) - 1e-6


def test_a_robot_alone_gets_all_that_is_wanted():
    floor = Floor()
    floor.put("r1", (0.0, 0.0), (40.0, 0.0))
    assert floor.leases.release("r1", 15.0, 100.0) == math.inf


def test_robots_far_apart_get_all_that_is_wanted():
    floor = Floor()
    floor.put("r1", (0.0, 0.0), (40.0, 0.0))
    floor.put("r2", (0.0, 3.0), (40.0, 3.0))
    assert (floor.ask("r1"), floor.ask("r2")) == (15.0, 15.0)
    assert floor.leases.waits_for("r1") is None


def test_a_follower_gets_what_its_leader_has_left():
    floor = Floor()
    floor.put("r1", (3.0, 0.0), (40.0, 0.0))
    floor.put("r2", (0.0, 0.0), (40.0, 0.0))
    floor.ask("r1")
    assert floor.ask("r2") == pytest.approx(3.0 - CLEAR_M, abs=0.11)
    floor.drive("r1", 5.0)
    assert floor.ask("r2") == pytest.approx(8.0 - CLEAR_M, abs=0.11)


def test_who_crosses_waits_before_the_corridor_of_the_first_and_says_for_whom():
    floor = Floor()
    floor.put("r1", (-10.0, 0.0), (10.0, 0.0))
    floor.put("r2", (0.0, -5.0), (0.0, 5.0))
    floor.ask("r1")
    assert floor.ask("r2") == pytest.approx(5.0 - CLEAR_M, abs=0.11)
    floor.drive("r2", 5.0)
    assert floor.leases.waits_for("r2") == "r1"
    floor.drive_all()
    assert floor.arrived("r1")
    assert floor.arrived("r2")


def test_a_robot_does_not_stop_in_a_passage_that_another_one_has_to_drive():
    floor = Floor()
    # r2 leaves by the passage that r1 enters, and somebody stands at its end.
    floor.put("r1", (-8.0, 0.0), (12.0, 0.0))
    floor.put("r2", (10.0, 1.0), (10.0, 0.0), (-1.0, 0.0), (-1.0, -5.0))
    floor.leases.place("r3", 12.0, 0.0, floor.now)
    assert floor.ask("r1") < 7.0 - CLEAR_M + 0.11
    floor.drive_all()
    assert floor.arrived("r2")


def test_the_higher_priority_goes_first_then_the_earlier_mission():
    for priority, first in ((0, "r1"), (1, "r2")):
        floor = Floor()
        floor.put("r0", (0.0, 1.0), (0.0, -9.0))
        floor.put("r1", (-5.0, 0.0), (5.0, 0.0))
        floor.put("r2", (5.0, -0.2), (-1.0, -0.2), (-1.0, -5.0), priority=priority)
        for robot in ("r0", "r1", "r2"):
            floor.ask(robot)
        assert floor.leases.waits_for("r1") or floor.released["r1"] < 10.0
        order = sorted(("r1", "r2"), key=lambda robot: floor.leases._robots[robot].order)
        assert order[0] == first


def test_a_former_path_stays_leased_until_its_robot_names_the_new_one():
    floor = Floor()
    floor.put("r1", (0.0, 0.0), (10.0, 0.0))
    floor.put("r2", (5.0, -5.0), (5.0, 5.0))
    floor.ask("r1")
    former = floor.ids["r1"]
    floor.send("r1", (0.0, 0.0), (0.0, 10.0))
    floor.leases.on_state("r1", former, floor.now, able=True, strays=False)
    assert floor.ask("r2") < 5.0
    floor.leases.on_state("r1", floor.ids["r1"], floor.now, able=True, strays=False)
    assert floor.ask("r2") == 10.0


def test_robots_face_to_face_are_found_and_get_room():
    floor = Floor()
    floor.put("r1", (0.0, 0.0), (20.0, 0.0))
    floor.put("r2", (20.0, 0.0), (0.0, 0.0))
    floor.ask("r1")
    floor.ask("r2")
    assert floor.leases.standstills.stuck() == {"r1": {"r2"}, "r2": {"r1"}}
    rooms = [floor.leases.room_needed(floor.now) for _ in range(3)]
    assert [room.kind for room in rooms if room] == ["past", "past", "lane"]
    room = rooms[-1]
    assert room is not None
    assert (room.robot, room.whom) == ("r2", {"r1"})
    beside = line((20.0, 0.0), (20.0, 1.0), (0.0, 1.0))
    assert not floor.leases.standstills.accepts(room, line((20.0, 0.0), (0.0, 0.0)))
    assert floor.leases.standstills.accepts(room, beside)


def test_a_lease_of_a_robot_that_stands_is_given_back_before_others_get_it():
    floor = Floor()
    floor.put("r1", (0.0, 0.0), (20.0, 0.0))
    floor.put("r2", (5.0, -5.0), (5.0, 5.0))
    floor.ask("r1")
    floor.now += PATIENCE_S
    floor.leases.place("r1", 0.0, 0.0, floor.now)
    assert floor.ask("r2") < 5.0
    floor.leases.on_state("r1", floor.ids["r1"], floor.now, able=False, strays=False)
    assert floor.ask("r1") == 0.0, "it is told to stay"
    assert floor.ask("r2") < 5.0, "but may not have heard yet"
    floor.now += WITHDRAWN_S
    floor.leases.place("r1", 0.0, 0.0, floor.now)
    assert floor.ask("r2") == 10.0
    assert [disc.points.tolist() for disc in floor.leases.obstacles("r2")] == [[[0.0, 0.0]]]


def test_a_robot_that_is_silent_is_forgotten_after_a_while():
    floor = Floor()
    floor.leases.place("r1", 5.0, 0.0, floor.now)
    floor.put("r2", (5.0, -5.0), (5.0, 5.0))
    assert floor.ask("r2") < 5.0
    floor.now += FORGET_S + 1.0
    floor.leases.place("r2", 5.0, -5.0, floor.now)
    assert floor.ask("r2") == 10.0


places = st.tuples(st.integers(0, 12), st.integers(0, 12)).map(lambda cell: (1.0 * cell[0], 1.0 * cell[1]))


class Interleavings(RuleBasedStateMachine):
    """Robots ask, drive and change their paths in any order."""

    @initialize(starts=st.lists(places, min_size=2, max_size=14, unique=True), data=st.data())
    def begin(self, starts: list[tuple[float, float]], data: st.DataObject) -> None:
        self.floor = Floor()
        for number, start in enumerate(starts):
            corners = data.draw(st.lists(places, min_size=1, max_size=3))
            self.floor.put(f"r{number}", start, *corners)
        self.robots = sorted(self.floor.paths)
        self.apart = self._apart()

    def _apart(self) -> dict[tuple[str, str], float]:
        robots = self.robots
        return {(a, b): self.floor.apart(a, b) for i, a in enumerate(robots) for b in robots[i + 1 :]}

    @rule(number=st.integers(0, 4))
    def ask(self, number: int) -> None:
        robot = self.robots[number % len(self.robots)]
        before = self.floor.released[robot]
        assert self.floor.ask(robot) >= before - 1e-9, "what is released is not taken back"

    @rule(number=st.integers(0, 4), metres=st.floats(0.05, 3.0))
    def drive(self, number: int, metres: float) -> None:
        self.floor.now += 0.1
        self.floor.drive(self.robots[number % len(self.robots)], metres)

    @rule(number=st.integers(0, 4), corners=st.lists(places, min_size=1, max_size=3))
    def turn_off(self, number: int, corners: list[tuple[float, float]]) -> None:
        """A robot gets another path from where it is, which it has at once."""
        robot = self.robots[number % len(self.robots)]
        self.floor.send(robot, self.floor.at(robot, self.floor.along[robot]), *corners)
        self.floor.leases.on_state(robot, self.floor.ids[robot], self.floor.now, able=True, strays=False)

    @invariant()
    def no_leases_overlap(self) -> None:
        for pair, apart in self._apart().items():
            # Who got too near by nobody's lease, at the start, gets no nearer.
            assert apart >= min(CLEAR_M, self.apart[pair]) - 0.02, (pair, apart)

    @invariant()
    def only_what_has_changed_needs_to_be_compared_again(self) -> None:
        standstills = self.floor.leases.standstills
        assert standstills.order({}) == Standstills(standstills._robots).order({})


Interleavings.TestCase.settings = settings(max_examples=12, stateful_step_count=25, deadline=None)
TestInterleavings = Interleavings.TestCase


class Crowds(RuleBasedStateMachine):
    """Robots are sometimes too many for leases; whoever has asked since they are few enough is kept apart."""

    @initialize(starts=st.lists(places, min_size=3, max_size=6, unique=True), data=st.data())
    def begin(self, starts: list[tuple[float, float]], data: st.DataObject) -> None:
        self.floor, self.asked, self.apart = Floor(most_robots=2), set(), {}
        for number, start in enumerate(starts):
            self.floor.put(f"r{number}", start, *data.draw(st.lists(places, min_size=1, max_size=3)))
        self.robots = sorted(self.floor.paths)

    def _here(self, robot: str) -> tuple[float, float]:
        return self.floor.at(robot, self.floor.along[robot])

    @rule(number=st.integers(0, 5))
    def ask(self, number: int) -> None:
        self._ask(self.robots[number % len(self.robots)])

    def _ask(self, robot: str) -> None:
        if self.floor.leases._robots[robot].path is None:
            return
        self.floor.ask(robot)
        if self.floor.leases._shared:
            self.asked.add(robot)
            for other in self.asked - {robot}:
                bodies = math.dist(self._here(robot), self._here(other))
                self.apart[robot, other] = self.apart[other, robot] = bodies
        else:
            self.asked.clear()

    @rule()
    def ask_all(self) -> None:
        for robot in self.robots:
            self._ask(robot)

    @rule(number=st.integers(0, 5), metres=st.floats(0.5, 3.0))
    def drive(self, number: int, metres: float) -> None:
        self.floor.now += 0.1
        self.floor.drive(self.robots[number % len(self.robots)], metres)

    @rule(number=st.integers(0, 5))
    def end(self, number: int) -> None:
        """A mission ends; its robot stops, and says so."""
        robot = self.robots[number % len(self.robots)]
        self.floor.leases.stop(robot)
        self.floor.released[robot] = 0.0
        self.floor.now += SILENT_S + 0.1
        self.floor.leases.on_state(robot, None, self.floor.now, able=True, strays=False)

    @rule(number=st.integers(0, 5), corners=st.lists(places, min_size=1, max_size=3))
    def send(self, number: int, corners: list[tuple[float, float]]) -> None:
        robot = self.robots[number % len(self.robots)]
        self.floor.put(robot, self._here(robot), *corners)
        if not self.floor.leases._shared:
            self.asked.clear()

    @rule()
    def wait(self) -> None:
        self.floor.now += WITHDRAWN_S + 0.1
        for robot in self.robots:
            self.floor.leases.place(robot, *self._here(robot), self.floor.now)
            self.floor.leases.on_state(robot, self.floor.ids[robot], self.floor.now, able=True, strays=False)

    @invariant()
    def what_is_released_does_not_overlap(self) -> None:
        if self.floor.leases._shared:
            for one, other in itertools.combinations(sorted(self.asked), 2):
                apart = self.floor.apart(one, other)
                assert apart >= min(CLEAR_M, self.apart[one, other]) - 0.02, (one, other, apart)


Crowds.TestCase.settings = settings(max_examples=25, stateful_step_count=40, deadline=None)
TestCrowds = Crowds.TestCase


def narrow(name: str, corner: tuple[float, float], opposite: tuple[float, float]) -> Zone:
    return Zone(id=name, kind="RELEASE", shape=RectangleShape(corner=corner, opposite=opposite))


def test_a_robot_waits_before_a_place_for_one_robot_until_the_one_in_it_has_left():
    floor = Floor()
    floor.leases.set_places([narrow("gate", (4.0, -2.0), (8.0, 5.0))], floor.now)
    floor.put("r1", (5.0, 3.0), (12.0, 3.0))
    floor.put("r2", (0.0, 0.0), (12.0, 0.0))
    assert floor.ask("r1") == 7.0
    assert 3.4 < floor.ask("r2") < 4.0 - DEFAULT_RADIUS_M, "their corridors are 3 m apart, and yet"
    floor.drive("r2", 4.0)
    assert floor.leases.waits_for("r2") == "r1"
    floor.drive("r1", 3.5)
    assert floor.ask("r2") == 12.0, "it has left"
    floor.leases.set_places([], floor.now)
    assert floor.leases.waits_for("r2") is None


def test_a_place_for_one_robot_over_two_leases_stays_with_the_robot_that_is_in_it():
    floor = Floor()
    floor.put("r1", (0.0, 3.0), (12.0, 3.0))
    floor.put("r2", (0.0, 0.0), (12.0, 0.0))
    assert floor.ask("r1") == floor.ask("r2") == 12.0
    floor.drive("r1", 5.0)
    floor.leases.set_places([narrow("gate", (4.0, -2.0), (8.0, 5.0))], floor.now)
    assert (floor.ask("r1"), floor.ask("r2")) == (12.0, 0.0)
    for _ in range(3):
        floor.now += WITHDRAWN_S / 2.0
        floor.drive("r2", 0.0)
        floor.ask("r2")
        floor.leases.on_state("r2", floor.ids["r2"], floor.now, able=True, strays=False)
    assert 3.4 < floor.ask("r2") < 4.0, "it has heard, and drives on to the place"


def test_robots_that_come_to_a_place_for_one_robot_from_both_sides_all_get_through():
    floor = Floor()
    floor.leases.set_places([narrow("gate", (4.0, -2.0), (8.0, 5.0))], floor.now)
    floor.put("r1", (0.0, 3.0), (12.0, 3.0))
    floor.put("r2", (12.0, 0.0), (0.0, 0.0))
    floor.put("r3", (0.0, 0.0), (3.0, 0.0), (6.0, -1.0), (12.0, -1.0))
    floor.drive_all(600)
    assert [robot for robot in floor.paths if not floor.arrived(robot)] == []


def test_robot_that_falls_silent_in_a_place_for_one_robot_keeps_it_until_it_is_taken_out_of_service() -> None:
    floor = Floor()
    floor.leases.set_places([narrow("a", (2.5, 2.5), (5.5, 6.5))], floor.now)
    floor.put("dead", (4.0, 4.5), (4.0, 4.6))
    floor.put("r1", (0.5, 4.5), (10.0, 4.5))

    def after(seconds: float) -> float:
        floor.now += seconds
        floor.leases.place("r1", 0.5, 4.5, floor.now)
        return floor.leases.release("r1", 10.0, floor.now)

    assert after(59.0) < 2.5
    assert after(3600.0) < 2.5
    floor.leases.take_out("dead")
    assert after(1.0) > 5.0


class OneRobot(RuleBasedStateMachine):
    """Robots ask, drive, change their paths and wait in any order, on a floor with places for one robot."""

    zones = (narrow("a", (2.5, 2.5), (5.5, 6.5)), narrow("b", (6.5, 4.5), (9.5, 11.5)))

    @initialize(starts=st.lists(places, min_size=2, max_size=6, unique=True), data=st.data())
    def begin(self, starts: list[tuple[float, float]], data: st.DataObject) -> None:
        self.floor = Floor()
        self.floor.leases.set_places(self.zones, self.floor.now)
        for number, start in enumerate(starts):
            self.floor.put(f"r{number}", start, *data.draw(st.lists(places, min_size=1, max_size=3)))
        self.robots = sorted(self.floor.paths)
        self.began_in = {zone.id: self._in(zone) for zone in self.zones}

    def _in(self, zone: Zone) -> set[str]:
        """The robots that may be in a zone, wherever they are on what is released to them."""
        shape = zone.shape
        assert isinstance(shape, RectangleShape)
        low, high = np.array(shape.corner), np.array(shape.opposite)
        found = set()
        for robot in self.robots:
            beyond = np.maximum(np.maximum(low - self.floor.stretch(robot), self.floor.stretch(robot) - high), 0.0)
            if np.hypot(*beyond.T).min() < DEFAULT_RADIUS_M - 0.03:
                found.add(robot)
        return found

    @rule(number=st.integers(0, 5))
    def ask(self, number: int) -> None:
        self.floor.ask(self.robots[number % len(self.robots)])

    @rule(number=st.integers(0, 5), metres=st.floats(0.05, 4.0))
    def drive(self, number: int, metres: float) -> None:
        self.floor.now += 0.1
        self.floor.drive(self.robots[number % len(self.robots)], metres)

    @rule(number=st.integers(0, 5), corners=st.lists(places, min_size=1, max_size=3))
    def turn_off(self, number: int, corners: list[tuple[float, float]]) -> None:
        robot = self.robots[number % len(self.robots)]
        self.floor.send(robot, self.floor.at(robot, self.floor.along[robot]), *corners)
        self.floor.leases.on_state(robot, self.floor.ids[robot], self.floor.now, able=True, strays=False)

    @rule()
    def wait(self) -> None:
        for _ in range(4):
            self.floor.now += WITHDRAWN_S / 4.0
            for robot in self.robots:
                self.floor.drive(robot, 0.0)
                self.floor.leases.on_state(robot, self.floor.ids[robot], self.floor.now, able=True, strays=False)
                self.floor.ask(robot)  # as all do twice a second: what is asked back is heard in time

    @invariant()
    def a_place_has_one_robot_besides_those_that_began_in_it(self) -> None:
        for zone in self.zones:
            inside = self._in(zone)
            self.began_in[zone.id] &= inside
            assert len(inside) <= max(1, len(self.began_in[zone.id])), (zone.id, inside, self.began_in)

    @invariant()
    def only_what_has_changed_needs_to_be_compared_again(self) -> None:
        standstills = self.floor.leases.standstills
        assert standstills.order({}) == Standstills(standstills._robots, standstills._places).order({})


OneRobot.TestCase.settings = settings(max_examples=15, stateful_step_count=30, deadline=None)
TestOneRobot = OneRobot.TestCase


# Who has waited for more than PATIENCE_S gets its lease back in the moment in which another one needs it.
@example(trips=[((0.0, 4.0), (1.0, 3.0)), ((4.0, 6.0), (0.0, 3.0)), ((0.0, 5.0), (0.0, 4.0))])
@settings(max_examples=40, deadline=None)
@given(
    trips=st.lists(st.tuples(places, places), min_size=2, max_size=5, unique_by=(lambda t: t[0], lambda t: t[1])),
)
def test_all_arrive_whenever_some_order_lets_them(trips):
    floor = Floor()
    for number, (start, end) in enumerate(trips):
        floor.put(f"r{number}", start, end)
    for robot in floor.paths:
        floor.ask(robot)
    if floor.leases.standstills.stuck():
        return  # face to face from the beginning: others than leases must help
    floor.drive_all(500)
    assert [robot for robot in floor.paths if not floor.arrived(robot)] == []


def test_a_release_says_for_whom_a_robot_waits():
    core, ring_map = PlannerCore(epoch=1), RingMap()
    core.load(ring_map.master.snapshot(), 10.0)
    core.set_goal("r1", goal(19.0, 7.0))
    released = []
    for step in range(8):
        at = Moment(10.0 + 0.1 * step, 10.0 + 0.1 * step)
        core.handlers()[ch.MAP_HEARTBEAT]({}, ring_map.master.heartbeat(at.now), at)
        core.handlers()[ch.ROBOT_POSE]({"robot": "r1"}, pose(19.0, 7.9), at)
        core.handlers()[ch.ROBOT_POSE]({"robot": "r2"}, pose(19.0, 7.0), at)
        released += [p.message for p in core.tick(at) if isinstance(p.message, RobotRelease)]
    assert released
    assert released[-1].waits_for == "r2"
    assert released[-1].released_length < 0.5


@pytest.mark.parametrize(("active", "way"), [(["gate"], "lower"), ([], "upper")])
def test_a_robot_is_led_round_a_zone_for_one_robot_in_which_another_one_stands(active, way):
    core, ring_map = PlannerCore(epoch=1), RingMap()
    core.load(ring_map.master.snapshot(), 10.0)
    gate = narrow("gate", (8.0, 9.0), (12.0, 12.0))
    core.handlers()[ch.ZONES]({}, ZoneSet(epoch=1, seq=1, zones=[gate], active=active), Moment(10.0, 10.0))
    core.set_goal("r1", goal(15.0, 11.0))
    core.handlers()[ch.MAP_HEARTBEAT]({}, ring_map.master.heartbeat(10.0), Moment(10.0, 10.0))
    core.handlers()[ch.ROBOT_POSE]({"robot": "r2"}, pose(10.0, 9.0), Moment(10.0, 10.0))
    core.handlers()[ch.ROBOT_POSE]({"robot": "r1"}, pose(5.0, 11.0), Moment(10.0, 10.0))
    paths = [p.message for p in core.tick(Moment(10.0, 10.0)) if isinstance(p.message, RobotPath)]
    assert ["lower" if min(y for _, y in path.points) < 2.0 else "upper" for path in paths] == [way]
