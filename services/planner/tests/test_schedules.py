"""Missions that begin by the clock: once in each window, whatever is restarted; and where idle robots go."""

from __future__ import annotations

import asyncio
import itertools
from datetime import datetime
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast
from unittest.mock import Mock
from zoneinfo import ZoneInfo

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from manual_clock import ManualClock

from fog_contracts.messages import (
    WEEKDAYS,
    CommandReply,
    OutOfService,
    Place,
    PlanReply,
    PlanRequest,
    Pose,
    Refusal,
    RobotPose,
    RobotState,
    WeeklySchedule,
    WeeklyTime,
)
from fog_contracts.site import IdleSite, RobotSite, Site, VisitorsSite
from fog_contracts.weekly import Windows
from fog_runtime.health import Health
from fog_runtime.stores.redis_connection import StoreRefusedError
from fog_supervisor.servers import start_redis
from planner.core import PlannerCore
from planner.schedules.occasions import LONGEST_PAUSE_S, IdleTimes, due
from planner.schedules.persistence import SchedulePersistence
from planner.schedules.scheduling import RETRY_S, Scheduling
from planner.stops import MissionBody, Occasion, Order, ScheduledMission, StopBody
from planner.store import Store, StoredGoal
from planner.visiting import Visiting

if TYPE_CHECKING:
    from pathlib import Path

LISBON = "Europe/Lisbon"
EIGHT = datetime(2026, 11, 23, 8, 0, tzinfo=ZoneInfo(LISBON)).timestamp()  # a Monday
DAY, HOUR = 86_400.0, 3600.0


def scheduled(name: str = "post", robot: str = "r1", stop: str = "lab", **fields: Any) -> ScheduledMission:
    """Return a mission that begins between eight and nine from Monday to Friday, written on the Sunday before."""
    days = fields.pop("days", ["mon", "tue", "wed", "thu", "fri"])
    weekly = WeeklySchedule(time_zone=LISBON, times=[WeeklyTime(days=days, begin="08:00", end="09:00")])
    mission = MissionBody(stops=[StopBody(place=stop)], priority=fields.pop("priority", 0))
    filled = {"author": "anna", "since": EIGHT - DAY, "version": f"{name}-1", **fields}
    return ScheduledMission(id=name, robot=robot, mission=mission, weekly=weekly, **filled)


@given(st.lists(st.floats(0.5, 5 * HOUR), min_size=1, max_size=100), st.integers(0, 5))
def test_each_window_that_begins_after_it_was_written_is_given_once_or_missed_once(steps, written):
    schedule = scheduled(since=EIGHT - HOUR / 2 + written * HOUR / 3)
    windows, stamp, done = Windows(schedule.weekly), EIGHT - HOUR, []
    for step in steps:
        stamp += step
        if (now := due(schedule, windows, stamp)) is not None:
            assert now.window.begin <= stamp
            assert now.over == (stamp >= now.window.begin + HOUR)
            done.append(now.window.begin)
            last = Occasion(begin=now.window.begin, at=stamp, outcome="missed" if now.over else "given")
            schedule = scheduled(since=schedule.since, last=last)
    assert done == sorted(set(done)), "none twice, none of the past"
    if max(steps) < DAY:
        first = EIGHT if schedule.since <= EIGHT else EIGHT + DAY
        expected = [first + day * DAY for day in range(5) if first + day * DAY <= min(stamp, EIGHT + 4 * DAY)]
        assert done[: len(expected)] == expected, "each of the week's windows was seen, because the steps are short"


def test_clock_that_was_ahead_for_a_while_keeps_no_mission_from_its_time():
    windows = Windows(scheduled().weekly)
    ahead = Occasion(begin=EIGHT + DAY, at=EIGHT + DAY + 60.0, outcome="given")
    assert due(scheduled(last=ahead), windows, EIGHT + 10.0) is not None, "what tomorrow's clock gave is no excuse"
    assert due(scheduled(last=ahead), windows, EIGHT + DAY + 90.0) is None
    back = Occasion(begin=EIGHT, at=EIGHT + 40.0, outcome="given")
    assert due(scheduled(last=back), windows, EIGHT + 1.0) is None, "a small step back gives nothing twice"


def test_small_step_back_of_the_clock_makes_no_given_mission_a_missed_one():
    given = Occasion(begin=EIGHT + DAY, at=EIGHT + DAY + 5.0, outcome="given")
    windows = Windows(scheduled().weekly)
    assert due(scheduled(last=given), windows, EIGHT + DAY - 300.0) is None


