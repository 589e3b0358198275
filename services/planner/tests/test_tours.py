"""Missions with several stops: their order, their rules, and that they go on where they were, whatever is restarted."""

from __future__ import annotations

import asyncio
import itertools
import math
import random
import secrets
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast
from unittest.mock import Mock

import pytest
from hypothesis import given
from hypothesis import strategies as st
from manual_clock import ManualClock

from fog_contracts.messages import (
    OutOfService,
    Place,
    PlanReply,
    PlanRequest,
    Pose,
    Refusal,
    RobotGoal,
    RobotPath,
    Stop,
    Tour,
    WhenCut,
)
from fog_runtime.health import Health
from fog_runtime.http import ProblemError
from fog_runtime.stores.redis_store import Audit
from fog_supervisor.servers import start_redis
from planner.core import PlannerCore
from planner.stops import (
    CUT_S,
    CutTimes,
    GoalPose,
    MissionBody,
    Order,
    StopBody,
    act_on_cut,
    best_order,
    leg_aside,
    next_leg,
)
from planner.store import OutOfServiceError, Store, StoredGoal
from planner.tours.api import Conditions, mission_answer, mission_order
from planner.tours.persistence import MissionPersistence

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

costs = st.one_of(st.floats(0.0, 100.0), st.just(math.inf))


@given(st.data())
def test_best_order_is_that_of_all_orders_with_the_fewest_closed_ways_and_the_least_cost(data):
    count = data.draw(st.integers(1, 5))
    first = data.draw(st.lists(costs, min_size=count, max_size=count))
    between = [data.draw(st.lists(costs, min_size=count, max_size=count)) for _ in range(count)]

    def rank(order):
        steps = [first[order[0]], *(between[a][b] for a, b in itertools.pairwise(order))]
        return sum(map(math.isinf, steps)), sum(step for step in steps if not math.isinf(step))

    found = best_order(first, between)
    assert sorted(found) == list(range(count))
    best = min(rank(order) for order in itertools.permutations(range(count)))
    assert rank(found) == (best[0], pytest.approx(best[1]))


def test_way_that_is_cut_for_a_moment_ends_nothing_and_each_policy_does_what_it_says():
    here, there = (1.0, 1.0), (5.0, 1.0)

    def act(when_cut, seconds, reachable=here, **tour):
        return act_on_cut(Tour(id="t", when_cut=when_cut, **tour), reachable, seconds, seconds)

    assert act(WhenCut(do="cancel"), CUT_S - 0.1) == "wait"
    assert act(WhenCut(do="cancel"), CUT_S) == "cancel"
    assert act(WhenCut(), 1e6) == "wait"
    assert [act(WhenCut(limit_s=60.0), s) for s in (59.0, 60.0)] == ["wait", "cancel"]
    assert act(WhenCut(do="nearest"), CUT_S) == "nearest"
    aside = Stop(pose=Pose(x=0.0, y=0.0, theta=0.0))
    assert act(WhenCut(do="nearest"), CUT_S - 0.1, aside=aside) == "wait", "it drives there already"
    assert act(WhenCut(do="nearest"), CUT_S, aside=aside) == "on", "no way leads there, either"
    assert act(WhenCut(do="nearest"), 9.0, here, nearest=here) == "wait", "it is there"
    assert act(WhenCut(do="nearest"), 9.0, there, nearest=here) == "nearest"


def test_limit_counts_every_refusal_and_goes_on_over_trips_aside_and_moments_in_which_the_way_is_open():
    stop, times = Stop(pose=Pose(x=5.0, y=0.0, theta=0.0)), CutTimes()
    on_the_way = Tour(id="t")
    _, aside = leg_aside(on_the_way, stop, (3.0, 0.0))
    _, again = next_leg(aside, stop)
    assert times.see(on_the_way, "start_closed", 0.0) == (0.0, 0.0)
    assert times.see(on_the_way, "goal_near_wall", 9.0) == (0.0, 9.0), "the rule is about ways that are cut"
    assert times.see(on_the_way, "cut_off", 10.0) == (0.0, 10.0)
    assert times.see(on_the_way, None, 12.0) == (0.0, 12.0), "it flickers"
    assert times.see(on_the_way, "cut_off", 12.0 + CUT_S - 0.1)[1] == 12.0 + CUT_S - 0.1
    assert times.see(aside, None, 30.0) == (0.0, 30.0)
    assert times.see(aside, "search_too_long", 40.0) == (0.0, 40.0)
    assert times.see(aside, "search_too_long", 44.0) == (4.0, 44.0), "no way leads aside, whatever the reason"
    assert times.see(aside, "start_closed", 45.0) == (0.0, 45.0), "from there none leads anywhere"
    assert times.see(again, "cut_by_places", 50.0) == (0.0, 50.0)
    assert [times.see(again, None, 60.0), times.see(again, None, 60.0 + CUT_S)] == [(0.0, 60.0), (0.0, 0.0)]
    assert times.see(again, "cut_off", 70.0) == (0.0, 0.0)
    assert times.see(Tour(id="t", leg=3, reached=(stop,)), "cut_off", 80.0) == (0.0, 0.0), "another stop"


