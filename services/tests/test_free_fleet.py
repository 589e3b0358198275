"""Open-RMF's free_fleet drives robots of Fognav as robots of Nav2, without ROS."""

import asyncio
import json
import os
import struct
import time
from pathlib import Path

import httpx
import msgspec
import pytest
import zenoh
from manual_clock import ManualClock

from fog_bridges.floor import Answer, Request
from fog_bridges.free_fleet import UNSEEN_S, Fleet, Planned
from fog_bridges.ros2.session import ros_config
from fog_contracts import channels as ch
from fog_contracts.messages import RobotPose, RobotState

pytestmark = pytest.mark.live
PEERS = "FOGNAV_ROS2_PEERS"
PROGRAMS = "FOGNAV_FREE_FLEET"
"""A checkout of github.com/open-rmf/free_fleet; its programs need pycdr2 beside zenoh."""
theirs = pytest.mark.skipif(
    PEERS not in os.environ or PROGRAMS not in os.environ,
    reason=f"set {PROGRAMS} to a checkout of github.com/open-rmf/free_fleet, and {PEERS} to a Python that has "
    "eclipse-zenoh, numpy and pycdr2",
)
GOAL, OTHER = bytes(range(16)), bytes([9] * 16)
EVERYTHING = b"\0\1\0\0" + bytes(24)
"""A request to cancel whichever goal there is."""
UNKNOWN, EXECUTING, SUCCEEDED, CANCELED, ABORTED = 0, 2, 4, 5, 6
"""Of action_msgs/GoalStatus. free_fleet's adapter takes SUCCEEDED and CANCELED for a goal that is done with, so that
the task goes on; else it plans anew (free_fleet@002505fd, nav2_robot_adapter.py, `_is_navigation_done`)."""
POSE = RobotPose(x=1.0, y=1.0, theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.17, height=0.2, stamp=1.0)
STATE = RobotState(
    mode="NORMAL", reasons=[], enabled=True, battery=0.5, goal_id=None, map_epoch=0, map_seq=0, plan_id=None
)  # fmt: skip


class Floor:
    """A floor that takes the first goal and refuses those beyond x = 100 m."""

    def __init__(self) -> None:
        self.asked: list[Request] = []
        self.answers: list[Answer] = []
        """What it answers first."""
        self.open = asyncio.Event()
        self.open.set()

    async def ask(self, request: Request) -> Answer:
        self.asked.append(request)
        await self.open.wait()
        if self.answers:
            return self.answers.pop(0)
        if request.body is not None and request.body["pose"]["x"] > 100.0:
            return Answer("the goal is off the map", "goal_refused")
        return Answer("", body={"goal_id": f"g{len(self.asked)}"})


class Rig:
    """A fleet with one robot on a router, and who asks it."""

    def __init__(self, port: int, tasks: asyncio.TaskGroup) -> None:
        self.own, self.other = (zenoh.open(ros_config(f"tcp/127.0.0.1:{port}")) for _ in range(2))
        self.floor, self.clock, self.planned = Floor(), ManualClock(100.0), Planned()
        self.fleet = Fleet(self.own, self.floor, self.clock, tasks, self.planned)  # type: ignore[arg-type]  # all of a floor that it uses
        self.fleet.on_pose("r-1", POSE)
        self.fleet.on_state("r-1", STATE)

    async def ask(self, name: str, payload: bytes) -> bytes:
        """Return the answer to a request; empty for an error."""

        def get() -> bytes:
            for _ in range(50):  # until the queryables are known
                replies = list(self.other.get(f"r_1/navigate_to_pose/_action/{name}", payload=payload, timeout=10.0))
                if replies:
                    return b"" if replies[0].ok is None else replies[0].ok.payload.to_bytes()
            return b"none"

        return await asyncio.to_thread(get)

    def state(
        self, goal_id: str | None, *, reached: bool = False, distance: float | None = None, waits: bool = False
    ) -> None:
        self.fleet.on_state(
            "r-1",
            RobotState(
                mode="NORMAL", reasons=[], enabled=True, battery=0.5, goal_id=goal_id, goal_reached=reached,
                goal_distance=distance, map_epoch=0, map_seq=0, plan_id=None, awaits_operator=waits,
            ),
        )  # fmt: skip

    def plan(self, goal_id: str | None) -> None:
        """Have the planner give the robot a mission, or none."""
        goal = None if goal_id is None else {"goal_id": goal_id}
        self.planned.on_event("robot", {"id": "r-1", "value": {"goal": goal}})

    def end(self, goal_id: str | None, action: str, after: str | None = None, who: str = "anna") -> None:
        """Have the audit trail tell that a mission has ended, or begun."""
        before, now = ({"goal": {"goal_id": each}} if each else None for each in (goal_id, after))
        self.planned.on_event(
            "record",
            {"kind": "mission", "id": "r-1", "who": who, "action": action, "before": before, "after": now},
        )

    async def result(self, goal_id: bytes = GOAL) -> int:
        return status(await self.ask("get_result", b"\0\1\0\0" + goal_id))

    def close(self) -> None:
        for session in (self.own, self.other):
            session.close()


