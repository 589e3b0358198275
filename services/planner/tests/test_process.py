"""The planner as a process, with a real router and Redis; the test acts as map-service and robot."""

import asyncio
import json
import math
import os
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

import httpx
import msgspec
import numpy as np
import programs
import pytest
from secured_servers import SecuredSite

from fog_contracts import channels as ch
from fog_contracts.commands import CommandGate
from fog_contracts.costs import DEFAULT_INFLATION
from fog_contracts.grid import GridGeometry, Window
from fog_contracts.messages import (
    WEEKDAYS,
    AreaHazard,
    Cause,
    CommandReply,
    EgressRequest,
    HazardArea,
    MapSnapshot,
    PlanReply,
    PlanRequest,
    Pose,
    RobotCommand,
    RobotGoal,
    RobotPath,
    RobotPose,
    RobotState,
    Trace,
)
from fog_contracts.replica import MasterMap
from fog_kernels.inflation import inflate, inflation_table
from fog_runtime.clock import SystemClock, ticker
from fog_runtime.http import token_hash
from fog_runtime.stores.redis_connection import RedisConnection
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fog_supervisor.servers import Server

pytestmark = pytest.mark.live

SITE = """
id = "test"
map = "map.yaml"
[places.left]
x = 1.0
y = 7.0
[places.right]
x = 19.0
y = 7.0
theta = 1.5
[[robots]]
id = "r1"
start = { x = 1.0, y = 7.0, theta = 0.0 }
radius = 0.17
"""
MAP = """
image: map.pgm
mode: trinary
resolution: 0.1
origin: [0.0, 0.0, 0.0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""
OPERATOR = {"Authorization": "Bearer operator-token"}
VIEWER = {"Authorization": "Bearer viewer-token"}
DEADLINE_S = 60.0
"""For any wait, which ends with what it waits for."""
UPPER = [(9.0, 10.0), (11.0, 10.0), (11.0, 12.0), (9.0, 12.0)]


def static_map() -> np.ndarray[tuple[int, int], np.dtype[np.uint8]]:
    cells = np.zeros((120, 200), np.uint8)
    cells[[0, -1], :] = 254
    cells[:, [0, -1]] = 254
    cells[20:100, 20:180] = 254
    return cells


def write_site(folder: Path) -> None:
    folder.mkdir()
    (folder / "site.toml").write_text(SITE)
    (folder / "map.yaml").write_text(MAP)
    image = np.where(static_map() == 0, 254, 0).astype(np.uint8)[::-1]
    (folder / "map.pgm").write_bytes(b"P5\n200 120\n255\n" + image.tobytes())
    tokens = "\n".join(
        f'[[tokens]]\nname = "{role}"\nrole = "{role}"\nsha256 = "{token_hash(f"{role}-token")}"'
        for role in ("operator", "viewer")
    )
    (folder / "tokens.toml").write_text(tokens)


class Environment:
    """The planner's environment: servers, a map-service and a robot."""

    def __init__(
        self,
        folder: Path,
        router: Server,
        redis: Server,
        edge: ZenohEdge,
        site: SecuredSite,
        further: dict[str, str] | None = None,
    ) -> None:
        self.further = {**site.environment("planner"), **(further or {})}
        self.site = site
        self.folder, self.router, self.redis, self.edge, self.clock = folder, router, redis, edge, SystemClock()
        self.geometry = GridGeometry(200, 120, 0.1, 0.0, 0.0)
        self.static = static_map()
        self.table = inflation_table(0.1, DEFAULT_INFLATION)
        self.master = MasterMap("test", self.geometry, self.static, inflate(self.static, self.table), 5)
        self.paths: list[RobotPath] = []
        self.goals: list[RobotGoal] = []
        self.process: programs.Program | None = None
        edge.serve(ch.MAP_SNAPSHOT, lambda _ids, _request: self.master.snapshot())
        edge.subscribe(ch.ROBOT_PATH, RobotPath, lambda _, path: self.paths.append(path), robot="r1")
        edge.subscribe(ch.ROBOT_GOAL, RobotGoal, lambda _, goal: self.goals.append(goal), robot="r1")

    def start(self) -> None:
        port_file = self.folder / "port"
        port_file.unlink(missing_ok=True)
        environ = os.environ | {
            "FOGNAV_SITE_DIR": str(self.folder),
            "FOGNAV_DATA_DIR": str(self.folder),
            "FOGNAV_REDIS_URL": self.redis.url,
            "FOGNAV_ZENOH_CONNECT": self.router.endpoint,
            "FOGNAV_PORT_FILE": str(port_file),
            "FOGNAV_TOKENS_FILE": str(self.folder / "tokens.toml"),
            **self.further,
        }
        self.process = programs.start("planner", environ, self.folder / "planner.log")

    def stop(self, *, kill: bool = False) -> int:
        assert self.process
        (self.process.kill if kill else self.process.terminate)()
        return self.process.wait(DEADLINE_S)

    @asynccontextmanager
    async def ready(self) -> AsyncIterator[httpx.AsyncClient]:
        port_file = self.folder / "port"
        await self.until(port_file.exists)
        async with httpx.AsyncClient(
            base_url=f"http://127.0.0.1:{port_file.read_text().strip()}", timeout=60
        ) as client:
            deadline = time.monotonic() + DEADLINE_S
            while (answer := await client.get("/readyz")).status_code != 200:
                assert time.monotonic() < deadline, answer.text
                await asyncio.sleep(0.05)
            yield client

    async def until(self, condition: Callable[[], object], seconds: float = DEADLINE_S) -> None:
        deadline = time.monotonic() + seconds
        while not condition():
            assert time.monotonic() < deadline, (self.folder / "planner.log").read_text()[-3000:]
            assert self.process is None or self.process.poll() is None, (self.folder / "planner.log").read_text()
            await asyncio.sleep(0.01)

    async def publish_heartbeats_and_poses(self) -> None:
        async for _ in ticker(self.clock, 0.1):
            stamp = self.clock.stamp()
            self.edge.publish(ch.MAP_HEARTBEAT, self.master.heartbeat(stamp))
            pose = RobotPose(
                x=1.0, y=7.0, theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.17, height=0.1, stamp=stamp
            )
            self.edge.publish(ch.ROBOT_POSE, pose, robot="r1")

    def block_upper_corridor(self) -> None:
        raw = self.static.copy()
        raw[100:, 90:110] = 254
        whole = Window(0, 0, 200, 120)
        trace = Trace(area="z1", epoch=1, seq=1, confirmed=1.0, costmap_published=self.clock.stamp())
        causes = [Cause(kind="hazard", id="z1", state="blocked")]
        for delta in self.master.write([("cost", whole, inflate(raw, self.table))], causes, [trace]):
            self.edge.publish(ch.MAP_DELTA, delta)
        hazard = AreaHazard(
            area="z1", state="blocked", severity=2, penalty=254, since=0.0, seq=1, epoch=1, cause="test"
        )
        self.edge.publish(ch.HAZARD, HazardArea(hazard=hazard, polygon=UPPER, epoch=5), area="z1")

    async def publish_states(self) -> None:
        """Say once a second that the robot could drive."""
        async for _ in ticker(self.clock, 1.0):
            goal = self.goals[-1].goal_id if self.goals and self.goals[-1].pose is not None else None
            state = RobotState(
                mode="NORMAL", reasons=[], enabled=True, battery=None, goal_id=goal, map_epoch=5, map_seq=0, plan_id=1,
                clock=self.clock.now(), boot="run-1",
            )  # fmt: skip
            self.edge.publish(ch.ROBOT_STATE, state, robot="r1")

    def report_reached(self, goal_id: str) -> None:
        state = RobotState(
            mode="NORMAL", reasons=[], enabled=True, battery=None, goal_id=goal_id, map_epoch=5, map_seq=0, plan_id=1,
            goal_reached=True,
        )  # fmt: skip
        self.edge.publish(ch.ROBOT_STATE, state, robot="r1")