# --- in Redis ---


class Running:
    """The missions of a planner that leads; `refused` is what its robot's path says."""

    def __init__(self, store: Store, clock: ManualClock, synchronized: Callable[[], bool] = lambda: True) -> None:
        self.core = PlannerCore()
        self.refused: Refusal | None = None
        self.missions = MissionPersistence(
            self.core, store, cast("Any", clock), Health(), lambda change: change(), self.path, synchronized
        )

    def path(self, robot: str) -> RobotPath | None:
        stored = self.missions.goals.get(robot)
        return None if stored is None else RobotPath(
            plan_id=1, planner_epoch=1, goal_id=stored.goal.goal_id, points=[], map_epoch=1, map_seq=1,
            released_length=0.0, refusal=self.refused,
        )  # fmt: skip

    @property
    def at(self) -> float | None:
        """Where the robot is sent to (x); None without a mission."""
        goal = self.core.missions.goal("r1")
        return None if goal is None or goal.pose is None else goal.pose.x

    async def start(self) -> Running:
        await self.missions.lead(-1, confirmed=True)
        return self

    def reach(self, robot: str = "r1") -> None:
        """The robot says that it has reached its goal."""
        goal = self.core.missions.goal(robot)
        if goal is not None:
            self.core.missions.reach(robot, goal.goal_id)
            for each, goal_id in self.core.missions.pop_reached():
                self.missions.end(each, goal_id)

    async def step(self) -> None:
        await self.missions._end_reached()


def order(*stops: float, **tour: Any) -> Order:
    first, *ahead = (Stop(pose=Pose(x=x, y=0.0, theta=0.0)) for x in stops)
    return Order(
        "r1", first.pose, "anna", action="mission", tour=Tour(id=secrets.token_hex(8), ahead=tuple(ahead), **tour)
    )


@pytest.fixture
def redis(tmp_path: Path):
    with start_redis(tmp_path) as server:
        yield server


class Story:
    """What may happen to one robot's missions, in any order, and where it must be sent then: the model."""

    def __init__(self, store: Store, running: Running, clock: ManualClock) -> None:
        self.store, self.running, self.clock = store, running, clock
        self.left: list[float] = []
        self.said = False
        """Whether the robot has reached the first of them, and the next is not stored yet."""
        self.out = False
        self.number = 0

    @property
    def over(self) -> bool:
        """Whether the robot is at its last stop, so that nothing is left to cancel."""
        return self.said and len(self.left) == 1

    async def order(self) -> None:
        self.number += 1
        stops = [float(self.number) + n / 10.0 for n in range(1 + self.number % 4)]
        if self.out:
            with pytest.raises(OutOfServiceError):
                await self.running.missions.send(order(*stops))
        else:
            await self.running.missions.send(order(*stops))
            self.left, self.said = stops, False

    async def reach(self) -> None:
        if self.left and not self.said:
            self.running.reach()
            self.said = True

    async def step(self) -> None:
        await self.running.step()
        self.left, self.said = (self.left[1:], False) if self.said else (self.left, False)

    async def restart(self) -> None:
        self.running = await Running(self.store, self.clock).start()
        self.said = False  # the robot says so again

    async def cancel(self) -> None:
        had = bool(self.left) and not self.over
        assert await self.running.missions.cancel("r1", "anna") == had
        if had:
            self.left, self.said = [], False

    async def take_out(self) -> None:
        self.number += 1
        record = OutOfService(id=f"{self.number}", reason="worn wheel", by="anna", since=1.0)
        await self.running.missions.take_out("r1", record, "anna")
        self.out = True
        if not self.over:
            self.left, self.said = [], False

    async def put_back(self) -> None:
        await self.running.missions.put_back("r1", "anna")
        self.out = False

    async def check(self) -> None:
        if not self.said:
            assert self.running.at == (self.left[0] if self.left else None)
            assert set(await self.store.goals()) == ({"r1"} if self.left else set())