@pytest.fixture
async def rig(ros_router):
    async with asyncio.TaskGroup() as tasks:
        made = Rig(ros_router, tasks)
        yield made
        made.close()


def goal(x: float, frame: bytes = b"map", goal_id: bytes = GOAL) -> bytes:
    """A request as CDR has it: goal id, header, pose, and the name of a behaviour tree."""
    text = frame + b"\0"
    head = b"\0\1\0\0" + goal_id + struct.pack("<iII", 0, 0, len(text)) + text
    head += bytes(-(len(head) - 4) % 8)
    return head + struct.pack("<7d", x, 3.0, 0.0, 0.0, 0.0, 0.0, 1.0) + struct.pack("<I", 1) + b"\0"


def status(answer: bytes) -> int:
    return answer[4]


async def test_goal_is_driven_told_and_ends(rig):
    accepted = await rig.ask("send_goal", goal(4.0))
    assert accepted[4] == 1
    (request,) = rig.floor.asked
    assert (request.method, request.path) == ("PUT", "/api/v1/robots/r-1/goal")
    assert request.body == {"pose": {"x": 4.0, "y": 3.0, "theta": 0.0}}
    assert request.headers["If-None-Match"] == "*", "it takes no operator's mission away"
    rig.state("g1", distance=2.5)
    assert await rig.result() == EXECUTING
    rig.state("g1", reached=True)
    assert await rig.result() == SUCCEEDED
    assert await rig.result(bytes(16)) == UNKNOWN, "nobody has sent such a goal"


async def test_refused_goal_is_not_accepted_and_malformed_requests_are_answered_by_an_error(rig):
    assert (await rig.ask("send_goal", goal(200.0)))[4] == 0
    for damaged in (goal(4.0)[:30], b"", goal(4.0, b"odom"), goal(float("nan"))):
        assert await rig.ask("send_goal", damaged) == b""
    assert len(rig.floor.asked) == 1


async def test_cancellation_ends_the_mission_that_it_names_or_whichever_there_is(rig):
    cancel = [b"\0\1\0\0" + each + bytes(8) for each in (bytes(16), OTHER, GOAL)]
    assert (await rig.ask("cancel_goal", cancel[0]))[4] == 0
    await rig.ask("send_goal", goal(4.0))
    assert (await rig.ask("cancel_goal", cancel[1]))[4] == 2, "another's goal is unknown"
    answer = await rig.ask("cancel_goal", cancel[2])
    assert (answer[4], answer[8:12], answer[12:28]) == (0, b"\1\0\0\0", GOAL)
    assert (rig.floor.asked[-1].method, rig.floor.asked[-1].headers) == ("DELETE", {"If-Match": '"g1"'})
    assert await rig.result() == CANCELED