@asynccontextmanager
async def running_planner(folder: Path, **further: str) -> AsyncIterator[Environment]:
    write_site(folder / "site")
    site = SecuredSite(folder, "test", robots=["r1"])
    with site.router() as router, site.redis() as redis:
        opened = ZenohEdge.open(
            connect=[router.endpoint],
            clock=SystemClock(),
            role="test",
            id="test",
            site="test",
            credentials=site.credentials(),
        )
        async with opened as edge:
            env = Environment(folder / "site", router, redis, edge, site, further)
            env.start()
            publishing = asyncio.create_task(env.publish_heartbeats_and_poses())
            try:
                yield env
            finally:
                publishing.cancel()
                await asyncio.gather(publishing, return_exceptions=True)
                if env.process and env.process.poll() is None:
                    env.stop(kill=True)


async def test_operator_without_a_key_enables_a_robot_through_the_planner_and_the_trail_names_them(
    tmp_path: Path,
) -> None:
    key = tmp_path / "operator.key"
    key.write_text("ab" * 32)
    gate = CommandGate("r1", bytes.fromhex("ab" * 32), "run-1")

    async with running_planner(tmp_path, FOGNAV_OPERATOR_KEY_FILE=str(key)) as env:

        def answer(_ids: object, command: RobotCommand) -> CommandReply:
            refusal = gate.refusal(command, env.clock.now())
            if refusal is not None:
                return CommandReply.refused(refusal)
            return CommandReply(accepted=True, reason=f"{command.operator} may {command.kind}")

        env.edge.serve(ch.ROBOT_COMMAND, answer, robot="r1")
        state = RobotState(
            mode="INIT", reasons=[], enabled=False, battery=None, goal_id=None, map_epoch=5, map_seq=0, plan_id=None,
            boot="run-1",
        )  # fmt: skip
        async with env.ready() as client:
            deadline = time.monotonic() + DEADLINE_S
            while True:
                env.edge.publish(ch.ROBOT_STATE, msgspec.structs.replace(state, clock=env.clock.now()), robot="r1")
                done = await client.post("/api/v1/robots/r1/commands", json={"kind": "enable"}, headers=OPERATOR)
                if done.status_code == 200:
                    break
                assert time.monotonic() < deadline, done.text
                await asyncio.sleep(0.1)
            assert done.json()["reason"] == "operator may enable"
            stopped = await client.post("/api/v1/robots/r1/stop")
            assert stopped.json()["reason"] == "stop from 127.0.0.1 may disable"
        redis = RedisConnection(env.redis.url, credentials=env.site.credentials("administrator"))
        trails = [await redis.read("XRANGE", f"fog:test:audit:{kind}", "-", "+") for kind in ("robot", "stop")]
        await redis.aclose()
        last = [trail[-1][1] for trail in trails]
        assert [(e[b"who"], e[b"action"], e[b"id"]) for e in last] == [
            (b"operator", b"enable", b"r1"), (b"stop from 127.0.0.1", b"stop", b"r1"),
        ]  # fmt: skip