def test_schedule_without_a_gap_has_no_window_that_begins():
    times = [WeeklyTime(days=list(WEEKDAYS), begin=a, end=b) for a, b in (("06:00", "18:00"), ("18:00", "06:00"))]
    weekly = WeeklySchedule(time_zone=LISBON, times=times)
    schedule = msgspec.structs.replace(scheduled(since=EIGHT - 30 * DAY), weekly=weekly)
    for days in range(20):  # the windows are computed anew now and then
        assert due(schedule, Windows(weekly), EIGHT + days * DAY) is None


@pytest.mark.parametrize("since", [0.0, EIGHT + DAY])
async def test_schedule_that_was_written_by_a_wrong_clock_counts_from_when_the_time_is_known(fog, since):
    await fog.add(scheduled(since=since))
    await fog.pass_time(10.0)
    assert fog.missions.schedules["post"].since == EIGHT - 4.0
    assert fog.goal == "lab"


def test_disabled_schedule_and_other_days_are_not_due():
    windows = Windows(scheduled().weekly)
    assert due(scheduled(enabled=False), windows, EIGHT + 1.0) is None
    assert due(scheduled(), windows, EIGHT - 1.0) is None
    assert due(scheduled(since=EIGHT + 1.0), windows, EIGHT + 2.0) is None, "written within the window: the next counts"


# --- with Redis, and a planner's service around it ---


class Fog:
    """What scheduled missions need of a planner that leads; its robots say what a test lets them say."""

    leads = True

    def __init__(self, store: Store, clock: ManualClock, site: Site) -> None:
        self.clock = clock
        self.core = PlannerCore()
        self.missions = SchedulePersistence(
            self.core, store, cast("Any", clock), Health(), lambda change: change(), lambda _: None
        )
        self.states: dict[str, RobotState] = {"r1": state()}
        self.poses: dict[str, RobotPose] = {"r1": pose(1.0)}
        self.commands: list[tuple[str, str]] = []
        self.operator: Any = SimpleNamespace(
            heard=self.states.get, is_doubled=lambda _: False, overruled=None, send=self._command
        )
        self.refusal: Refusal | None = None
        self.riding = SimpleNamespace(floor="fog", check=Mock(), first_leg=lambda _robot, stop, *_: (stop, None))
        self.synchronized = True
        self.places: dict[str, Place] = site.places
        self.visiting = Visiting(cast("Any", self), site, cast("Any", clock))
        self.scheduling = Scheduling(cast("Any", self), site, cast("Any", clock), lambda: self.synchronized)

    async def _command(self, kind: str, robot: str, _who: str) -> CommandReply:
        self.commands.append((kind, robot))
        return CommandReply(accepted=True, reason="")

    def path(self, _robot: str) -> None:
        return None

    def stamp(self) -> float:
        return self.clock.stamp()

    async def preview(self, request: PlanRequest, _asker: str) -> PlanReply:
        if self.refusal is not None:
            return PlanReply(refusal=self.refusal)
        length = abs(request.goal.x - request.start.x)
        return PlanReply(points=[], length=length, cost=length)

    async def send(self, order: Order) -> StoredGoal | Refusal:
        return await self.missions.send(order)

    async def start(self) -> Fog:
        await self.missions.lead(-1, confirmed=True)
        return self

    async def add(self, schedule: ScheduledMission) -> None:
        assert await self.missions.put_schedule(schedule.id, schedule, "anna", "put", expected="0") == "ok"

    async def pass_time(self, seconds: float, step: float = 1.0) -> None:
        """Let time pass."""
        for _ in range(round(seconds / step)):
            self.clock.advance(step)
            await self.scheduling.step()

    def last(self, name: str = "post") -> Occasion | None:
        return self.missions.schedules[name].last

    @property
    def goal(self) -> str | None:
        """The place that the robot is sent to."""
        stored = self.missions.goals.get("r1")
        return None if stored is None else stored.goal.place


def state(**fields: Any) -> RobotState:
    filled = {"mode": "NORMAL", "reasons": [], "enabled": True, "battery": 1.0, "goal_id": None, **fields}
    return RobotState(map_epoch=1, map_seq=1, plan_id=None, **filled)


def pose(x: float) -> RobotPose:
    return RobotPose(
        x=x, y=0.0, theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.17, height=0.3, stamp=0.0, localized=True
    )  # fmt: skip