async def test_mission_that_an_operator_ends_is_aborted_so_that_free_fleet_does_not_take_the_robot_for_there(rig):
    await rig.ask("send_goal", goal(4.0))
    rig.state("g1")
    rig.plan(None)
    rig.state(None)
    assert await rig.result() == EXECUTING, "the audit trail tells within a second who has ended it"
    rig.end("g1", "cancel")
    assert await rig.result() == ABORTED
    rig.state("g1")
    assert await rig.result() == ABORTED, "what the robot still told then"


async def test_mission_that_gives_way_to_an_operators_is_aborted_and_one_to_the_adapters_next_goal_too(rig):
    await rig.ask("send_goal", goal(4.0))
    rig.state("g1")
    assert (await rig.ask("send_goal", goal(5.0, goal_id=OTHER)))[4] == 1
    assert (await rig.result(), await rig.result(OTHER)) == (ABORTED, EXECUTING)
    rig.end("g2", "goal", after="of-an-operator")
    assert await rig.result(OTHER) == ABORTED
    await rig.ask("send_goal", goal(6.0))
    await rig.ask("cancel_goal", EVERYTHING)
    await rig.ask("send_goal", goal(7.0, goal_id=OTHER))
    assert await rig.result() == CANCELED, "the adapter has canceled it before, and knows"


async def test_mission_is_reached_also_if_only_the_audit_trail_tells(rig):
    await rig.ask("send_goal", goal(4.0))
    rig.end("g1", "reached")
    rig.state(None)
    assert await rig.result() == SUCCEEDED


async def test_mission_outlasts_a_restart_of_its_robots_agent_and_can_be_canceled_meanwhile(rig):
    await rig.ask("send_goal", goal(4.0))
    rig.state("g1")
    rig.plan("g1")
    rig.state(None, waits=True)
    rig.clock.advance(60.0)
    rig.state(None, waits=True)
    assert await rig.result() == EXECUTING, "the planner has it, and tells the robot again"
    assert (await rig.ask("send_goal", goal(5.0)))[4] == 0, "until an operator has enabled the robot"
    answer = await rig.ask("cancel_goal", EVERYTHING)
    assert (answer[4], answer[12:28]) == (0, GOAL)
    assert rig.floor.asked[-1].headers == {"If-Match": '"g1"'}
    assert await rig.result() == CANCELED


async def test_mission_that_nobody_tells_of_is_aborted_goes_on_when_it_is_told_again_and_can_be_canceled(rig):
    await rig.ask("send_goal", goal(4.0))
    rig.state("g1")
    rig.planned.on_lost()
    rig.clock.advance(9.9)
    rig.state(None)
    assert await rig.result() == EXECUTING
    rig.clock.advance(0.2)
    assert await rig.result() == ABORTED
    rig.state("g1")
    assert await rig.result() == EXECUTING
    rig.clock.advance(10.0)
    rig.state(None)
    assert (await rig.ask("send_goal", goal(5.0, goal_id=OTHER)))[4] == 1
    assert rig.floor.asked[-1].headers["If-Match"] == '"g1"', "the floor may still have it"
    rig.clock.advance(10.0)
    rig.state(None)
    assert await rig.result(OTHER) == ABORTED
    assert (await rig.ask("cancel_goal", EVERYTHING))[4] == 0
    assert (rig.floor.asked[-1].method, rig.floor.asked[-1].headers) == ("DELETE", {"If-Match": '"g2"'})
    assert await rig.result(OTHER) == CANCELED


async def test_goal_after_one_that_an_operator_has_ended_is_accepted_and_replaces_nobodys_mission(rig):
    await rig.ask("send_goal", goal(4.0))
    rig.state("g1")
    rig.floor.answers = [Answer("the robot has no mission", "mission_changed")]
    assert (await rig.ask("send_goal", goal(5.0, goal_id=OTHER)))[4] == 1
    conditions = [request.headers.keys() & {"If-Match", "If-None-Match"} for request in rig.floor.asked]
    assert conditions == [{"If-None-Match"}, {"If-Match"}, {"If-None-Match"}]
    keys = {request.headers["Idempotency-Key"] for request in rig.floor.asked}
    assert len(keys) == 3, "what was refused is another request"