def via(path: RobotPath) -> str:
    return "upper" if max(y for _, y in path.points) > 10.0 else "lower"


@pytest.mark.smoke
async def test_mission_is_replanned_around_a_hazard_survives_a_kill_and_ends_when_reached(
    tmp_path: Path,
) -> None:
    async with running_planner(tmp_path) as env:
        async with env.ready() as client:
            answer = await client.put("/api/v1/robots/r1/goal", json={"place": "right"}, headers=OPERATOR)
            assert answer.status_code == 201
            goal_id = answer.json()["goal_id"]
            await env.until(lambda: env.paths and env.goals)
            assert (env.paths[-1].goal_id, env.goals[-1].goal_id) == (goal_id, goal_id)
            assert env.paths[-1].goal_theta == 1.5
            assert via(env.paths[-1]) == "upper"

            env.block_upper_corridor()
            await env.until(lambda: via(env.paths[-1]) == "lower")
            path = env.paths[-1]
            assert [trace.area for trace in path.traces] == ["z1"]
            assert path.traces[0].plan_published >= path.traces[0].costmap_published > 0.0
            (robot,) = (await client.get("/api/v1/robots", headers=OPERATOR)).json()
            assert (robot["id"], robot["goal"]["goal_id"], robot["pose"]["x"]) == ("r1", goal_id, 1.0)
            metrics = (await client.get("/metrics")).text
            assert 'fognav_plans_total{reason="map"} 1.0' in metrics
            assert 'fognav_stage_seconds_count{stage="plan"} 1.0' in metrics

        env.stop(kill=True)
        env.paths.clear()
        env.start()
        await env.until(lambda: env.paths)
        assert env.paths[-1].goal_id == goal_id
        assert env.paths[-1].planner_epoch > path.planner_epoch
        assert via(env.paths[-1]) == "lower"

        async with env.ready() as client:
            env.report_reached(goal_id)
            await env.until(lambda: env.goals[-1].pose is None)
            assert (await client.get("/api/v1/robots/r1/goal", headers=OPERATOR)).status_code == 404
            assert env.stop() == 0