@pytest.mark.live
async def test_robot_has_one_mission_and_visits_its_stops_in_order_whatever_is_ordered_reached_or_restarted(redis):
    rng, clock = random.Random(11), ManualClock(100.0)
    async with Store(redis.url, "test") as store:
        story = Story(store, await Running(store, clock).start(), clock)
        acts = [story.order, *2 * [story.reach], *2 * [story.step], story.restart, story.cancel]
        acts += [story.take_out, story.put_back]
        for _ in range(200):
            await rng.choice(acts)()
            await story.check()


@pytest.mark.live
async def test_mission_that_is_reached_while_somebody_ends_it_is_ended_and_nothing_else_is_lost(redis, monkeypatch):
    clock = ManualClock(100.0)
    async with Store(redis.url, "test") as store:
        running = await Running(store, clock).start()
        delete = store.delete

        async def reached_meanwhile(*arguments: Any) -> None:
            running.reach()
            await delete(*arguments)

        monkeypatch.setattr(store, "delete", reached_meanwhile)
        await running.missions.send(order(5.0))
        assert await running.missions.cancel("r1", "anna")
        await running.missions.send(order(5.0))
        out = OutOfService(id="1", reason="worn wheel", by="anna", since=1.0)
        assert await running.missions.take_out("r1", out, "anna")
        assert (running.missions.out_of_service("r1"), running.at) == (out, None)
        await running.missions.put_back("r1", "anna")
        await running.missions.send(order(5.0, deadline=clock.stamp() + 60.0))
        clock.advance(61.0)
        for _ in range(2):  # what was reached before is deleted first
            await running.step()
        assert (running.at, await store.goals()) == (None, {})


@pytest.mark.live
async def test_mission_that_is_reached_does_not_come_back_with_a_reload_that_began_before(redis, monkeypatch):
    async with Store(redis.url, "test") as store:
        running = await Running(store, ManualClock(100.0)).start()
        await running.missions.send(order(5.0))
        running.reach()
        read = store.out_of_service

        async def slow() -> dict[str, OutOfService]:
            for _ in range(100):
                await asyncio.sleep(0.001)
            return await read()

        monkeypatch.setattr(store, "out_of_service", slow)
        running.missions._reload = True
        await asyncio.gather(running.missions.cancel("r2", "anna"), running.step())
        assert (running.missions.goals, await store.goals()) == ({}, {})


@pytest.mark.live
async def test_mission_whose_way_is_cut_waits_ends_or_goes_to_the_nearest_point_and_on_from_there(redis):
    clock = ManualClock(100.0)
    cut = Refusal(code=208, kind="cut_by_places", reason="hazard n3", nearest=(3.0, 0.0))

    async def after(running: Running, seconds: float) -> float | None:
        await running.step()
        clock.advance(seconds)
        await running.step()
        return running.at

    async with Store(redis.url, "test") as store:
        running = await Running(store, clock).start()
        for policy, at in ((WhenCut(), 5.0), (WhenCut(do="cancel"), None), (WhenCut(limit_s=30.0), None)):
            running.refused = None
            await running.missions.send(order(5.0, 9.0, when_cut=policy))
            assert await after(running, 60.0) == 5.0
            running.refused = cut
            assert await after(running, 60.0) == at
        await running.missions.send(order(5.0, 9.0, when_cut=WhenCut(do="nearest")))
        assert await after(running, 5.0) == 3.0
        view = mission_answer("r1", running.missions.goals["r1"]).value
        assert (view.aside, [stop.state for stop in view.stops]) == ((3.0, 0.0), ["present", "ahead"])
        running = await Running(store, clock).start()
        running.reach()
        await running.step()
        assert running.at == 5.0, "from the nearest point to the stop itself"
        running.refused = cut
        assert await after(running, 60.0) == 5.0, "it is at the nearest point, and waits"
        running.refused = None
        running.reach()
        await running.step()
        assert running.at == 9.0
        await running.missions.send(order(5.0, deadline=clock.stamp() + 60.0))
        assert await after(running, 59.0) == 5.0
        assert await after(running, 2.0) is None
        assert [entry.action for entry in (await store.audit(limit=2)).entries] == ["deadline", "mission"]