SITE = Site(id="f", places={"lab": Place(x=5.0, y=0.0, public=True), "home": Place(x=1.0, y=0.0, public=True)})


def robot(**fields: Any) -> RobotSite:
    return RobotSite(id="r1", start=Pose(x=1.0, y=0.0, theta=0.0), radius=0.17, **fields)


@pytest.fixture
async def store(tmp_path: Path):
    with start_redis(tmp_path) as redis:
        async with Store(redis.url, "f", service="planner") as opened:
            yield opened


@pytest.fixture
async def fog(store: Store) -> Fog:
    return await Fog(store, ManualClock(EIGHT - 5.0), SITE).start()


async def test_mission_begins_with_its_window_once_and_not_before_nor_while_the_time_is_unknown(fog):
    await fog.add(scheduled())
    await fog.pass_time(4.0)
    assert (fog.goal, fog.last()) == (None, None)
    assert fog.scheduling.following(fog.missions.schedules["post"]) == EIGHT
    fog.synchronized = False
    await fog.pass_time(10.0)
    assert (fog.goal, fog.last()) == (None, None)
    fog.synchronized = True
    await fog.pass_time(1.0)
    assert (fog.goal, fog.last().outcome, fog.last().begin) == ("lab", "given", EIGHT)
    assert fog.missions.goals["r1"].tour.id == fog.last().mission
    assert await fog.missions.cancel("r1", "anna")
    await fog.pass_time(30.0)
    assert fog.goal is None, "who cancels it is not overruled"
    assert fog.scheduling.following(fog.missions.schedules["post"]) == EIGHT + DAY


async def test_loop_has_its_turn_between_the_windows_of_two_schedules(fog):
    turns = []

    async def take_turns() -> None:
        while True:
            turns.append(len(fog.scheduling._windows))
            await asyncio.sleep(0)

    for number in range(5):
        await fog.add(scheduled(f"s{number}"))
    others = asyncio.create_task(take_turns())
    await fog.scheduling.step()
    others.cancel()
    assert set(turns) >= set(range(1, 5)), "not all at once"


async def test_busy_robot_finishes_first_and_what_waits_longest_for_it_is_told(fog):
    await fog.missions.send(Order("r1", Pose(x=3.0, y=0.0, theta=0.0), "bob", place="home"))
    await fog.add(scheduled())
    await fog.add(scheduled("urgent", stop="home", priority=5))
    await fog.pass_time(60.0)
    assert fog.goal == "home"
    waits = fog.scheduling.waits_for(fog.missions.schedules["post"])
    assert (waits, waits.code) == ("robot r1 has another mission", "robot_has_mission")
    await fog.missions.cancel("r1", "bob")
    await fog.pass_time(1.0)
    assert fog.last("urgent").outcome == "given"
    assert fog.last() is None, "one mission per robot"
    await fog.missions.cancel("r1", "bob")
    await fog.pass_time(1.0)
    assert (fog.goal, fog.last().outcome, fog.last().begin) == ("lab", "given", EIGHT)


@pytest.mark.parametrize(
    ("says", "reason", "code"),
    [
        (None, "not heard", "robot_not_heard"),
        (state(enabled=False), "can't drive now", "robot_cant_drive"),
        (state(mode="FAULT"), "can't drive now", "robot_cant_drive"),
        (state(mode="HOLD", reasons=["map too old"], codes=["map_old"]), "map too old", "map_old"),
        (state(mode="DEGRADED", codes=["map_late", "battery_low"]), "can't drive now", "battery_low"),
    ],
)
async def test_robot_that_can_t_drive_gets_nothing_and_a_missed_mission_says_why(fog, says, reason, code):
    await fog.add(scheduled())
    fog.states.clear()
    if says is not None:
        fog.states["r1"] = says
    await fog.pass_time(HOUR + 120.0, step=60.0)
    assert (fog.goal, fog.last().outcome) == (None, "missed")
    assert reason in fog.last().reason
    assert fog.last().code == code
    fog.states["r1"] = state()
    await fog.pass_time(60.0)
    assert fog.goal is None, "an hour later it is not done any more"


async def test_schedule_stays_however_long_the_reason_for_a_missed_mission_is(fog, store):
    await fog.add(scheduled())
    fog.states["r1"] = state(mode="HOLD", reasons=["too long " * 50] * 4, codes=["map_old"])
    await fog.pass_time(HOUR + 120.0, step=60.0)
    assert fog.last().outcome == "missed"
    again = await Fog(store, fog.clock, SITE).start()
    assert again.missions.schedules == fog.missions.schedules


