"""Missions with stops on several floors: each stop once, on one floor, whatever fails; or an end that says why."""

from __future__ import annotations

import asyncio
import os
import random
from contextlib import asynccontextmanager, suppress
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import pytest
from manual_clock import ManualClock

from fog_contracts.handover import next_berth
from fog_contracts.messages import Berth, CommandReply, Place, PlanReply, Pose, Reason, RobotPose, RobotState
from fog_contracts.messages import RefusalCode as Code
from fog_contracts.site import LiftSite, Site
from fog_runtime.health import Health
from fog_runtime.http import ProblemError
from fog_runtime.stores.redis_connection import StoreError
from fog_supervisor.servers import Server, start_redis
from fognav_sim.lift import SimLift
from planner.core import PlannerCore
from planner.lifts.persistence import OnOtherFloorError, RidePersistence
from planner.lifts.riding import Riding
from planner.robot_operator import CommandError
from planner.stops import GoalPose, MissionBody, StopBody
from planner.store import Store
from planner.tours.api import Conditions, mission_order
from planner.undo import _undo

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator

    from fog_contracts.messages import HandOver, LiftRequest, PlanRequest
    from planner.stops import Order
    from planner.store import StoredGoal

pytestmark = pytest.mark.live
FLOORS = ("ground", "upstairs")
CABIN, WAIT = 9.0, 7.0
ROUNDS = 150
"""So many half seconds suffice for five stops and as many rides."""


class FailingStore(Store):
    """Fails as `building.fails` says: before a write, or after it, so that nobody knows whether it was done."""

    building: Building

    async def _swap(self, *arguments: Any, **options: Any) -> Any:
        if self.building.fails():
            raise StoreError("no write")
        done = await super()._swap(*arguments, **options)
        if self.building.fails():
            raise StoreError("no reply")
        return done


class SetClock(ManualClock):
    """The building's clock; its time of day may be wrong, and then it is not synchronized."""

    def __init__(self, building: ManualClock) -> None:
        super().__init__()
        self.building, self.ahead = building, 0.0

    def now(self) -> float:
        return self.building.now()

    def stamp(self) -> float:
        return self.now() + self.ahead


class Floor:
    """What rides need of a floor's planner, which may be started again with what is stored."""

    leads = True

    def __init__(self, building: Building, name: str, store: Store) -> None:
        self.building, self.name, self.store = building, name, store
        self.clock = SetClock(building.clock)
        lift = LiftSite(id="north", cabin=pose(CABIN), wait=pose(WAIT), floors=list(FLOORS))
        self.site = Site(id=name, lifts=[lift])
        self.places: dict[str, Place] | None = {"desk": Place(x=3.0, y=0.0)}
        self.operator: Any = SimpleNamespace(
            stopped_at=-1e9, heard=self.heard, fresh_state=self.fresh_state, hand_over=building.hand_over
        )

    async def start(self) -> None:
        self.core, self.poses = PlannerCore(), cast("dict[str, RobotPose]", {})
        self.missions = RidePersistence(
            self.core, self.store, cast("Any", self.clock), Health(), lambda change: change(), lambda _: None,
            lambda: self.clock.ahead == 0.0,
        )  # fmt: skip
        self.riding = Riding(cast("Any", self), self.site, cast("Any", self.building), cast("Any", self.clock))
        await self.missions.lead(-1, confirmed=True)

    def heard(self, robot: str) -> RobotState | None:
        berth = self.building.berth
        told = self.missions.said.get(robot, berth) == berth  # else all that it has heard is old
        return self.building.state() if berth.floor == self.name and self.building.talks and told else None

    def fresh_state(self, robot: str) -> RobotState:
        if (state := self.heard(robot)) is None:
            raise CommandError("robot r1 has published no state")
        return state

    def stamp(self) -> float:
        return self.clock.stamp()

    async def preview(self, request: PlanRequest, _asker: str) -> PlanReply:
        return PlanReply(length=abs(request.goal.x - request.start.x), cost=1.0)

    async def send(self, order: Order) -> StoredGoal:
        return await self.missions.earlier_result(order.attempt) or await self.missions.send(order)

    async def order(self, *stops: StopBody, **options: Any) -> None:
        body, conditions = MissionBody(stops=list(stops), **options), Conditions("anna", None, None)
        await self.send(await mission_order(cast("Any", self), "r1", body, self.places or {}, conditions, 0.25))

    async def step(self) -> None:
        """Do what its loops do."""
        self.riding._on_lift({"lift": "north"}, self.building.lift.state(self.building.clock.now()))
        await self.riding.step()
        try:
            if self.missions._reload:
                await self.missions.lead(-1, confirmed=True)
            await self.missions._end_reached()
        except StoreError:
            self.missions._reload = True