@pytest.mark.live
async def test_robot_whose_way_to_the_nearest_point_is_cut_goes_on_to_its_stop_till_the_limit_ends_the_mission(redis):
    clock = ManualClock(100.0)
    async with Store(redis.url, "test") as store:
        running = await Running(store, clock).start()
        await running.missions.send(order(5.0, when_cut=WhenCut(do="nearest", limit_s=60.0)))
        seen = []
        for nearest in (3.0, 3.0, 3.0, 1.0):
            running.refused = Refusal(code=208, kind="cut_by_places", reason="hazard n3", nearest=(nearest, 0.0))
            await running.step()
            clock.advance(10.0)
            await running.step()
            seen.append(running.at)
        assert seen == [3.0, 5.0, 5.0, 1.0], "it goes nowhere twice in vain"
        running.refused = None
        clock.advance(19.0)
        await running.step()
        assert running.at == 1.0
        clock.advance(2.0)
        await running.step()
        assert running.at is None
        assert (await store.audit(limit=1)).entries[0].action == "cut"


class SteppedClock(ManualClock):
    """A clock whose time of day somebody sets."""

    ahead = 0.0

    def stamp(self) -> float:
        return self.now() + self.ahead


@pytest.mark.live
async def test_deadline_passes_by_the_monotonic_clock_and_after_a_restart_by_a_time_of_day_that_is_known(redis):
    clock, known = SteppedClock(100.0), [False]
    async with Store(redis.url, "test") as store:

        async def at_after(running: Running, seconds: float) -> float | None:
            clock.advance(seconds)
            await running.step()
            return running.at

        running = await Running(store, clock, lambda: known[0]).start()
        for stepped in (0.0, 1e6, -1e6):
            await running.missions.send(order(5.0, deadline=clock.stamp() + 60.0))
            clock.ahead += stepped
            assert [await at_after(running, 59.0), await at_after(running, 2.0)] == [5.0, None]
        await running.missions.send(order(5.0, deadline=clock.stamp() + 60.0))
        clock.ahead += 1e6
        running = await Running(store, clock, lambda: known[0]).start()
        assert await at_after(running, 1.0) == 5.0, "a machine that has booted without a clock"
        clock.ahead -= 1e6
        known[0] = True
        assert [await at_after(running, 57.0), await at_after(running, 3.0)] == [5.0, None]


@pytest.mark.live
async def test_stop_that_is_reached_while_another_robots_is_being_stored_is_not_the_end_of_its_mission(redis):
    async with Store(redis.url, "test") as store:
        running = await Running(store, ManualClock(100.0)).start()
        for robot, *stops in (("r1", 1.0, 2.0, 3.0), ("r2", 4.0, 5.0, 6.0)):
            await running.missions.send(order(*stops)._replace(robot=robot))
        put = store.put

        async def reached_meanwhile(*arguments: Any, **options: Any) -> Any:
            running.reach("r2")
            return await put(*arguments, **options)

        store.put = reached_meanwhile  # type: ignore[method-assign]  # the moment of the write
        running.reach()
        await running.step()
        store.put = put  # type: ignore[method-assign]  # as before
        await running.step()
        kept = {robot: [stop.pose.x for stop in mission.tour.ahead] for robot, mission in (await store.goals()).items()}
        assert kept == {"r1": [3.0], "r2": [6.0]}


@pytest.mark.live
async def test_robot_stays_out_of_service_while_the_time_of_day_may_be_wrong_and_comes_back_when_its_time_is_over(
    redis,
):
    clock, known = SteppedClock(100.0), [False]
    out = OutOfService(id="a", reason="wheel off", by="anna", since=clock.stamp(), until=clock.stamp() + 3600.0)
    async with Store(redis.url, "test") as store:
        running = await Running(store, clock).start()
        await running.missions.take_out("r1", out, "anna")
        clock.ahead += 7200.0
        assert running.missions.out_of_service("r1") == out, "the clock was set, and no hour has passed"
        running = await Running(store, clock, lambda: known[0]).start()
        assert running.missions.out_of_service("r1") == out, "nobody knows the time after the restart"
        clock.ahead -= 7200.0
        known[0] = True
        assert running.missions.out_of_service("r1") == out
        clock.advance(3601.0)
        assert running.missions.out_of_service("r1") is None


