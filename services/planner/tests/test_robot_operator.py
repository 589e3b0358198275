"""Operators' commands to robots over REST: who may give them, what the robot checks, and what is recorded."""

from __future__ import annotations

from collections import Counter
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import httpx
import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from manual_clock import ManualClock

from fog_contracts import channels as ch
from fog_contracts.commands import CommandGate
from fog_contracts.handlers import Moment
from fog_contracts.messages import (
    CommandReply,
    Place,
    PlaceSet,
    Reason,
    ReasonCode,
    RefusalCode,
    RobotCommand,
    RobotState,
)
from fog_runtime.health import Health
from fog_runtime.http import Tokens
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.token_file import TokenEntry, token_hash
from planner.api import make_api
from planner.core import PlannerCore
from planner.robot_operator import OTHERS, PERIOD_S, REMEMBERED_S, SENDERS, CommandError, DoubledRobots, StopRecords
from planner.service import Service

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

KEY = b"k" * 32
OPERATOR = {"Authorization": "Bearer operator-token"}
VIEWER = {"Authorization": "Bearer viewer-token"}
SITE = cast("Any", SimpleNamespace(
    robots=[SimpleNamespace(id="r1", start=None, dock=None)],
    places={"dock": Place(x=1.0, y=2.0, theta=0.5), "b": Place(x=1.0, y=2.0, theta=None)},
))  # fmt: skip


class Robot:
    """A session with one robot that checks commands as an agent does, and a store that records them."""

    def __init__(self) -> None:
        self.gate = CommandGate("r1", KEY, "run-1")
        self.clock = ManualClock(100.0)
        self.received: list[RobotCommand] = []
        self.records: list[tuple[str, str, bytes]] = []
        self.stops: list[tuple[str, str, dict[str, Any]]] = []
        self.answers = True
        self.refusal: Reason | None = None
        self.store_error: Exception | None = None
        self.published: dict[ch.Channel, Any] = {}

    def subscribe(self, channel: ch.Channel, _kind: type, handler: Any, **_ids: str) -> None:
        self.published[channel] = handler

    def serve(self, *_: object, **__: str) -> None: ...

    async def query(self, _channel: ch.Channel, command: RobotCommand, *_: object, **__: str) -> CommandReply | None:
        if not self.answers:
            return None
        self.received.append(command)
        refusal = self.gate.refusal(command, self.clock.now()) or self.refusal
        if refusal is not None:
            return CommandReply.refused(refusal)
        return CommandReply(accepted=True, reason=f"{command.kind} is done")

    async def record_command(self, robot: str, command: bytes, audit: Any) -> None:
        if self.store_error:
            raise self.store_error
        self.records.append((robot, audit.who, command))

    async def record_stop(self, robot: str, stop: bytes, audit: Any) -> None:
        if self.store_error:
            raise self.store_error
        self.stops.append((robot, audit.who, msgspec.json.decode(stop)))

    def state(self, mode: Any = "INIT", *, enabled: bool = False) -> None:
        state = RobotState(
            mode=mode, reasons=[], enabled=enabled, battery=None, goal_id=None, map_epoch=1, map_seq=1, plan_id=None,
            boot="run-1", clock=self.clock.now(),
        )  # fmt: skip
        self.published[ch.ROBOT_STATE]({"robot": "r1"}, state)


class Rig:
    def __init__(self, *, key: bytes | None = KEY) -> None:
        self.robot = Robot()
        session = cast("Any", self.robot)
        self.core = PlannerCore(epoch=1)
        service = Service(self.core, session, session, self.robot.clock, Health(), key=key)
        service.subscribe()
        self.operator = service.operator
        tokens = Tokens([
            TokenEntry(name=role, role=cast("Any", role), sha256=token_hash(f"{role}-token"))
            for role in ("operator", "viewer")
        ])  # fmt: skip
        self.standby = ""
        app = make_api(service, SITE, Health(), tokens, lambda: self.standby)
        self.client = httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://planner")

    async def command(self, body: object, headers: dict[str, str] | None = None) -> httpx.Response:
        return await self.client.post("/api/v1/robots/r1/commands", json=body, headers=headers or OPERATOR)


@pytest.fixture
async def rig() -> AsyncIterator[Rig]:
    rig = Rig()
    rig.robot.state()
    async with rig.client:
        yield rig


@pytest.mark.parametrize("kind", ["enable", "reset", "egress"])
async def test_operator_without_a_key_commands_a_robot_and_is_recorded(rig: Rig, kind: str) -> None:
    answer = await rig.command({"kind": kind})
    assert answer.json() == {"accepted": True, "reason": f"{kind} is done", "mode": "INIT"}
    (command,) = rig.robot.received
    assert (command.kind, command.operator) == (kind, "operator")
    assert rig.robot.records == [("r1", "operator", f'{{"kind":"{kind}"}}'.encode())]
    assert (await rig.command({"kind": kind})).status_code == 200
    assert rig.robot.received[1].nonce != command.nonce