class Building:
    """Two floors, a lift, and a robot that is at each goal as soon as it hears of it."""

    def __init__(self) -> None:
        self.clock = ManualClock(1000.0)
        self.lift = SimLift(FLOORS, self.clock.now())
        self.berth, self.at = Berth(floor="ground"), 1.0
        self.told: list[tuple[str, float, str]] = []
        """Its goals: floor, x and id."""
        self.knows, self.carries, self.talks, self.stuck = list(FLOORS), True, True, False
        self.deaf, self.period = False, 0.5
        self.chance, self.rng = 0.0, random.Random(0)

    def fails(self) -> bool:
        return self.rng.random() < self.chance

    def publish(self, _channel: object, asked: LiftRequest, **_ids: str) -> None:
        """Pass a request to the lift, or lose it."""
        if not self.fails():
            self.lift.ask(asked, self.clock.now())

    async def hand_over(self, _robot: str, given: HandOver) -> CommandReply:
        if self.fails() or self.deaf:
            raise CommandError("it was not heard")
        if self.berth.floor != given.origin:  # its agent ends, to start again there
            return CommandReply.refused(Reason(Code.OTHER_RUN, "the robot starts again on another floor"))
        after = next_berth(self.berth, given)
        if isinstance(after, Berth):
            self.berth, self.at = after, CABIN
        if self.fails():
            raise CommandError("its reply was not heard")
        return CommandReply.refused(after) if isinstance(after, Reason) else CommandReply(accepted=True, reason="")

    @property
    def here(self) -> Floor:
        return self.floors[self.berth.floor]

    @property
    def stops(self) -> list[tuple[str, float]]:
        """Where it was, but for the lift; a goal that it has heard of twice counts once."""
        return [(floor, x) for floor, x, _ in dict.fromkeys(self.told) if x not in {CABIN, WAIT}]

    def state(self) -> RobotState:
        return RobotState(
            mode="NORMAL", reasons=[], enabled=True, battery=None, map_epoch=0, map_seq=0, plan_id=None, goal_id=None,
            berth=self.berth, floors=self.knows, carries_missions=self.carries,
        )  # fmt: skip

    def robot(self) -> None:
        """Let it hear of its goal, drive there, and say so."""
        floor = self.here
        goal = floor.core.missions.goal("r1")
        if goal is not None and goal.pose is not None:
            self.told.append((floor.name, goal.pose.x, goal.goal_id))
            self.at = self.at if self.stuck else goal.pose.x
        floor.riding.on_state("r1", self.state())
        if floor.missions.is_here("r1"):
            floor.poses["r1"] = RobotPose(
                x=self.at, y=0.0, theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.2, height=0.3, stamp=0.0
            )
        if goal is not None and not self.stuck:
            floor.core.missions.reach("r1", goal.goal_id)
            for robot, goal_id in floor.core.missions.pop_reached():
                floor.missions.end(robot, goal_id)

    async def go_on(self, rounds: int = ROUNDS, until: Any = lambda: False) -> None:
        for _ in range(rounds):
            self.clock.advance(self.period)
            self.robot()
            if until():
                return
            for floor in self.floors.values():
                await floor.step()

    async def stored(self) -> list[str]:
        """Return the floors that have a mission of it."""
        return [name for name, floor in self.floors.items() if await floor.store.goals()]


def pose(x: float) -> Pose:
    return Pose(x=x, y=0.0, theta=0.0)


def stop(floor: str, x: float) -> StopBody:
    return StopBody(floor=floor, pose=GoalPose(x=x, y=0.0, theta=0.0))


UP, UP_AGAIN, DOWN = stop("upstairs", 4.0), stop("upstairs", 5.0), stop("ground", 2.0)
DESK = StopBody(floor="upstairs", place="desk")