async def test_idle_robot_goes_home_and_on_by_the_clock_and_no_kill_begins_that_mission_again(tmp_path: Path) -> None:
    async with running_planner(tmp_path, FOGNAV_WALL_CLOCK="trusted") as env:
        env.stop()
        site = env.folder / "site.toml"
        site.write_text(SITE + 'idle = { go = "right", after_s = 10 }\n')
        env.start()
        telling = asyncio.create_task(env.publish_states())
        begin = datetime.fromtimestamp(60.0 * math.floor(time.time() / 60.0), UTC)
        async with env.ready() as client:
            times = {"days": list(WEEKDAYS), "begin": f"{begin:%H:%M}", "end": f"{begin + timedelta(hours=1):%H:%M}"}
            body = {
                "robot": "r1",
                "mission": {"stops": [{"place": "left"}, {"place": "right"}]},
                "weekly": {"time_zone": "UTC", "times": [times]},
            }
            made = await client.put("/api/v1/schedules/round", json=body, headers=OPERATOR)
            assert (made.status_code, made.json()["next"]) == (201, (begin + timedelta(days=1)).timestamp())
            await env.until(lambda: env.goals and env.goals[-1].place == "right")
            assert env.goals[-1].idle
        env.stop()
        # As if it had been written a minute before its window: instead of waiting for the next minute.
        redis = RedisConnection(env.redis.url, credentials=env.site.credentials("administrator"))
        written = json.loads(await redis.read("HGET", "fog:test:schedules", "round"))
        written["since"] = begin.timestamp() - 60.0
        await redis.write(("HSET", "fog:test:schedules", "round", json.dumps(written)))
        await redis.aclose()
        env.start()
        async with env.ready():
            await env.until(lambda: env.goals[-1].place == "left")
            given = env.goals[-1].goal_id
            await env.until(lambda: env.paths and env.paths[-1].goal_id == given)
        env.stop(kill=True)
        env.goals.clear()
        env.start()
        await env.until(lambda: env.goals and env.goals[-1].goal_id == given)  # it leads, and goes on with it
        async with env.ready() as client:
            assert (await client.delete("/api/v1/robots/r1/goal", headers=OPERATOR)).status_code == 204
            await env.until(lambda: env.goals[-1].pose is None)
            last = (await client.get("/api/v1/schedules/round", headers=OPERATOR)).json()["last"]
            assert (last["outcome"], last["begin"]) == ("given", begin.timestamp())
            assert given.startswith(last["mission"])
            await env.until(lambda: env.goals[-1].pose is not None)
            assert (env.goals[-1].place, env.goals[-1].idle) == ("right", True), "not that mission again, but home"
        telling.cancel()
        await asyncio.gather(telling, return_exceptions=True)


async def test_invalid_goals_are_refused_with_a_reason_and_all_goals_without_the_store(
    tmp_path: Path,
) -> None:
    async with running_planner(tmp_path) as env, env.ready() as client:
        url = "/api/v1/robots/r1/goal"

        async def put(body: object, headers: dict[str, str] = OPERATOR, url: str = url) -> httpx.Response:
            return await client.put(url, json=body, headers=headers)

        wall = await put({"pose": {"x": 10.0, "y": 6.0}})
        assert (wall.status_code, wall.headers["content-type"]) == (422, "application/problem+json")
        problem = wall.json()
        assert (problem["code"], problem["name"]) == (206, "GOAL_OCCUPIED")
        assert (problem["type"], problem["refusal"]) == ("urn:fognav:goal_refused", "goal_in_wall")
        assert problem["errors"][0]["field"] == "body.pose"
        assert (await put({"pose": {"x": 99.0, "y": 6.0}})).json()["code"] == 204
        assert (await put({"place": "nowhere"})).json()["type"] == "urn:fognav:no_place"
        assert (await put({})).status_code == 422
        assert (await put({"place": "right"}, url="/api/v1/robots/r9/goal")).status_code == 404
        assert (await put({"place": "right"}, {})).status_code == 401
        assert (await put({"place": "right"}, VIEWER)).status_code == 403
        assert (await client.delete(url, headers=OPERATOR)).status_code == 404

        env.redis.stop()
        unstored = await put({"place": "right"})
        assert unstored.status_code == 503
        assert "retry-after" in unstored.headers
        assert (await client.get(url, headers=OPERATOR)).status_code == 404
        env.redis.start()
        assert (await put({"place": "right"})).status_code == 201
        await env.until(lambda: env.paths)
        assert (await client.delete(url, headers=OPERATOR)).status_code == 204
        await env.until(lambda: env.goals[-1].pose is None)