@pytest.mark.live
async def test_mission_that_is_ordered_and_reached_while_another_goes_on_is_over_after_a_restart(redis):
    clock = ManualClock(100.0)
    async with Store(redis.url, "test") as store:
        running = await Running(store, clock).start()
        await running.missions.send(order(5.0, 9.0))
        running.reach()
        async with running.missions._lock:  # a store that is slow
            going_on = asyncio.ensure_future(running.step())
            await asyncio.sleep(0)
            newer = StoredGoal(goal=RobotGoal(goal_id="new", pose=Pose(x=1.0, y=0.0, theta=0.0), stamp=clock.stamp()))
            await store.put("r1", newer, Audit(clock.stamp(), "anna", "goal"))
            running.missions._begin("r1", newer)
            running.reach()
        await going_on
        await running.step()
        assert await store.goals() == {}


# --- orders ---


class Planner:
    """Plans straight ways at (x, 0); beyond x = 100 is a wall, at x = 50 a hazard that ends."""

    def __init__(self, localized: bool = True) -> None:  # noqa: FBT001, FBT002  # because it is the only thing to say
        self.poses: dict[str, Any] = {"r1": SimpleNamespace(x=10.0, y=0.0, theta=0.0, localized=localized)}
        self.planned = 0
        self.riding = SimpleNamespace(floor="ground", check=Mock(), first_leg=lambda _robot, stop, *_: (stop, None))

    async def preview(self, request: PlanRequest, asker: str) -> PlanReply:
        assert asker == "person anna"
        self.planned += 1
        if request.goal.x > 100.0:
            return PlanReply(refusal=Refusal(code=206, kind="goal_in_wall", reason="in a wall", nearest=(99.0, 0.0)))
        if 50.0 in (request.goal.x, request.start.x):
            return PlanReply(refusal=Refusal(code=208, kind="cut_by_places", reason="hazard n3", nearest=(49.0, 0.0)))
        length = abs(request.goal.x - request.start.x)
        return PlanReply(length=length, cost=length * 50.0)

    def stamp(self) -> float:
        return 1000.0


def ordered(planner: Planner, *xs: float, **options: Any) -> list[float]:
    body = MissionBody(stops=[StopBody(pose=GoalPose(x=x, y=0.0)) for x in xs], **options)
    conditions = Conditions("anna", None, None)
    places = {"lab": Place(x=1.0, y=0.0)}
    made = asyncio.run(mission_order(cast("Any", planner), "r1", body, places, conditions, 0.25))
    assert made.tour is not None
    return [made.pose.x, *(stop.pose.x for stop in made.tour.ahead)]


def test_stops_come_in_the_order_given_or_in_the_best_one_from_where_the_robot_is():
    assert ordered(Planner(), 30.0, 5.0, 20.0) == [30.0, 5.0, 20.0]
    assert ordered(Planner(), 30.0, 5.0, 20.0, order="best") == [5.0, 20.0, 30.0]
    assert ordered(Planner(), 50.0, 5.0, 20.0, order="best") == [5.0, 20.0, 50.0], "what is cut off now comes last"


@pytest.mark.parametrize(
    ("xs", "options", "code", "field", "words"),
    [
        ((5.0, 101.0), {}, "goal_refused", "body.stops.1", "in a wall"),
        ((5.0, 50.0), {"when_cut": WhenCut(do="cancel")}, "goal_refused", "body.stops.1", "hazard n3"),
        (
            (30.0, 10.0),
            {"deadline_s": 100.0},
            "deadline_too_soon",
            "body.deadline_s",
            "some 160 s, more than its",
        ),
        (tuple(map(float, range(9))), {"order": "best"}, "request_invalid", "body.order", "give 8 at most"),
    ],
)
def test_mission_that_cannot_be_carried_out_is_refused_with_its_code_and_the_stop(xs, options, code, field, words):
    with pytest.raises(ProblemError, match=words) as refused:
        ordered(Planner(), *xs, **options)
    assert refused.value.code.value == code
    assert [error["field"] for error in refused.value.errors] == [field]


def test_best_order_needs_to_know_where_the_robot_is_and_a_given_one_does_not():
    with pytest.raises(ProblemError, match="not known where robot r1 is"):
        ordered(Planner(localized=False), 5.0, 9.0, order="best")
    assert ordered(Planner(localized=False), 5.0, 9.0) == [5.0, 9.0]