@pytest.fixture(scope="module")
def redis(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with start_redis(tmp_path_factory.mktemp("redis")) as server:
        yield server


@asynccontextmanager
async def opened(redis: Server, name: str) -> AsyncIterator[Building]:
    building = Building()
    async with FailingStore(redis.url, f"ground-{name}") as ground, FailingStore(redis.url, f"up-{name}") as upstairs:
        building.floors = {
            each: Floor(building, each, store) for each, store in zip(FLOORS, (ground, upstairs), strict=True)
        }
        for floor in building.floors.values():
            floor.store.building = building  # type: ignore[attr-defined]  # a failing one
            await floor.start()
        building.robot()
        yield building


@pytest.fixture
async def building(redis: Server, request: pytest.FixtureRequest) -> AsyncIterator[Building]:
    async with opened(redis, str(abs(hash(request.node.name)))) as made:
        yield made


@pytest.mark.parametrize("seed", range(int(os.environ.get("FOGNAV_HISTORIES", "25"))))
async def test_every_stop_is_reached_once_in_order_whatever_is_lost_or_started_again(redis: Server, seed: int) -> None:
    rng = random.Random(seed)
    wanted = [(rng.choice(FLOORS), 1.0 + number) for number in range(1 + seed % 5)]
    async with opened(redis, f"history-{seed}") as building:
        await building.floors["ground"].order(*(stop(*each) for each in wanted))
        building.chance, building.rng = 0.15, rng
        for _ in range(ROUNDS):
            building.clock.advance(0.5)
            floor = building.floors[rng.choice(FLOORS)]
            match rng.randrange(8):
                case 0:
                    building.chance, before = 0.0, building.chance  # it starts once its store answers
                    await floor.start()
                    building.chance = before
                case 1 | 2 | 3:
                    building.robot()
                case _:
                    await floor.step()
        building.chance = 0.0
        await building.go_on()
        assert building.stops == wanted
        floors_of = {goal: {floor for floor, _, other in building.told if other == goal} for *_, goal in building.told}
        assert all(len(floors) == 1 for floors in floors_of.values()), "no goal is given on two floors"
        assert (await building.stored(), building.lift.session) == ([], "")


async def test_lift_keeps_a_robot_that_has_come_until_its_floor_can_take_it_in(
    building: Building, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def away(*_: object) -> None:
        raise StoreError("no store")

    await building.floors["ground"].order(UP)
    with monkeypatch.context() as patched:
        patched.setattr(building.floors["upstairs"].missions, "arrive", away)
        await building.go_on(until=lambda: building.berth.floor == "upstairs")
        await building.go_on(20)
        assert building.lift.session != ""
    await building.go_on()
    assert (building.stops, building.lift.session) == ([("upstairs", 4.0)], "")


@pytest.mark.parametrize(("goals", "stuck"), [*((goals, False) for goals in range(1, 8)), (4, True)])
async def test_mission_that_is_cancelled_ends_wherever_the_robot_is_then_and_does_not_come_back(
    building: Building, goals: int, *, stuck: bool
) -> None:
    await building.floors["ground"].order(DOWN, DESK, UP_AGAIN, StopBody(place="desk"))
    await building.go_on(until=lambda: len(dict.fromkeys(building.told)) >= goals - 1)
    building.stuck = stuck
    await building.go_on(until=lambda: len(dict.fromkeys(building.told)) == goals)
    assert await building.here.missions.cancel("r1", "anna")
    told = building.told[-1]
    for floor in building.floors.values():
        await floor.start()
        await floor.step()  # before it hears of the robot
    building.talks = False
    if not building.here.missions.berths:
        with suppress(OnOtherFloorError):  # a lift that stands there for it may have brought it
            assert not await building.here.riding.cancel("r1", "anna")
    building.talks = True
    await building.go_on()
    assert building.here.missions.is_here("r1")
    assert (building.told[-1], await building.stored()) == (told, [])
    assert (building.lift.session == "") == (building.at != CABIN), "it is held for a robot that is in it"


@pytest.mark.parametrize("moment", ["not yet told", "between", "comes", "in the lift"])
async def test_mission_that_is_cancelled_between_two_floors_ends_outside_the_lift_and_no_restart_takes_it_up(
    building: Building, moment: str
) -> None:
    ground, upstairs = building.floors.values()
    await ground.order(DESK, UP, DOWN)
    building.deaf = True
    await building.go_on(until=lambda: "r1" in ground.missions.berths)
    building.deaf, floor = False, ground if moment == "not yet told" else upstairs
    if moment != "not yet told":
        await ground.step()
        building.talks = moment != "between"
    await upstairs.step()
    if building.talks and floor is upstairs:
        building.robot()
    if moment == "in the lift":
        await upstairs.step()
        assert "mission from ground" in floor.riding.waits("r1")
    assert await floor.riding.cancel("r1", "anna")
    assert not await floor.riding.cancel("r2", "anna")
    entry = (await floor.store.audit(limit=1)).entries[0]
    assert (entry.id, entry.action, entry.who) == ("r1", "cancel", "anna")
    for each in building.floors.values():
        await each.start()
    building.talks = True
    await building.go_on()
    assert building.told[-1][:2] == ("upstairs", WAIT)
    assert (building.stops, await building.stored(), building.lift.session) == ([], [], "")


@pytest.mark.parametrize("told", [True, False])
async def test_cancellation_that_the_robot_does_not_accept_is_refused_each_time_and_its_mission_goes_on(
    building: Building, monkeypatch: pytest.MonkeyPatch, *, told: bool
) -> None:
    ground = building.floors["ground"]

    async def in_fault(*_: object) -> CommandReply:
        assert not await asyncio.wait_for(ground.riding.cancel("r2", "anna"), 1.0), "it waits for no other robot"
        return CommandReply.refused(Reason(Code.FAULT_LATCHED, "the robot is in FAULT"))

    await ground.order(DESK, UP, DOWN)
    building.deaf = True
    await building.go_on(until=lambda: "r1" in ground.missions.berths)
    building.deaf = False
    if told:
        await ground.step()
    with monkeypatch.context() as patched:
        patched.setattr(ground.operator, "heard", lambda _: building.state())  # its last word, some seconds long
        if not told:
            patched.setattr(ground.operator, "hand_over", in_fault)
        for _ in range(2):
            with pytest.raises(OnOtherFloorError, match=r"cancel it there, or try again here, .*: the robot"):
                await ground.riding.cancel("r1", "anna")
    assert "cancel" not in {entry.action for entry in (await ground.store.audit(limit=9)).entries}
    await building.go_on()
    assert building.stops == [("upstairs", 3.0), ("upstairs", 4.0), ("ground", 2.0)]


@pytest.mark.parametrize("stops", [[DESK, DOWN], [UP, DESK, DOWN]], ids=["the first stop there", "a later one"])
@pytest.mark.parametrize("told", ["desk", "others", "never"])
async def test_mission_to_a_place_waits_until_the_places_are_known_and_says_so(
    building: Building, caplog: Any, stops: list[StopBody], told: str
) -> None:
    caplog.set_level("WARNING")
    upstairs = building.floors["upstairs"]
    upstairs.places, known = None, upstairs.places
    await building.floors["ground"].order(*stops)
    await building.go_on(until=lambda: "goes to desk once" in upstairs.riding.waits("r1"))
    await building.go_on(20)
    assert (len(building.stops), caplog.messages) == (len(stops) - 2, [])
    assert "60 s at most" in upstairs.riding.waits("r1")
    if told != "never":
        upstairs.places = known if told == "desk" else {}
    else:
        building.period = 2.5
    await building.go_on(until=lambda: "r1" not in upstairs.riding._waits)
    await building.go_on()
    if told == "desk":
        assert building.stops[-2:] == [("upstairs", 3.0), ("ground", 2.0)]
    else:
        assert (len(building.stops), await building.stored()) == (len(stops) - 2, [])
        assert caplog.messages == ["ride_without_goal" if stops[0] is DESK else "mission_given_up"]
    assert upstairs.riding.waits("r1") == ""


@pytest.mark.parametrize(
    ("stops", "left_at", "logged"),
    [
        ([StopBody(floor="upstairs", place="attic"), UP], ("ground", CABIN), "ride_without_goal"),
        ([UP, StopBody(floor="upstairs", place="attic"), DOWN], ("upstairs", 4.0), "mission_given_up"),
        ([UP, StopBody(floor="cellar", place="desk"), DOWN], ("upstairs", 4.0), "mission_given_up"),
    ],
    ids=["the first stop there", "a later one", "no lift leads on"],
)
async def test_mission_ends_with_the_stop_that_the_other_floor_refuses_and_its_log_says_so(
    building: Building, caplog: Any, stops: list[StopBody], left_at: tuple[str, float], logged: str
) -> None:
    caplog.set_level("WARNING")  # another test may have set another one
    building.knows.append("cellar")
    await building.floors["ground"].order(*stops)
    await building.go_on()
    assert (building.told[-1][:2], caplog.messages) == (left_at, [logged])
    assert (building.berth.floor, await building.stored()) == ("upstairs", [])


async def test_deadline_that_passes_in_the_lift_ends_the_mission_upstairs_once_the_time_of_day_is_known_there(
    building: Building,
) -> None:
    upstairs = building.floors["upstairs"]
    upstairs.clock.ahead = 1e6
    await building.floors["ground"].order(UP, UP_AGAIN, deadline_s=60.0)
    await building.go_on(until=lambda: building.berth.floor == "upstairs")
    building.clock.advance(60.0)
    await building.go_on(until=lambda: bool(building.stops))
    assert building.stops == [("upstairs", 4.0)], "nobody knows there that it has passed"
    upstairs.clock.ahead = 0.0
    await building.go_on(4)
    assert (building.stops, await building.stored()) == ([("upstairs", 4.0)], [])
    assert (await upstairs.store.audit(limit=1)).entries[0].action == "deadline"


async def test_mission_that_is_given_again_by_an_undo_ends_at_its_deadline_by_a_clock_that_nobody_sets(
    building: Building,
) -> None:
    ground = building.floors["ground"]
    ground.clock.ahead = 1e6
    await ground.order(DOWN, stop("ground", 3.0), deadline_s=60.0)
    await building.go_on(until=lambda: ("ground", 2.0) in building.stops)
    building.stuck = True
    await building.go_on(3)
    stored = ground.missions.goals["r1"]
    assert stored.tour is not None
    assert stored.tour.leg > 0
    await ground.missions.cancel("r1", "anna")
    await _undo(cast("Any", ground), "r1", stored, None, "anna")
    await building.go_on(150)
    assert (await building.stored(), (await ground.store.audit(limit=1)).entries[0].action) == ([], "deadline")


async def test_robot_that_can_take_no_mission_along_any_more_is_not_sent_into_the_lift(building: Building) -> None:
    await building.floors["ground"].order(UP)
    building.carries = False
    await building.go_on()
    assert [told[:2] for told in dict.fromkeys(building.told)] == [("ground", WAIT)]
    assert (await building.stored(), building.here.missions.berths, building.lift.session) == ([], {}, "")


async def test_robot_that_lost_its_record_leaves_again_once_it_is_put_back_and_no_floor_tells_it_what_is_long_done(
    building: Building,
) -> None:
    ground, upstairs = building.floors.values()
    await ground.order(UP, DOWN)
    await building.go_on(until=lambda: ("ground", 2.0) in building.stops)
    await building.go_on(4)
    building.berth = Berth(floor="ground")
    building.robot()
    assert await ground.missions.put_back("r1", "anna")
    await ground.order(UP)
    await building.go_on()
    assert (building.berth.floor, upstairs.missions.standing("r1")) == ("upstairs", "stale"), "not sent back"
    assert await upstairs.missions.put_back("r1", "anna")
    await upstairs.order(UP_AGAIN, stop("ground", 3.0))
    await building.go_on()
    assert building.stops == [("upstairs", 4.0), ("ground", 2.0), ("upstairs", 5.0), ("ground", 3.0)]
    assert (await building.stored(), building.lift.session) == ([], "")


@pytest.mark.parametrize(
    ("body", "robot", "code", "field", "words"),
    [
        ({"stops": [DOWN, StopBody(floor="attic", place="desk")]}, {}, "floor_unknown", "body.stops.1.floor",
         "robot r1 does not know attic; it knows: ground, upstairs"),
        ({"stops": [UP]}, {"knows": []}, "floor_unknown", "body.stops.0.floor", "it knows: this floor only"),
        ({"stops": [UP]}, {"carries": False}, "robot_outdated", "body.stops.0.floor", "bring its software to this"),
        ({"stops": [StopBody(floor="cellar", place="desk")]}, {"knows": ["cellar"]}, "no_lift", "body.stops.0.floor",
         "no lift of ground leads to cellar; lifts lead to: upstairs"),
        ({"stops": [StopBody(floor="upstairs")]}, {}, "request_invalid", "body.stops.0", "either a place or a pose"),
        ({"stops": [DOWN, UP], "order": "best"}, {}, "request_invalid", "body.order", "of this floor only: order them"),
    ],
)  # fmt: skip
async def test_order_that_the_robot_or_this_floor_can_not_carry_out_is_refused_with_the_remedy(
    building: Building, body: dict[str, Any], robot: dict[str, Any], code: str, field: str, words: str
) -> None:
    vars(building).update(robot)
    with pytest.raises(ProblemError, match=words) as refused:
        await building.floors["ground"].order(*body.pop("stops"), **body)
    assert (refused.value.code.value, [error["field"] for error in refused.value.errors]) == (code, [field])


async def test_order_to_another_floor_waits_for_a_robot_that_is_heard_and_one_on_this_floor_does_not(
    building: Building,
) -> None:
    building.talks = False
    with pytest.raises(CommandError, match="has published no state"):
        await building.floors["ground"].order(DOWN, UP)
    await building.floors["ground"].order(DOWN)
    assert await building.stored() == ["ground"]