async def test_operator_takes_a_robot_out_of_service_which_ends_its_mission_and_outlasts_a_restart(
    tmp_path: Path,
) -> None:
    async with running_planner(tmp_path) as env:
        url, goal = "/api/v1/robots/r1/out-of-service", {"place": "right"}
        async with env.ready() as client:
            assert (await client.put("/api/v1/robots/r1/goal", json=goal, headers=OPERATOR)).status_code == 201
            assert (await client.put(url, json={"reason": "worn wheel"}, headers=VIEWER)).status_code == 403
            assert (await client.put(url, json={"reason": "worn wheel"})).status_code == 401
            assert (await client.put(url, json={"reason": ""}, headers=OPERATOR)).status_code == 422
            assert (await client.delete(url, headers=OPERATOR)).json()["type"] == "urn:fognav:in_service"
            held = await client.put(url, json={"reason": "worn wheel"}, headers=OPERATOR)
            assert (held.status_code, held.json()["by"]) == (200, "operator")
            await env.until(lambda: env.goals[-1].pose is None and env.goals[-1].out_of_service is not None)
            assert env.stop() == 0
        env.start()
        async with env.ready() as client:
            for method, path, body in (
                ("PUT", "/api/v1/robots/r1/goal", goal),
                ("POST", "/api/v1/robots/r1/commands", {"kind": "dock"}),
            ):
                refused = await client.request(method, path, json=body, headers=OPERATOR)
                assert (refused.status_code, refused.json()["type"]) == (409, "urn:fognav:out_of_service")
                assert "worn wheel" in refused.json()["detail"]
            assert (await client.get("/api/v1/robots/r1", headers=VIEWER)).json()["out_of_service"] == held.json()

            async def undo_latest() -> object:
                redis = RedisConnection(env.redis.url, credentials=env.site.credentials("administrator"))
                ((latest, _),) = await redis.read("XREVRANGE", "fog:test:audit:service", "+", "-", "COUNT", 1)
                await redis.aclose()
                entry = {"entry": f"{latest.decode()}.service"}
                answer = await client.post("/api/v1/robots/r1/undo", json=entry, headers=OPERATOR)
                assert (answer.status_code, answer.json()["kind"]) == (200, "service")
                return answer.json()["value"]

            assert await undo_latest() is None
            assert (await client.get("/api/v1/robots/r1", headers=VIEWER)).json()["out_of_service"] is None
            assert await undo_latest() == held.json()
            assert (await client.delete(url, headers=OPERATOR)).status_code == 204
            await env.until(lambda: env.goals[-1].out_of_service is None)
            before = len(env.goals)
            assert (await client.put(url, json={"reason": "dusty", "ttl_s": 0.5}, headers=OPERATOR)).status_code == 200
            await env.until(lambda: any(goal.out_of_service for goal in env.goals[before:]))
            await env.until(lambda: env.goals[-1].out_of_service is None)
            assert (await client.put("/api/v1/robots/r1/goal", json=goal, headers=OPERATOR)).status_code == 201
            assert env.stop() == 0


