"""Visits over REST: what a guest may do and see, and how an operator's word, a stop or a restart ends a visit."""

from __future__ import annotations

import asyncio
from contextlib import suppress
from typing import TYPE_CHECKING, Any, cast
from unittest.mock import AsyncMock

import httpx
import pytest
from manual_clock import ManualClock

from fog_contracts import channels as ch
from fog_contracts.messages import Place, PlanReply, Pose, RobotGoal, RobotPose, RobotState
from fog_contracts.site import RobotSite, Site, VisitorsSite
from fog_runtime.health import Health
from fog_runtime.http import Tokens
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.token_file import TokenEntry, token_hash
from planner.api import make_api
from planner.core import PlannerCore
from planner.service import Service
from planner.store import StoredGoal
from planner.waits.persistence import Learned

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Callable

ROBOT = RobotSite(id="r1", start=Pose(x=0.0, y=0.0, theta=0.0), radius=0.17)
SITE = Site(
    id="test",
    robots=[ROBOT],
    places={
        "hall": Place(x=1.0, y=2.0, label="Hall", public=True),
        "lab": Place(x=5.0, y=2.0, theta=1.5, label="Lab", public=True),
        "office": Place(x=9.0, y=2.0, label="Office of the director"),
    },
    visitors=VisitorsSite(robots=["r1"]),
)
TOUR = {"start": "hall", "goal": "lab"}


class World:
    """Store, router and one robot of a planner that leads."""

    connected = True

    def __init__(self, stored: dict[str, StoredGoal] | None = None) -> None:
        self.stored = dict(stored or {})
        self.attempts: dict[object, StoredGoal] = {}
        self.records: list[tuple[str, str]] = []
        """Who did what to missions."""
        self.hear: dict[ch.Channel, Callable[..., None]] = {}
        self.service = Service(
            PlannerCore(epoch=1), cast("Any", self), cast("Any", self), ManualClock(100.0), Health(), site=SITE
        )
        self.service.subscribe()
        entries = [
            TokenEntry(name=name, role=cast("Any", role), sha256=token_hash(role))
            for name, role in (("hall tablet", "guest"), ("viewer", "viewer"), ("anna", "operator"))
        ]
        app = make_api(self.service, SITE, Health(), Tokens(entries))
        self.http = httpx.AsyncClient(transport=httpx.ASGITransport(app), base_url="http://planner")

    # --- the store ---

    epoch = 0

    async def goals(self) -> dict[str, StoredGoal]:
        return dict(self.stored)

    async def berths(self) -> dict[str, Any]:
        return {}

    async def out_of_service(self) -> dict[str, Any]:
        return {}

    async def schedules(self) -> dict[str, Any]:
        return {}

    async def learned(self) -> Learned:
        return Learned({}, {})

    async def put_learned(self, _learned: object) -> None: ...

    async def put_service(self, *_: object, **__: object) -> str:
        return "ok"

    async def earlier_result(self, attempt: object) -> StoredGoal | None:
        return self.attempts.get(attempt)

    async def put(self, robot: str, goal: StoredGoal, audit: Any, *, expected: str) -> str:
        has = self.stored.get(robot)
        if expected not in ("*", "0" if has is None else has.goal.goal_id):
            return "changed"
        self.stored[robot] = goal
        if audit.attempt is not None:
            self.attempts[audit.attempt] = goal
        self.records.append((audit.who, audit.action))
        return "ok"

    async def delete(self, robot: str, goal_id: str, audit: Any) -> None:
        if robot in self.stored and self.stored[robot].goal.goal_id == goal_id:
            del self.stored[robot]
            self.records.append((audit.who, audit.action))

    async def record_command(self, *_: object) -> None: ...
    async def record_stop(self, *_: object) -> None: ...

    # --- the router ---

    def subscribe(self, channel: ch.Channel, _kind: type, handler: Callable[..., None], **_ids: str) -> None:
        self.hear[channel] = handler

    def serve(self, *_: object, **__: str) -> None: ...
    async def query(self, *_: object, **__: object) -> None: ...

    def robot(self, *, arrived: bool = False, mode: Any = "NORMAL") -> None:
        mission = self.service.goals.get("r1")
        self.hear[ch.ROBOT_POSE]({"robot": "r1"}, RobotPose(
            x=0.0, y=0.0, theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.17, height=0.1, stamp=1.0
        ))  # fmt: skip
        self.hear[ch.ROBOT_STATE]({"robot": "r1"}, RobotState(
            mode=mode, reasons=[], enabled=mode != "INIT", battery=1.0, map_epoch=1, map_seq=1, plan_id=None,
            goal_id=mission.goal.goal_id if mission else None, goal_reached=arrived,
            goal_distance=7.0 if mission else None,
        ))  # fmt: skip
        if arrived and mission is not None:
            self.service.missions.end("r1", mission.goal.goal_id)
            del self.stored["r1"]  # as the store's loop does
            self.service.missions._reached.clear()

    async def settle(self) -> None:
        """Let the visits do what is due."""
        for _ in range(3):
            self.service.visiting.step()
            await asyncio.gather(*self.service.visiting._tasks)

    async def ask(
        self, method: str, path: str, body: object = None, *, role: str = "guest", key: str = ""
    ) -> httpx.Response:
        headers = {"Authorization": f"Bearer {role}"} if role else {}
        headers |= {"Idempotency-Key": key} if key else {}
        answer = await self.http.request(method, f"/api/v1/{path}", json=body, headers=headers)
        await self.settle()
        return answer

    async def mine(self) -> tuple[str, str | None]:
        answer = (await self.ask("GET", "visits/mine")).json()
        return answer["state"], answer["end"]