async def test_initial_pose_is_a_pose_or_a_place_with_a_heading(rig: Rig) -> None:
    assert (await rig.command({"kind": "initial_pose", "place": "dock"})).status_code == 200
    assert rig.robot.received[0].pose is not None
    assert rig.robot.received[0].pose.theta == 0.5
    pose = {"x": 3.0, "y": 4.0, "theta": 0.0}
    assert (await rig.command({"kind": "initial_pose", "pose": pose})).status_code == 200
    assert b'"pose":{"x":3.0' in rig.robot.records[1][2]
    for body in ({}, {"pose": pose, "place": "dock"}, {"place": "b"}, {"pose": {"x": 1.0, "y": 2.0}}):
        assert (await rig.command({"kind": "initial_pose", **body})).status_code == 422
    assert (await rig.command({"kind": "enable", "pose": pose})).status_code == 422
    assert len(rig.robot.received) == 2


async def test_places_are_those_that_the_map_service_tells_as_soon_as_it_has(rig: Rig) -> None:
    moved = {"b": Place(x=3.0, y=2.0, theta=1.0)}
    assert (await rig.command({"kind": "initial_pose", "place": "b"})).status_code == 422
    rig.core.handlers()[ch.PLACES]({}, PlaceSet(epoch=1, places=moved), Moment(1.0, 1.0))
    assert (await rig.command({"kind": "initial_pose", "place": "b"})).status_code == 200
    assert (rig.robot.received[-1].pose.x, rig.robot.received[-1].pose.theta) == (3.0, 1.0)
    removed = await rig.command({"kind": "initial_pose", "place": "dock"})
    assert (removed.status_code, removed.json()["type"]) == (422, "urn:fognav:no_place")


async def test_robots_refusal_is_a_problem_with_its_reason_identifiers_and_mode(rig: Rig) -> None:
    sentence = "the cause is still there: the bumper is pressed"
    rig.robot.refusal = Reason(RefusalCode.CAUSE_REMAINS, sentence, [ReasonCode.BUMPER])
    rig.robot.state("FAULT")
    answer = await rig.command({"kind": "reset"})
    assert (answer.status_code, answer.headers["content-type"]) == (409, "application/problem+json")
    assert (answer.json()["type"], answer.json()["detail"]) == ("urn:fognav:command_refused", sentence)
    assert (answer.json()["refusal"], answer.json()["causes"]) == ("cause_remains", ["bumper"])
    assert answer.json()["mode"] == "FAULT"


async def test_only_operators_command_and_only_known_robots(rig: Rig) -> None:
    assert (await rig.command({"kind": "enable"}, VIEWER)).status_code == 403
    assert (await rig.client.post("/api/v1/robots/r1/commands", json={"kind": "enable"})).status_code == 401
    assert (await rig.client.post("/api/v1/robots/r9/stop")).status_code == 404
    assert (await rig.command({"kind": "dance"})).status_code == 422
    assert rig.robot.received == []


async def test_anybody_stops_a_robot_whatever_else_is_missing(rig: Rig) -> None:
    rig.robot.store_error = StoreError("Redis is away")
    rig.standby = "another planner leads"
    rig.operator.overruled = {}.__getitem__  # a visit that can't be ended
    answer = await rig.client.post("/api/v1/robots/r1/stop")
    assert answer.status_code == 200
    assert [(c.kind, c.signature) for c in rig.robot.received] == [("disable", b"")]
    assert rig.robot.received[0].operator.startswith("stop from ")
    rig.robot.clock.advance(60.0)
    assert (await rig.client.post("/api/v1/robots/r1/stop")).status_code == 200


async def test_flood_of_stops_without_a_token_stops_each_time_and_fills_no_audit_trail(rig: Rig) -> None:
    for _ in range(300):
        assert (await rig.client.post("/api/v1/robots/r1/stop")).status_code == 200
    assert len(rig.robot.received) == 300
    assert rig.robot.records == [], "operators' commands have a trail of their own"
    assert [stop[2] for stop in rig.robot.stops] == [{"kind": "disable"}]
    rig.robot.clock.advance(600.0)
    rig.robot.store_error = StoreError("Redis is away")
    await rig.operator.record_repeated_stops()
    rig.robot.store_error = None
    await rig.operator.record_repeated_stops()
    await rig.operator.record_repeated_stops()
    sender = rig.robot.received[0].operator
    assert rig.robot.stops[1:] == [("r1", sender, {"kind": "disable", "repeats": {sender: 299}, "period_s": 600.0})]