async def test_mission_is_replaced_or_cancelled_only_if_it_is_the_one_that_was_read(tmp_path: Path) -> None:
    async with running_planner(tmp_path) as env, env.ready() as client:
        url = "/api/v1/robots/r1/goal"

        async def put(place: str, **condition: str) -> httpx.Response:
            headers = {**OPERATOR, **{name.replace("_", "-"): value for name, value in condition.items()}}
            return await client.put(url, json={"place": place}, headers=headers)

        first = await put("right", if_none_match="*")
        assert first.status_code == 201
        tag = first.headers["etag"]
        assert tag == f'"{first.json()["goal_id"]}"' == (await client.get(url, headers=OPERATOR)).headers["etag"]
        refused = await put("right", if_none_match="*")
        assert (refused.status_code, refused.headers["content-type"]) == (412, "application/problem+json")
        assert f"has the mission {first.json()['goal_id']}" in refused.json()["detail"]
        for wrong in ('"other"', "no tag", '""'):
            assert (await put("right", if_match=wrong)).status_code == 412
            assert (await client.delete(url, headers={**OPERATOR, "If-Match": wrong})).status_code == 412
        second = await put("right", if_match=tag)
        assert second.status_code == 200
        assert (await put("right", if_match=tag)).status_code == 412, "it is not that mission any more"
        keyed = {"if_match": second.headers["etag"], "idempotency_key": "k1"}
        third = await put("right", **keyed)
        assert (await put("right", **keyed)).json() == third.json(), "a repeated request is no new order"
        asked = await put("right", if_match='"none"', idempotency_key="k1")
        assert asked.json() == third.json(), "the key tells whether it began, under a condition by which nothing begins"
        assert (await put("right", if_match='"none"', idempotency_key="k2")).status_code == 412
        # A reached mission may still be stored for a while.
        goal_id = third.json()["goal_id"]
        await env.until(lambda: env.goals and env.goals[-1].goal_id == goal_id)
        env.report_reached(goal_id)
        await env.until(lambda: env.goals[-1].pose is None)
        assert (await put("right", if_match=third.headers["etag"])).status_code == 412
        assert (await put("right", if_none_match="*")).status_code == 201
        current = (await client.get(url, headers=OPERATOR)).headers["etag"]
        assert (await client.delete(url, headers={**OPERATOR, "If-Match": current})).status_code == 204
        assert (await client.delete(url, headers={**OPERATOR, "If-Match": current})).status_code == 404
        assert (await put("right", if_match='"none"', idempotency_key="k1")).json()["goal_id"] == goal_id
        assert (await client.get(url, headers=OPERATOR)).status_code == 404, "it is over all the same"


async def test_queries_are_answered_over_zenoh_and_http_without_side_effects(tmp_path: Path) -> None:
    async with running_planner(tmp_path) as env, env.ready() as client:
        request = PlanRequest(start=Pose(x=1.0, y=7.0, theta=0.0), goal=Pose(x=19.0, y=7.0, theta=0.0))
        reply = await env.edge.query(ch.PLANNER_PLAN, request, PlanReply, 5.0)
        assert reply
        assert reply.refusal is None
        body = {"start": {"x": 1.0, "y": 7.0, "theta": 0.0}, "goal": {"x": 10.0, "y": 6.0, "theta": 0.0}}
        refused = (await client.post("/api/v1/plan", json=body)).json()
        assert refused["refusal"]["code"] == 206

        env.block_upper_corridor()

        async def query_egress() -> PlanReply | None:
            request = EgressRequest(robot="r1", pose=Pose(x=9.5, y=11.0, theta=0.0))
            return await env.edge.query(ch.PLANNER_EGRESS, request, PlanReply, 5.0)

        deadline = time.monotonic() + DEADLINE_S
        while not (out := await query_egress()) or len(out.points) < 5:
            assert time.monotonic() < deadline, out
            await asyncio.sleep(0.05)
        assert out.points[-1][0] < 9.0
        assert env.paths == []
        assert (await client.get("/openapi.json")).status_code == 200
        snapshot = await env.edge.query(ch.MAP_SNAPSHOT, None, MapSnapshot, 5.0)
        assert snapshot
        assert snapshot.seq == out.map_seq


async def test_anonymous_previews_delay_no_robot(tmp_path: Path) -> None:
    body = {"start": {"x": 1.0, "y": 7.0, "theta": 0.0}, "goal": {"x": 19.0, "y": 7.0, "theta": 0.0}}
    async with running_planner(tmp_path) as env, env.ready() as client:
        await client.put("/api/v1/robots/r1/goal", json={"place": "right"}, headers=OPERATOR)
        await env.until(lambda: env.paths)
        statuses: list[int] = []
        stop = asyncio.Event()

        async def ask() -> None:
            while not stop.is_set():
                statuses.append((await client.post("/api/v1/plan", json=body, timeout=DEADLINE_S)).status_code)

        clients = [asyncio.create_task(ask()) for _ in range(32)]
        try:
            await env.until(lambda: len(statuses) > 32)
            env.block_upper_corridor()
            await env.until(lambda: via(env.paths[-1]) == "lower")
            # The robot had its path before it would have slowed down because the planner is silent.
            path = env.paths[-1]
            assert path.traces[0].plan_published - path.traces[0].costmap_published < ch.ROBOT_PATH.max_age_s
        finally:
            stop.set()
            await asyncio.gather(*clients)
        assert 200 in statuses
        assert set(statuses) <= {200, 503}