@pytest.mark.parametrize(
    ("who", "known", "condition"),
    [("fleet/free-fleet", EXECUTING, {"If-Match": '"g9"'}), ("anna", UNKNOWN, {"If-None-Match": "*"})],
)
async def test_mission_of_an_earlier_run_of_the_bridge_goes_on_until_the_next_goal_and_an_operators_is_nobodys_goal(
    rig, who, known, condition
):
    rig.end(None, "put", after="g9", who=who)
    rig.plan("g9")
    rig.state("g9")
    assert await rig.result() == known
    assert await rig.result(OTHER) == UNKNOWN
    await rig.ask("send_goal", goal(2.0, goal_id=OTHER))
    assert condition.items() <= rig.floor.asked[-1].headers.items()


async def test_charge_that_nobody_measures_is_not_told(rig):
    heard: list[float] = []
    told = rig.other.declare_subscriber(
        "r_1/battery_state", lambda sample: heard.append(struct.unpack_from("<f", sample.payload.to_bytes(), 44)[0])
    )
    async with asyncio.timeout(60.0):
        while len(heard) < 2:
            for battery in (None, 0.5):
                rig.fleet.on_state("r-1", msgspec.structs.replace(STATE, battery=battery))
            await asyncio.sleep(0.02)  # until the subscription is known
    told.undeclare()
    assert heard[:2] == [0.5, 0.5]


async def test_robot_that_tells_nothing_for_5_s_takes_no_goal_until_it_is_heard_again(rig):
    rig.clock.advance(5.0)
    assert (await rig.ask("send_goal", goal(4.0)))[4] == 0
    assert rig.floor.asked == [], "it would drive off once it is switched on"
    rig.state(None)
    assert (await rig.ask("send_goal", goal(4.0)))[4] == 1


async def test_robot_that_waits_for_an_operator_takes_no_goal(rig):
    rig.state(None, waits=True)
    assert (await rig.ask("send_goal", goal(4.0)))[4] == 0
    assert rig.floor.asked == [], "it would drive off once an operator enables it for something else"


async def test_cancellation_never_ends_an_operators_mission_and_says_so(rig):
    rig.state("of-an-operator", distance=3.0)
    assert (await rig.ask("cancel_goal", EVERYTHING))[4] == 1
    rig.state(None)
    await rig.ask("send_goal", goal(4.0))
    rig.floor.answers = [Answer("the robot has another mission", "mission_changed")]
    assert (await rig.ask("cancel_goal", EVERYTHING))[4] == 0
    assert [request.method for request in rig.floor.asked] == ["PUT", "DELETE"]
    assert await rig.result() == CANCELED
    await rig.ask("send_goal", goal(5.0))
    rig.end("g3", "goal", after="of-an-operator")
    rig.state("of-an-operator", distance=3.0)
    rig.floor.answers = [Answer("the robot has another mission", "mission_changed")]
    assert (await rig.ask("cancel_goal", EVERYTHING))[4] == 1
    rig.floor.answers = [Answer("the robot has another mission", "mission_changed")]
    assert (await rig.ask("cancel_goal", b"\0\1\0\0" + GOAL + bytes(8)))[4] == 3, "it is over"
    assert await rig.result() == ABORTED


async def test_goal_whose_answer_is_lost_is_sent_once_more_by_the_same_key(rig):
    rig.floor.answers = [Answer("the floor can't be reached")]
    assert (await rig.ask("send_goal", goal(4.0)))[4] == 1
    first, second = rig.floor.asked
    assert first.headers["Idempotency-Key"] == second.headers["Idempotency-Key"]


async def test_cancellation_waits_for_the_goal_that_is_under_way(rig, until):
    rig.floor.open.clear()
    sent = asyncio.create_task(rig.ask("send_goal", goal(4.0)))
    await until(lambda: rig.floor.asked, "the goal is under way", str)
    canceled = asyncio.create_task(rig.ask("cancel_goal", EVERYTHING))
    await until(lambda: rig.fleet._waiting == 2, "the cancellation has arrived", str)
    rig.floor.open.set()
    assert (await sent)[4] == 1
    answer = await canceled
    assert (answer[4], answer[12:28]) == (0, GOAL)