async def test_each_stop_of_an_operator_is_an_entry_but_of_a_robot_that_it_has_stopped_already(rig: Rig) -> None:
    for _ in range(3):
        for token in (OPERATOR, VIEWER, {"Authorization": "Bearer nobody's"}, OPERATOR | {"Fognav-Part": "vda5050"}):
            assert (await rig.client.post("/api/v1/robots/r1/stop", headers=token)).status_code == 200
    assert len(rig.robot.received) == 12, "each of them stops it"
    senders = [sender.partition(" from ")[0] for _, sender, _ in rig.robot.stops]
    assert senders == ["operator", "viewer", "stop", "operator/vda5050"]
    rig.robot.state("NORMAL", enabled=True)
    assert (await rig.client.post("/api/v1/robots/r1/stop", headers=OPERATOR)).status_code == 200
    assert [sender for _, sender, _ in rig.robot.stops[4:]] == ["operator"]
    rig.robot.clock.advance(PERIOD_S)
    await rig.operator.record_repeated_stops()
    repeats = rig.robot.stops[-1][2]["repeats"]
    assert (repeats["operator"], repeats["operator/vda5050"]) == (2, 2)


async def test_part_of_a_program_is_recorded_behind_its_tokens_name_and_one_that_is_no_word_is_refused(
    rig: Rig,
) -> None:
    assert (await rig.command({"kind": "enable"}, OPERATOR | {"Fognav-Part": "ros2"})).status_code == 200
    assert [who for _, who, _ in rig.robot.records] == ["operator/ros2"]
    refused = await rig.command({"kind": "enable"}, OPERATOR | {"Fognav-Part": "somebody else"})
    assert (refused.status_code, "Fognav-Part" in refused.json()["detail"]) == (422, True)


async def test_stop_that_could_not_be_recorded_is_told_of_later(rig: Rig) -> None:
    rig.robot.store_error = StoreError("Redis is away")
    assert (await rig.client.post("/api/v1/robots/r1/stop")).status_code == 200
    rig.robot.store_error = None
    rig.robot.clock.advance(600.0)
    await rig.operator.record_repeated_stops()
    assert [stop[2]["repeats"] for stop in rig.robot.stops] == [{rig.robot.received[0].operator: 1}]


async def test_command_that_can_not_be_recorded_or_is_not_the_leaders_is_not_sent(rig: Rig) -> None:
    rig.robot.store_error = StoreError("Redis is away")
    assert (await rig.command({"kind": "enable"})).status_code == 503
    rig.robot.store_error, rig.standby = None, "another planner leads"
    assert (await rig.command({"kind": "enable"})).status_code == 503
    assert rig.robot.received == []


async def test_silent_robot_is_named_with_a_remedy(rig: Rig) -> None:
    rig.robot.answers = False
    answer = await rig.command({"kind": "enable"})
    assert answer.status_code == 504
    assert "did not answer within 2 s" in answer.json()["detail"]
    rig.robot.clock.advance(3.1)
    assert "has published no state for 3 s" in (await rig.command({"kind": "enable"})).json()["detail"]


async def test_planner_without_a_key_says_so_and_still_stops() -> None:
    rig = Rig(key=None)
    rig.robot.state()
    answer = await rig.command({"kind": "enable"})
    assert (answer.status_code, rig.robot.received) == (504, [])
    assert "FOGNAV_OPERATOR_KEY_FILE" in answer.json()["detail"]
    assert (await rig.command({"kind": "disable"})).status_code == 200
    assert rig.robot.records == [("r1", "operator", b'{"kind":"disable"}')]


async def test_stop_of_all_robots_does_not_wait_for_the_store_to_end_missions(rig: Rig) -> None:
    stopped_before: list[int] = []

    async def cancel(_robot: str, _who: str) -> None:
        stopped_before.append(len(rig.robot.received))

    missions = cast("Any", SimpleNamespace(goals={"r1": None, "r2": None}, cancel=cancel))
    await rig.operator.stop_all(missions, "map-change")
    assert ([command.kind for command in rig.robot.received], stopped_before) == (["disable"], [1, 1])


async def test_goal_of_an_id_that_two_agents_use_is_refused_until_one_is_gone(rig: Rig) -> None:
    state = msgspec.structs.replace(rig.operator._states["r1"][0])
    for number in range(6):
        boot = f"run-{number % 2}"
        rig.robot.published[ch.ROBOT_STATE]({"robot": "r1"}, msgspec.structs.replace(state, boot=boot))
    answer = await rig.client.put("/api/v1/robots/r1/goal", json={"place": "b"}, headers=OPERATOR)
    assert (answer.status_code, answer.json()["type"]) == (409, "urn:fognav:robot_doubled")
    assert rig.operator.doubled_detail() == "two agents use the id of r1"
    rig.robot.clock.advance(10.1)
    assert not rig.operator.is_doubled("r1")