async def test_mission_is_not_given_once_its_schedule_is_gone_or_its_robot_is_stopped_meanwhile(fog):
    preview = fog.preview
    await fog.add(scheduled())

    async def deleted_meanwhile(*arguments: Any) -> PlanReply:
        await fog.missions.put_schedule("post", None, "anna", "delete")
        return await preview(*arguments)

    fog.preview = deleted_meanwhile
    await fog.pass_time(10.0)
    assert (fog.goal, fog.missions.schedules) == (None, {})

    async def stopped_meanwhile(*arguments: Any) -> PlanReply:
        fog.states["r1"] = state(enabled=False)
        return await preview(*arguments)

    fog.preview = stopped_meanwhile
    await fog.add(scheduled("other"))
    await fog.pass_time(10.0)
    assert fog.goal is None


async def test_robot_out_of_service_gets_its_mission_only_within_the_window(fog):
    await fog.add(scheduled())
    await fog.missions.take_out("r1", OutOfService(id="1", reason="worn wheel", by="anna", since=1.0), "anna")
    await fog.pass_time(60.0)
    waits = fog.scheduling.waits_for(fog.missions.schedules["post"])
    assert ("worn wheel" in waits, waits.code) == (True, "out_of_service")
    await fog.missions.put_back("r1", "anna")
    await fog.pass_time(1.0)
    assert fog.goal == "lab"


async def test_goal_that_is_refused_is_tried_again_until_the_window_ends(fog):
    await fog.add(scheduled())
    fog.refusal = Refusal(kind="goal_in_wall", reason="in a wall", code=204)
    await fog.pass_time(60.0)
    assert fog.scheduling.waits_for(fog.missions.schedules["post"]) == "in a wall"
    fog.refusal = None
    await fog.pass_time(RETRY_S)
    assert fog.goal == "lab"


async def test_neither_a_restart_nor_a_lost_note_gives_a_mission_twice(fog, store, monkeypatch):
    await fog.add(scheduled())

    async def lost(*_arguments: object, **_more: object) -> None:
        raise StoreRefusedError("away")

    with monkeypatch.context() as context:
        context.setattr(store, "put_schedule", lost)
        await fog.pass_time(10.0)
    assert fog.goal == "lab"
    (given,) = [fog.missions.goals["r1"].goal.goal_id]
    again = await Fog(store, fog.clock, SITE).start()
    assert again.last() is None, "the store knows nothing of it"
    await again.missions.cancel("r1", "anna")
    await again.pass_time(2.0)
    assert (again.goal, again.last().outcome) == (None, "given"), "it was given before: noted, and not given again"
    assert given.startswith(again.last().mission)
    third = await Fog(store, fog.clock, SITE).start()
    await third.pass_time(5.0)
    assert third.goal is None


async def test_window_that_passed_while_no_planner_ran_is_missed_not_done_late(store):
    clock = ManualClock(EIGHT - 5.0)
    await (await Fog(store, clock, SITE).start()).add(scheduled())
    clock.advance(2 * HOUR)
    later = await Fog(store, clock, SITE).start()
    await later.pass_time(2.0)
    assert (later.goal, later.last().outcome) == (None, "missed")
    assert "did not run" in later.last().reason


async def test_change_of_another_operator_is_not_overwritten_by_the_note_of_a_window(fog):
    await fog.add(scheduled())
    changed = scheduled(version="post-2", enabled=False)
    put = fog.missions.put_schedule

    async def first_the_other(name: str, record: ScheduledMission, who: str, action: str, *, expected: str) -> str:
        await put(name, changed, "bob", "put")
        return await put(name, record, who, action, expected=expected)

    fog.missions.put_schedule = first_the_other
    await fog.pass_time(6.0)
    fog.missions.put_schedule = put
    await fog.pass_time(2.0)
    assert fog.missions.schedules["post"] == changed


# --- Idle robots ---