async def test_one_request_to_all_robots_and_one_of_many_bytes_are_refused(rig):
    await rig.ask("send_goal", goal(4.0))

    def ask(key: str, payload: bytes) -> list[bool]:
        return [reply.ok is None for reply in rig.other.get(key, payload=payload, timeout=10.0)]

    action = "navigate_to_pose/_action/send_goal"
    assert all(await asyncio.to_thread(ask, f"*/{action}", goal(4.0)))
    assert await asyncio.to_thread(ask, f"r_1/{action}", bytes(5000)) == [True]
    assert len(rig.floor.asked) == 1


@pytest.fixture
async def fog(all_services, tokens, ros_router):
    """Run the console-service and the bridge to free_fleet; yield the fog."""
    urls = {
        f"FOGNAV_{name}_URL": await all_services.ready(module)
        for name, module in (("AGGREGATOR", "hazard_aggregator"), ("MAP", "map_service"), ("PLANNER", "planner"))
    }
    all_services.start("console_service", **urls)
    token = all_services.folder / "free-fleet-token"
    token.write_text(tokens["operator"]["Authorization"].removeprefix("Bearer "))
    all_services.start(
        "fog_bridges", FOGNAV_ADAPTERS="free-fleet", FOGNAV_FREE_FLEET_ROUTER=f"tcp/127.0.0.1:{ros_router}",
        FOGNAV_CONSOLE_URL=await all_services.ready("console_service"), FOGNAV_TOKEN_FILE=str(token),
        FOGNAV_CREDENTIALS_FILE=str(all_services.security.credentials("bridge")),
    )  # fmt: skip
    await all_services.ready("fog_bridges")
    yield all_services
    for module in ("fog_bridges", "console_service"):
        all_services.kill(module)


async def test_planner_decides_which_missions_go_on_whatever_a_robot_forgets(fog, ros_router, tokens):
    """The robot of this test tells of no mission, as one does whose agent is being started anew."""
    peer = zenoh.open(ros_config(f"tcp/127.0.0.1:{ros_router}"))

    async def ask(name: str, payload: bytes) -> bytes:
        key = f"r_1/navigate_to_pose/_action/{name}"
        async with asyncio.timeout(60.0):
            while not (replies := await asyncio.to_thread(lambda: list(peer.get(key, payload=payload, timeout=10.0)))):  # noqa: ASYNC110  # of another process
                await asyncio.sleep(0.1)  # until the robot is served
        assert replies[0].ok is not None, replies[0].err
        return replies[0].ok.payload.to_bytes()

    async def result_is(expected: int) -> None:
        async with asyncio.timeout(60.0):
            while (found := status(await ask("get_result", b"\0\1\0\0" + GOAL))) != expected:
                assert found == EXECUTING
                await asyncio.sleep(0.1)

    async with fog.edges() as (_, edge, _connect):

        async def publish() -> None:
            while True:
                for channel, message in ((ch.ROBOT_STATE, STATE), (ch.ROBOT_POSE, POSE)):
                    edge.publish(channel, msgspec.structs.replace(message, stamp=time.time()), robot="r-1")
                await asyncio.sleep(0.2)

        publishing = asyncio.create_task(publish())
        client = httpx.AsyncClient(base_url=await fog.ready("planner"), timeout=30.0, headers=tokens["operator"])
        path = "/api/v1/robots/r-1/goal"
        try:
            assert (await ask("send_goal", goal(4.0)))[4] == 1
            deadline = time.monotonic() + UNSEEN_S + 2.0
            while time.monotonic() < deadline:
                await asyncio.sleep(1.0)
                assert status(await ask("get_result", b"\0\1\0\0" + GOAL)) == EXECUTING
            assert (await client.delete(path)).status_code == 204
            await result_is(ABORTED)
            assert (await ask("send_goal", goal(4.0)))[4] == 1
            answer = await ask("cancel_goal", EVERYTHING)
            assert (answer[4], answer[12:28]) == (0, GOAL)
            assert (await client.get(path)).status_code == 404
            await result_is(CANCELED)
        finally:
            publishing.cancel()
            await client.aclose()
            peer.close()


