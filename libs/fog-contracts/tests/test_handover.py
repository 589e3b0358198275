"""A robot is on one floor at most, in any interleaving of cuts, restarts and repeats; and on the wanted one at last."""

import os

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, precondition, rule

from fog_contracts.handover import next_berth, standing
from fog_contracts.messages import Berth, HandOver, Reason

FLOORS = ("a", "b", "c")
FIRST = FLOORS[0]


class Floor:
    """The planners of a floor: what is stored, and what the one that leads remembers of it."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.stored: Berth | None = None
        self.remembered: Berth | None = None
        self.said: Berth | None = None

    def swap(self, new: Berth) -> bool:
        """Store a record if the one that is remembered is the stored one, as Redis does."""
        if self.stored != self.remembered:
            self.remembered = self.stored
            return False
        self.stored = self.remembered = new
        return True

    @property
    def serves(self) -> bool:
        """Whether it sends the robot anywhere."""
        return self.said is not None and standing(self.remembered, self.said, self.name) == "here"

    @property
    def holds(self) -> bool:
        """Whether the robot is on this floor by what is stored."""
        return self.name == FIRST if self.stored is None else self.stored.floor == self.name


class Building(RuleBasedStateMachine):
    """Messages of floor and robot are delivered late, again or never; what is on the way to a robot ends with its run.

    Two planners of a floor share its store: `other_copy` lets one act by what it remembered before the other wrote.
    """

    def __init__(self) -> None:
        super().__init__()
        self.robot, self.boot = Berth(floor=FIRST), 0
        self.floors = {name: Floor(name) for name in FLOORS}
        self.to_floor: list[tuple[str, Berth]] = []
        self.to_robot: list[tuple[str, int, HandOver | None]] = []

    @rule()
    def robot_speaks(self) -> None:
        if (self.robot.floor, self.robot) not in self.to_floor:
            self.to_floor.append((self.robot.floor, self.robot))

    @precondition(lambda self: self.to_floor)
    @rule(data=st.data(), sends=st.booleans())
    def floor_hears(self, data: st.DataObject, *, sends: bool) -> None:
        name, said = data.draw(st.sampled_from(self.to_floor))
        self.hears(self.floors[name], said, sends=sends)

    def hears(self, floor: Floor, said: Berth, *, sends: bool = True) -> None:
        floor.said = said
        match standing(floor.remembered, said, floor.name):
            case "arrives":
                floor.swap(said)
            case "leaves":
                if sends and floor.remembered is not None:
                    self.to_robot.append((floor.name, self.boot, floor.remembered.came_by))
            case "here":
                if sends:
                    self.to_robot.append((floor.name, self.boot, None))
            case "stale":
                pass

    @rule(name=st.sampled_from(FLOORS), to=st.sampled_from(FLOORS), sends=st.booleans())
    def floor_gives(self, name: str, to: str, *, sends: bool) -> None:
        """It crashes between its record and the message unless `sends`."""
        floor = self.floors[name]
        if name == to or not floor.serves:
            return
        before = floor.remembered or Berth(floor=name)
        given = HandOver(origin=name, floor=to, epoch=before.epoch + 1)
        after = next_berth(before, given)
        assert isinstance(after, Berth)
        if floor.swap(after) and sends:
            self.to_robot.append((name, self.boot, given))

    @precondition(lambda self: self.to_robot)
    @rule(data=st.data())
    def robot_hears(self, data: st.DataObject) -> None:
        self.delivered(*data.draw(st.sampled_from(self.to_robot)))

    def delivered(self, name: str, boot: int, given: HandOver | None) -> None:
        """Let the robot hear of a goal (None), or that it is handed over."""
        if (name, boot) != (self.robot.floor, self.boot):
            return
        if given is None:  # a goal: nobody else may send it anywhere now
            assert [floor.name for floor in self.floors.values() if floor.holds] in ([name], [])
            return
        after = next_berth(self.robot, given)
        if isinstance(after, Berth) and after != self.robot:
            self.robot = after
            self.boot += 1

    @rule(to=st.sampled_from(FLOORS))
    def ride(self, to: str) -> None:
        """Ride undisturbed: what was said on floors long ago may still arrive after it."""
        floor = self.floors[self.robot.floor]
        floor.remembered = floor.stored
        self.robot_speaks()
        self.hears(floor, self.robot)
        self.hears(floor, self.robot)
        self.floor_gives(floor.name, to, sends=True)
        if self.to_robot:
            self.delivered(*self.to_robot[-1])
        self.robot_speaks()
        self.hears(self.floors[self.robot.floor], self.robot)

    @rule()
    def robot_restarts(self) -> None:
        self.boot += 1

    @rule(name=st.sampled_from(FLOORS))
    def planner_restarts(self, name: str) -> None:
        self.floors[name].remembered, self.floors[name].said = self.floors[name].stored, None

    @rule(name=st.sampled_from(FLOORS), epochs=st.sampled_from([None, 0, 1, 2]))
    def other_copy(self, name: str, epochs: int | None) -> None:
        """A copy that was cut off acts by something older than what is stored."""
        floor = self.floors[name]
        if floor.stored is not None and (epochs is None or epochs < floor.stored.epoch):
            floor.remembered = None if epochs is None else Berth(floor=name, epoch=epochs)

    @invariant()
    def at_most_one_floor_has_it(self) -> None:
        assert sum(floor.holds for floor in self.floors.values()) <= 1

    @invariant()
    def the_robot_is_at_most_one_hand_over_behind(self) -> None:
        newest = max(floor.stored.epoch if floor.stored else 0 for floor in self.floors.values())
        assert newest in (self.robot.epoch - 1, self.robot.epoch, self.robot.epoch + 1)
        assert all(not floor.holds for floor in self.floors.values() if floor.name != self.robot.floor)

    def teardown(self) -> None:
        for each in self.floors.values():  # only a copy that has read what is stored leads at last
            each.remembered = each.stored
        for _ in range(4):
            floor = self.floors[self.robot.floor]
            self.hears(floor, self.robot)
            for message in list(self.to_robot):
                self.delivered(*message)
        assert [floor.name for floor in self.floors.values() if floor.holds] == [self.robot.floor]
        assert self.floors[self.robot.floor].serves


TestBuilding = Building.TestCase
TestBuilding.settings = settings(
    max_examples=int(os.environ.get("FOGNAV_HISTORIES", "150")), stateful_step_count=60, deadline=None
)

GIVEN = HandOver(origin="a", floor="b", epoch=3, lift="l1")
AFTER = Berth(floor="b", epoch=3, came_by=GIVEN)


def test_a_hand_over_is_taken_once_and_repeated_at_will() -> None:
    assert next_berth(Berth(floor="a", epoch=2), GIVEN) == AFTER
    assert next_berth(AFTER, GIVEN) == AFTER


@pytest.mark.parametrize(("floor", "epoch"), [("a", 1), ("a", 3), ("c", 2), ("b", 2)])
def test_a_hand_over_from_elsewhere_or_another_time_is_refused_by_name(floor: str, epoch: int) -> None:
    refused = next_berth(Berth(floor=floor, epoch=epoch), GIVEN)
    assert isinstance(refused, Reason)
    assert refused.code == "other_berth"
    assert f"is on {floor} by its hand-over {epoch}" in refused


@pytest.mark.parametrize(
    ("known", "said", "expected"),
    [
        (None, Berth(floor="b"), "here"),
        (None, AFTER, "arrives"),
        (Berth(floor="a", epoch=2, came_by=GIVEN), AFTER, "arrives"),
        (AFTER, AFTER, "here"),
        (Berth(floor="b", epoch=3), AFTER, "here"),
        (Berth(floor="a", epoch=4, came_by=GIVEN), AFTER, "leaves"),
        (Berth(floor="a", epoch=5), AFTER, "stale"),
        (Berth(floor="b", epoch=4), AFTER, "stale"),
        (Berth(floor="a", epoch=3), AFTER, "stale"),
        (None, Berth(floor="a"), "stale"),
    ],
    ids=str,
)
def test_a_floor_serves_a_robot_only_where_both_records_agree(known: Berth | None, said: Berth, expected: str) -> None:
    assert standing(known, said, "b") == expected