async def test_watching_a_robot_waits_for_its_next_state(rig: Rig) -> None:
    view = (await rig.client.get("/api/v1/robots/r1", headers=VIEWER)).json()
    assert (view["id"], view["state"]["clock"]) == ("r1", 100.0)
    assert (await rig.operator.next_state("r1", 99.0)).clock == 100.0
    rig.robot.clock.advance(1.0)
    waiting = rig.client.get("/api/v1/robots/r1?after=100.0", headers=VIEWER)
    rig.robot.state("NORMAL")
    assert (await waiting).json()["state"]["mode"] == "NORMAL"
    with pytest.raises(CommandError, match="no state for 3 s"):
        await rig.operator.next_state("r1", 101.0)


def test_two_agents_of_one_id_are_found_until_one_is_switched_off():
    robots = DoubledRobots()
    finds = [robots.on_state("r1", "ab"[number % 2], 0.5 * number) for number in range(10)]
    assert (finds.count(True), finds.index(True)) == (1, 4), "a, b, a, b, a"
    assert robots.found(5.0) == ["r1"]
    assert not robots.is_doubled("r2", 5.0)
    now = 5.0
    while robots.is_doubled("r1", now):
        robots.on_state("r1", "a", now)
        now += 1.0
        assert now <= 5.0 + REMEMBERED_S + 1.0, "the agent that was switched off is not forgotten"
    robots.on_state("r1", "b", now)
    assert not robots.is_doubled("r1", now), "the other one came back, alone"


@given(runs=st.lists(st.lists(st.floats(0.05, 5.0), min_size=1, max_size=20), max_size=12), late=st.integers(0, 20))
def test_agent_that_is_restarted_ever_so_often_is_one_robot_though_a_state_comes_late(runs, late):
    robots, now = DoubledRobots(), 0.0
    for number, pauses in enumerate(runs):
        for index, pause in enumerate(pauses):
            now += pause
            robots.on_state("r1", f"run-{number}", now)
            if number > 0 and (number, index) == (late, 0):
                robots.on_state("r1", f"run-{number - 1}", now)
    assert robots.found(now) == []


def test_agent_that_does_not_tell_its_run_is_not_judged():
    robots = DoubledRobots()
    assert not any(robots.on_state("r1", "", now * 0.5) for now in range(20))


def test_first_stops_of_some_senders_are_recorded_alone_and_all_else_is_counted():
    records = StopRecords()
    alone = [records.count("r1", f"s{n}", 0.0) for n in range(SENDERS + 2)]
    assert alone == [True] * SENDERS + [False, False]
    assert not records.count("r1", "s0", 1.0)
    assert records.count("r2", "s0", 1.0), "another robot's stops are another matter"
    assert records.due(PERIOD_S - 0.1) == {}
    assert records.due(PERIOD_S) == {"r1": {OTHERS: 2, "s0": 1}}


def test_sender_who_goes_on_gets_no_entry_of_its_own_again_and_one_who_returns_does():
    records = StopRecords()
    for sender in ("flood", "once", "flood"):
        records.count("r1", sender, 0.0)
    records.recorded("r1", records.due(PERIOD_S)["r1"], PERIOD_S)
    assert not records.count("r1", "flood", PERIOD_S + 1.0)
    assert records.count("r1", "once", PERIOD_S + 1.0)


STOPS = st.lists(
    st.tuples(st.floats(0.0, 400.0), st.sampled_from(["r1", "r2"]), st.integers(0, 7), st.integers(1, 50)), max_size=60
)


@given(STOPS)
def test_every_stop_is_recorded_or_counted_once_in_few_entries(stops):
    records, entries, sent, told = StopRecords(), Counter(), 0, 0
    now = 0.0

    def record() -> None:
        nonlocal told
        for robot, repeats in records.due(now).items():
            entries[robot] += 1
            told += sum(repeats.values())
            records.recorded(robot, repeats, now)

    for pause, robot, sender, repetitions in stops:
        now += pause
        record()
        for _ in range(repetitions):
            sent += 1
            if records.count(robot, f"s{sender}", now):
                entries[robot] += 1
                told += 1
    periods = now / PERIOD_S + 1.0
    assert max(entries.values(), default=0) <= (SENDERS + 1) * periods
    now += PERIOD_S + 1.0
    record()
    assert told == sent
    now += PERIOD_S + 1.0
    record()
    assert records.due(now) == {}