@pytest.fixture
async def world() -> AsyncIterator[World]:
    world = World()
    await world.service.lead(1, confirmed=True)
    world.robot()
    yield world
    await world.http.aclose()
    world.service.close()


async def test_guest_is_led_from_place_to_place(world: World) -> None:
    asked = await world.ask("POST", "visits", TOUR)
    assert (asked.status_code, asked.json()["state"]) == (201, "coming")
    again = await world.ask("POST", "visits", TOUR)
    assert again.status_code == 200
    world.robot()
    coming = (await world.ask("GET", "visits/mine")).json()
    assert (coming["robot"], coming["distance_m"], world.stored["r1"].goal.place) == ("r1", 7.0, "hall")
    assert (await world.ask("POST", "visits/mine/go")).json()["type"] == "urn:fognav:visit_not_ready"
    world.robot(arrived=True)
    assert await world.mine() == ("ready", None)
    assert (await world.ask("POST", "visits/mine/go")).json()["state"] == "leading"
    world.robot()
    assert (world.stored["r1"].goal.place, world.stored["r1"].any_heading) == ("lab", False)
    world.robot(arrived=True)
    assert await world.mine() == ("arrived", None)
    assert world.records == [("visitor hall tablet", "visit")] * 2


@pytest.mark.claim
async def test_guest_sees_public_places_and_the_own_visit_and_nothing_else(world: World) -> None:
    places = await world.ask("GET", "visits/places")
    assert places.json() == [{"id": "hall", "label": "Hall"}, {"id": "lab", "label": "Lab"}]
    assert (await world.ask("GET", "visits/mine")).json()["type"] == "urn:fognav:no_visit"
    for start, goal in (("hall", "office"), ("office", "lab"), ("hall", "nowhere")):
        refused = await world.ask("POST", "visits", {"start": start, "goal": goal})
        assert refused.json()["type"] == "urn:fognav:place_not_public"
        assert "director" not in refused.text
    for method, path in (
        ("GET", "robots"), ("GET", "robots/r1"), ("PUT", "robots/r1/goal"), ("DELETE", "robots/r1/goal"),
        ("POST", "robots/r1/commands"), ("POST", "robots/r1/undo"), ("POST", "robots/r1/goal/dry-run"),
    ):  # fmt: skip
        refused = await world.ask(method, path, {"place": "office", "kind": "enable", "entry": "1-1"})
        assert (refused.status_code, refused.json()["type"]) == (403, "urn:fognav:role_too_low"), path
    for path in ("visits/places", "visits/mine"):
        assert (await world.ask("GET", path, role="")).status_code == 401
    assert world.records == []


async def test_operator_sees_the_open_visits_and_ends_one(world: World) -> None:
    await world.ask("POST", "visits", TOUR)
    for role in ("guest", "viewer"):
        assert (await world.ask("GET", "visits", role=role)).status_code == 403
        assert (await world.ask("DELETE", "visits/open/1", role=role)).status_code == 403
    (visit,) = (await world.ask("GET", "visits", role="operator")).json()
    assert (visit["name"], visit["robot"], visit["state"], visit["goal"]) == ("hall tablet", "r1", "coming", "lab")
    refused = await world.ask("DELETE", "visits/open/1", role="operator")
    assert (refused.status_code, refused.json()["type"]) == (404, "urn:fognav:no_visit")
    assert (await world.ask("DELETE", f"visits/open/{visit['id']}", role="operator")).status_code == 204
    assert await world.mine() == ("ended", "operator")
    assert (world.stored, (await world.ask("GET", "visits", role="operator")).json()) == ({}, [])
    assert world.records[-1] == ("anna", "visit_ended"), "the audit trail names who ended it"


@pytest.mark.claim
@pytest.mark.parametrize("leading", [False, True])
@pytest.mark.parametrize("word", ["goal", "cancel", "stop", "disable", "out of service", "by hand"])
async def test_operators_word_ends_a_visit_at_once_and_stays(world: World, word: str, *, leading: bool) -> None:
    await world.ask("POST", "visits", TOUR)
    if leading:
        world.robot(arrived=True)
        await world.ask("POST", "visits/mine/go")
    world.robot()
    if word == "goal":
        await world.ask("PUT", "robots/r1/goal", {"place": "office"}, role="operator")
    elif word == "cancel":
        await world.ask("DELETE", "robots/r1/goal", role="operator")
    elif word == "stop":
        await world.ask("POST", "robots/r1/stop", role="")
    elif word == "out of service":
        await world.ask("PUT", "robots/r1/out-of-service", {"reason": "a tour"}, role="operator")
    elif word == "disable":
        await world.ask("POST", "robots/r1/commands", {"kind": "disable"}, role="operator")
    else:
        world.robot(mode="TELEOP")
    assert await world.mine() == ("ended", "operator")
    assert [goal.goal.place for goal in world.stored.values()] == (["office"] if word == "goal" else [])
    assert (await world.ask("POST", "visits/mine/go")).status_code == 409