@theirs
async def test_free_fleets_own_adapter_plans_anew_for_a_mission_that_an_operator_ends_and_for_no_other(rig, ros_router):
    peer = await asyncio.create_subprocess_exec(
        os.environ[PEERS], "-u", str(Path(__file__).with_name("free_fleet_peer.py")), os.environ[PROGRAMS],
        f"tcp/127.0.0.1:{ros_router}", "r_1", stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
    )  # fmt: skip

    async def order(text: str) -> list[int]:
        assert peer.stdin is not None
        assert peer.stdout is not None
        peer.stdin.write(f"{text}\n".encode())
        async with asyncio.timeout(60.0):
            return [int(number) for number in (await peer.stdout.readline()).split()]

    try:
        while (await order("navigate 4.0"), rig.floor.asked)[1] == []:
            pass  # the robot is not known to it yet: it has heard no answer
        replans = (await order("update"))[1]
        assert await order("update") == [0, replans], "it goes on"
        rig.end("g1", "cancel")
        assert await order("update") == [0, replans + 1]
        await order("navigate 5.0")
        assert [request.method for request in rig.floor.asked] == ["PUT", "DELETE", "PUT"]
        rig.state("g3")
        rig.plan("g3")
        rig.state(None, waits=True)
        rig.clock.advance(60.0)
        assert await order("update") == [0, replans + 1], "the robot's agent is started anew"
        rig.state("g3", reached=True)
        assert await order("update") == [1, replans + 1]
        await order("navigate 6.0")
        await order("stop")
        assert rig.floor.asked[-1].method == "DELETE"
        assert await order("update") == [2, replans + 1], "what it has canceled itself is done with"
    finally:
        peer.kill()
        await peer.wait()


@theirs
async def test_free_fleets_own_programs_drive_a_robot(rig, tmp_path, ros_router, until):
    root, config = Path(os.environ[PROGRAMS]), tmp_path / "client.json"
    programs = root / "free_fleet_examples" / "free_fleet_examples"
    config.write_text(json.dumps({
        "mode": "client", "connect": {"endpoints": [f"tcp/127.0.0.1:{ros_router}"]},
        "scouting": {"multicast": {"enabled": False}},
    }))  # fmt: skip
    said: list[str] = []

    async def run(name: str, *options: str) -> asyncio.subprocess.Process:
        process = await asyncio.create_subprocess_exec(
            os.environ[PEERS], "-u", str(programs / name), "-c", str(config),
            "-n", "r_1", *options, stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
            env={**os.environ, "PYTHONPATH": str(root / "free_fleet")},
        )  # fmt: skip

        async def read() -> None:
            assert process.stdout is not None
            while line := await process.stdout.readline():
                said.append(line.decode().strip())

        reading.append(asyncio.create_task(read()))
        return process

    reading: list[asyncio.Task[None]] = []
    sender = await run("nav2_send_navigate_to_pose.py", "-x", "4.0", "-y", "3.0")
    try:
        await until(lambda: rig.floor.asked, "the goal has arrived", lambda: "\n".join(said))
        distance = 2.0
        while "Distance remaining: 2.0" not in said or "Result: 2" not in said:
            rig.state("g1", distance=distance)
            rig.fleet.tell_feedback()
            await asyncio.sleep(0.1)
        canceler = await run("nav2_cancel_all_goals.py")
        await until(lambda: "Return code: 0" in said, "the goal is canceled", lambda: "\n".join(said))
        await until(lambda: "Result: 5" in said, "who sent the goal knows", lambda: "\n".join(said))
        await canceler.wait()
    finally:
        sender.kill()
        await sender.wait()
        await asyncio.gather(*reading)