async def test_idle_robot_goes_home_after_its_time_and_is_there_for_the_next_mission(store):
    site = Site(id="f", places=SITE.places, robots=[robot(idle=IdleSite(go="home", after_s=60.0))])
    fog = await Fog(store, ManualClock(EIGHT - 200.0), site).start()
    fog.poses["r1"] = pose(9.0)
    await fog.pass_time(59.0)
    assert fog.goal is None
    await fog.pass_time(2.0)
    assert (fog.goal, fog.missions.goals["r1"].goal.idle) == ("home", True)
    await fog.add(scheduled())
    await fog.pass_time(200.0)
    assert fog.goal == "lab", "a scheduled mission does not wait until it is home"
    await fog.missions.cancel("r1", "anna")
    fog.poses["r1"] = pose(1.2)
    await fog.pass_time(300.0)
    assert fog.goal is None, "it is home"


async def test_visitor_gets_a_robot_that_only_drives_home_and_a_robot_that_waits_for_its_visitor_stays(store):
    home = robot(idle=IdleSite(go="home", after_s=60.0))
    site = Site(id="f", places=SITE.places, robots=[home], visitors=VisitorsSite(robots=["r1"]))
    fog = await Fog(store, ManualClock(EIGHT), site).start()
    fog.poses["r1"] = pose(9.0)
    await fog.pass_time(62.0)
    assert fog.missions.goals["r1"].goal.idle
    visits = fog.visiting.visits
    visits.ask("anna", "", ("lab", "home"), fog.visiting.places, fog.clock.now())
    fog.visiting.step()
    async with asyncio.timeout(5.0):
        while not fog.missions.goals["r1"].visit:  # noqa: ASYNC110  # the store's answer changes it
            await asyncio.sleep(0.01)
    assert fog.goal == "lab"
    arrived = state(goal_id=fog.missions.goals["r1"].goal.goal_id, goal_reached=True)
    fog.visiting.on_state("r1", arrived)
    fog.missions.end("r1", arrived.goal_id)
    await fog.pass_time(80.0)
    assert (fog.goal, visits.open[0].state) == (None, "ready"), "it waits for its visitor, and is not idle"


async def test_idle_robot_is_told_to_dock_and_left_alone_on_its_dock(store):
    docked = robot(idle=IdleSite(go="dock", after_s=60.0), dock=Pose(x=0.5, y=0.0, theta=0.0))
    fog = await Fog(store, ManualClock(EIGHT), Site(id="f", robots=[docked])).start()
    await fog.pass_time(62.0)
    assert fog.commands == [("dock", "r1")]
    fog.states["r1"] = state(mode="HOLD", reasons=["on its dock"], codes=["on_dock"], docked=True)
    await fog.pass_time(300.0)
    assert len(fog.commands) == 1
    fog.states["r1"] = state(enabled=False)
    await fog.pass_time(300.0)
    assert len(fog.commands) == 1, "who stops a robot wants it to stay"


def test_robot_whose_dock_is_barred_for_months_still_tries_every_hour():
    times, now = IdleTimes({"r1": 60.0}), 0.0
    times.is_due("r1", now, idle=True, afresh=False)
    for _ in range(2000):  # 80 days
        now += LONGEST_PAUSE_S
        assert times.is_due("r1", now, idle=True, afresh=False)


async def test_idle_robot_whose_dock_is_barred_tries_ever_more_seldom_until_somebody_has_used_it(store):
    docked = robot(idle=IdleSite(go="dock", after_s=60.0), dock=Pose(x=0.5, y=0.0, theta=0.0))
    fog = await Fog(store, ManualClock(EIGHT), Site(id="f", robots=[docked])).start()
    tried: list[float] = []

    async def barred(_kind: str, _robot: str, _who: str) -> CommandReply:
        tried.append(fog.clock.now())
        fog.states["r1"] = state(mode="DOCK")
        return CommandReply(accepted=True, reason="")

    fog.operator.send = barred
    for _ in range(2500):
        docks = fog.states["r1"].mode == "DOCK"
        await fog.pass_time(10.0, step=10.0)
        if docks:
            fog.states["r1"] = state()  # it has given up, where it was
    pauses = [after - before for before, after in itertools.pairwise(tried)]
    assert pauses == sorted(pauses)
    assert (pauses[0], pauses[-1]) == (pytest.approx(130.0, abs=20.0), pytest.approx(LONGEST_PAUSE_S + 10.0, abs=20.0))
    fog.states["r1"] = state(enabled=False)
    await fog.pass_time(10.0, step=10.0)
    fog.states["r1"], known = state(), len(tried)
    await fog.pass_time(80.0, step=10.0)
    assert len(tried) == known + 1, "whoever stopped it may have freed the dock"