async def test_visit_takes_no_robot_that_has_a_mission_and_gives_up_one_that_is_not_public_any_more(
    world: World,
) -> None:
    await world.ask("PUT", "robots/r1/goal", {"place": "office"}, role="operator")
    assert (await world.ask("POST", "visits", TOUR)).json()["state"] == "waiting"
    assert world.stored["r1"].goal.place == "office"
    world.robot(arrived=True)
    await world.settle()
    assert await world.mine() == ("coming", None)
    world.service._core.places = {"hall": SITE.places["hall"]}
    assert (await world.ask("GET", "visits/places")).json() == [{"id": "hall", "label": "Hall"}]
    assert await world.mine() == ("ended", "place")
    assert world.stored == {}


@pytest.mark.claim
async def test_restarted_planner_ends_missions_of_visits_before_the_robot_hears_of_them_and_no_others() -> None:
    def stored(place: str, *, visit: bool) -> StoredGoal:
        goal = RobotGoal(goal_id=place, pose=Pose(x=5.0, y=2.0, theta=0.0), place=place)
        return StoredGoal(goal=goal, visit=visit)

    world = World({"r1": stored("lab", visit=True), "r2": stored("office", visit=False)})
    await world.service.lead(2, confirmed=True)
    assert list(world.service.goals) == list(world.stored) == ["r2"]
    assert world.records == [("r1", "visit_ended")]
    await world.http.aclose()
    world.service.close()

    world = World({"r1": stored("lab", visit=True), "r2": stored("office", visit=False)})
    world.delete = AsyncMock(side_effect=StoreError("read only"))
    with suppress(StoreError):
        await world.service.lead(2, confirmed=True)
    assert list(world.service.goals) == ["r2"], "what can't be deleted keeps nobody else waiting"
    await world.http.aclose()
    world.service.close()


async def test_operator_sends_a_robot_to_several_places_and_sees_which_it_has_reached(world: World) -> None:
    async def states() -> list[tuple[str, str]]:
        view = (await world.ask("GET", "robots/r1/mission", role="viewer")).json()
        return [(stop["place"], stop["state"]) for stop in view["stops"]]

    assert (await world.ask("GET", "robots/r1/mission", role="viewer")).json()["type"] == "urn:fognav:no_mission"
    body = {"stops": [{"place": "office"}, {"place": "hall"}, {"place": "lab"}], "when_cut": {"do": "nearest"}}
    sent = await world.ask("PUT", "robots/r1/mission", body, role="operator")
    assert (sent.status_code, sent.json()["when_cut"]) == (201, {"do": "nearest", "limit_s": None})
    assert await states() == [("office", "present"), ("hall", "ahead"), ("lab", "ahead")]
    assert (await world.ask("GET", "robots/r1/goal", role="viewer")).json()["place"] == "office"
    world.service.missions.end("r1", world.service.goals["r1"].goal.goal_id)
    await world.service.missions._end_reached()
    assert await states() == [("office", "reached"), ("hall", "present"), ("lab", "ahead")]
    again = await world.ask("PUT", "robots/r1/mission", {"stops": [{"place": "lab"}]}, role="operator")
    assert (again.status_code, await states()) == (200, [("lab", "present")])
    for wrong, problem in (({"stops": []}, "request_invalid"), ({"stops": [{"place": "attic"}]}, "no_place")):
        refused = (await world.ask("PUT", "robots/r1/mission", wrong, role="operator")).json()
        assert refused["type"] == f"urn:fognav:{problem}"
    assert (await world.ask("PUT", "robots/r9/mission", body, role="operator")).status_code == 404
    assert (await world.ask("PUT", "robots/r1/mission", body, role="viewer")).status_code == 403
    assert (await world.ask("DELETE", "robots/r1/goal", role="operator")).status_code == 204
    assert world.stored == {}


async def test_mission_that_is_ordered_again_because_its_answer_was_lost_is_the_same_whatever_has_changed(world: World):
    body = {"stops": [{"place": "office"}, {"place": "lab"}], "deadline_s": 600, "when_cut": {"do": "cancel"}}
    world.service.preview = AsyncMock(return_value=PlanReply(length=7.0, cost=350.0))
    sent = await world.ask("PUT", "robots/r1/mission", body, role="operator", key="k1")
    assert sent.status_code == 201
    world.service.poses.clear()
    assert (await world.ask("PUT", "robots/r1/mission", body, role="operator", key="k2")).status_code == 409
    again = await world.ask("PUT", "robots/r1/mission", body, role="operator", key="k1")
    assert (again.status_code, again.json()) == (200, sent.json())
