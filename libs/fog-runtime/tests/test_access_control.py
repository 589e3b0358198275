"""The generated access control lists in a real Mosquitto and zenoh router: they allow what they should and no more."""

import asyncio
import contextlib
import json
import queue
import time

import paho.mqtt.client as paho
import pytest
import zenoh
from paho.mqtt.enums import CallbackAPIVersion

from fog_contracts import channels as ch
from fog_contracts import messages as m
from fog_contracts.generate.acl import mqtt_acl, zenoh_acl
from fog_runtime.clock import SystemClock
from fog_runtime.transports import zenoh_edge
from fog_runtime.transports.zenoh_edge import ZenohEdge, session_config
from fog_supervisor.net import free_port
from fog_supervisor.servers import start_mosquitto

pytestmark = pytest.mark.live

WAIT_S = 60.0

# --- MQTT -----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def broker(tmp_path_factory):
    folder = tmp_path_factory.mktemp("broker")
    (folder / "acl").write_text(mqtt_acl("lab"))
    # User names without passwords: only authorization is tested here.
    with start_mosquitto(folder, extra=f"acl_file {folder}/acl") as server:
        yield server


@contextlib.contextmanager
def mqtt_client(broker, user):
    """Yield a connected client with this user name; the messages that it receives go into `received`."""
    client = paho.Client(CallbackAPIVersion.VERSION2, protocol=paho.MQTTv5)
    if user is not None:
        client.username_pw_set(user)
    client.received, client.acknowledged = queue.Queue(), queue.Queue()
    client.on_connect = lambda *_: client.acknowledged.put("connected")
    client.on_subscribe = lambda *_: client.acknowledged.put("subscribed")
    client.on_publish = lambda _client, _data, _mid, code, _properties: client.acknowledged.put(code.getName())
    client.on_message = lambda _client, _data, message: client.received.put((message.topic, message.payload))
    client.connect("127.0.0.1", broker.port)
    client.loop_start()
    try:
        assert client.acknowledged.get(timeout=WAIT_S) == "connected"
        yield client
    finally:
        client.disconnect()
        client.loop_stop()


def publish_result(client, topic, payload=b"x", *, retain=False):
    """Publish with QoS 1 and return the broker's reason code: with QoS 0 a refusal is not reported."""
    client.publish(topic, payload, qos=1, retain=retain)
    return client.acknowledged.get(timeout=WAIT_S)


def lab(channel, **ids):
    return channel.key(site="lab", **ids)


READING = lab(ch.NODE_READING, node="n1")
HAZARD = lab(ch.AREA_HAZARD, area="hall")


@pytest.mark.parametrize(
    ("user", "topic"),
    [
        ("n1", lab(ch.NODE_READING, node="n2")), ("n1", HAZARD), ("n1", lab(ch.NODE_CONFIG, node="n1")),
        ("n1", ch.NODE_READING.key(site="other", node="n1")), ("n1", ch.THESIS_AREA.key(number="3")),
        ("n1", ch.THESIS_WSN.key()), ("n1", "anything/else"), ("+", READING), (None, READING), (None, HAZARD),
        ("thesis-node", ch.THESIS_WSN.key()), ("thesis-node", READING), ("thesis-robot", ch.THESIS_WSN.key()),
        ("map-service", HAZARD), ("recorder", READING), ("hazard-aggregator", READING),
    ],
)  # fmt: skip
def test_broker_refuses_topics_that_a_role_may_not_publish(broker, user, topic):
    with mqtt_client(broker, user) as client:
        assert publish_result(client, topic) == "Not authorized"


def test_broker_delivers_to_each_role_only_what_it_may_receive(broker):
    with contextlib.ExitStack() as stack:
        users = ("hazard-aggregator", "map-service", "n1", "n2", "recorder", None)
        clients = {user: stack.enter_context(mqtt_client(broker, user)) for user in users}
        for client in clients.values():
            client.subscribe([("fog/#", 1), ("WSN", 1), ("area 3", 1)])
            assert client.acknowledged.get(timeout=WAIT_S) == "subscribed"
        thesis = stack.enter_context(mqtt_client(broker, "thesis-node"))
        aggregator = clients["hazard-aggregator"]
        config = {node: lab(ch.NODE_CONFIG, node=node) for node in ("n1", "n2")}
        assert publish_result(clients["n1"], READING, b"reading") == "Success"
        assert publish_result(thesis, "area 3", b"blocked") == "Success"
        assert publish_result(aggregator, HAZARD, b"hazard") == "Success"
        for topic in config.values():
            assert publish_result(aggregator, topic, b"config") == "Success"
        # The broker delivers to each client in order: after the last message all allowed ones have arrived.
        assert publish_result(aggregator, "WSN", b"end") == "Success"
        assert publish_result(aggregator, lab(ch.AREA_DEFINITION, area="hall"), b"end") == "Success"
        sent = [(READING, b"reading"), ("area 3", b"blocked"), (HAZARD, b"hazard"),
                *((topic, b"config") for topic in config.values()), ("WSN", b"end")]  # fmt: skip
        end = (lab(ch.AREA_DEFINITION, area="hall"), b"end")
        expected = {
            "recorder": [*sent, end],
            "map-service": [(HAZARD, b"hazard"), end],
            "n1": [(config["n1"], b"config")],
            "n2": [(config["n2"], b"config")],
        }
        received = {
            user: [clients[user].received.get(timeout=WAIT_S) for _ in messages] for user, messages in expected.items()
        }
        assert received == expected
        first = [aggregator.received.get(timeout=WAIT_S) for _ in range(3)]
        assert first[:2] == [(READING, b"reading"), ("area 3", b"blocked")]
        for user in ("n1", "n2", "map-service", None):
            # The acknowledgement of a subscription arrives after every message that was sent to the client before.
            clients[user].subscribe("$SYS/none", 1)
            assert clients[user].acknowledged.get(timeout=WAIT_S) == "subscribed"
            assert clients[user].received.empty(), user


# --- zenoh ----------------------------------------------------------------------------------------------------------

ROLES = ("hazard-aggregator", "map-service", "planner", "console", "recorder", "sim", "robot-agent", "r1", "r2")


@contextlib.contextmanager
def zenoh_router(folder, acl):
    """Run a router with this access control; each user's password is the user name."""
    (folder / "users").write_text("".join(f"{role}:{role}\n" for role in ROLES))
    (folder / "acl.json5").write_text(acl)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    config = zenoh.Config.from_file(str(folder / "acl.json5"))
    for key, value in {
        "mode": "router", "listen/endpoints": [endpoint], "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False, "transport/shared_memory/enabled": False, "timestamping/enabled": True,
        "transport/auth/usrpwd": {"user": "router", "password": "router", "dictionary_file": str(folder / "users")},
    }.items():  # fmt: skip
        config.insert_json5(key, json.dumps(value))
    session = zenoh.open(config)
    try:
        yield endpoint
    finally:
        session.close()


@pytest.fixture
def opened(monkeypatch):
    """Return a function that opens an edge whose user name and password are its name or role."""

    @contextlib.asynccontextmanager
    async def enter(endpoint, role, name=""):
        user = name or role

        def config_with_user(*arguments, **keys):
            config = session_config(*arguments, **keys)
            config.insert_json5("transport/auth/usrpwd", json.dumps({"user": user, "password": user}))
            return config

        monkeypatch.setattr(zenoh_edge, "session_config", config_with_user)
        async with ZenohEdge.open(
            connect=[endpoint], clock=SystemClock(), role=role, id=name or "lab", site="lab"
        ) as edge:
            assert edge.connected, f"{user} can't connect"
            yield edge

    return enter


async def publish_until(edge, channel, message, condition, expected, **ids):
    """Publish repeatedly: a subscription takes a moment to reach the publisher."""
    deadline = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline, expected
        edge.publish(channel, message, **ids)
        await asyncio.sleep(0.05)


def delta(seq):
    return m.MapDelta(
        epoch=1, seq=seq, part=0, parts=1, layer="cost", x=0, y=0, w=1, h=1, packing="raw", cells=b"0", hash=0
    )


def pose(x):
    return m.RobotPose(x=x, y=0.0, theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.2, height=0.3, stamp=1.0)


def heartbeat(seq):
    return m.MapHeartbeat(epoch=1, seq=seq, hash=0, sent=(0, 1.0))


GOAL = m.RobotGoal(goal_id="g", pose=None)


async def until_present(observer, expected):
    async with asyncio.timeout(60):
        while await observer.present() != expected:  # noqa: ASYNC110  # the router knows, and tells nobody unasked
            await asyncio.sleep(0.02)


async def test_acl_blocks_messages_and_queries_of_a_role_without_the_right(tmp_path, opened):
    with zenoh_router(tmp_path, zenoh_acl("lab", ["r1", "r2"])) as endpoint:
        async with (
            opened(endpoint, "map-service") as map_service,
            opened(endpoint, "planner") as planner,
            opened(endpoint, "robot-agent", "r1") as r1,
            opened(endpoint, "robot-agent", "r2") as r2,
            opened(endpoint, "console") as console,
        ):
            deltas, goals, poses = [], [], []
            r1.subscribe(ch.MAP_DELTA, m.MapDelta, lambda _, message: deltas.append(message.seq))
            console.subscribe(ch.ROBOT_GOAL, m.RobotGoal, lambda ids, _: goals.append(ids["robot"]))
            console.subscribe(ch.ROBOT_POSE, m.RobotPose, lambda ids, _: poses.append(ids["robot"]))
            planner.serve(ch.MAP_SNAPSHOT, lambda *_: None)
            planner.declare_liveliness("map-service", "lab")
            r1.declare_liveliness("robot-agent", "r2")
            # One session's messages arrive in order: forbidden ones are sent before allowed ones.
            for _ in range(3):
                planner.publish(ch.MAP_DELTA, delta(666))
                r1.publish(ch.ROBOT_POSE, pose(1.0), robot="r2")
                r2.publish(ch.ROBOT_GOAL, GOAL, robot="r2")
                await publish_until(planner, ch.ROBOT_GOAL, GOAL, lambda: goals, "goals arrive", robot="r1")
                await publish_until(r1, ch.ROBOT_POSE, pose(1.0), lambda: "r1" in poses, "poses arrive", robot="r1")
                await publish_until(r2, ch.ROBOT_POSE, pose(1.0), lambda: "r2" in poses, "poses arrive", robot="r2")
                await publish_until(map_service, ch.MAP_DELTA, delta(1), lambda: deltas, "deltas arrive")
                assert set(deltas) == {1}
                assert set(goals) == {"r1"}
                goals.clear()
            assert await r1.query(ch.MAP_SNAPSHOT, None, m.MapSnapshot, 1.0) is None
            r2.declare_liveliness("robot-agent", "r2")
            await until_present(console, {("robot-agent", "r2")})


async def test_acl_with_robot_ids_keeps_a_robot_from_publishing_as_another(tmp_path, opened):
    with zenoh_router(tmp_path, zenoh_acl("lab", ["r1", "r2"])) as endpoint:
        async with (
            opened(endpoint, "robot-agent", "r1") as r1,
            opened(endpoint, "planner") as planner,
            opened(endpoint, "recorder") as recorder,
        ):
            poses, goals, recorded = [], [], []
            planner.subscribe(ch.ROBOT_POSE, m.RobotPose, lambda ids, message: poses.append((ids["robot"], message.x)))
            r1.subscribe(ch.ROBOT_GOAL, m.RobotGoal, lambda ids, _: goals.append(ids["robot"]), robot="r2")
            r1.subscribe(ch.ROBOT_GOAL, m.RobotGoal, lambda ids, _: goals.append(ids["robot"]), robot="r1")
            recorder.subscribe(ch.ROBOT_GOAL, m.RobotGoal, lambda ids, _: recorded.append(ids["robot"]))

            def publish_as_other_robot():
                r1.publish(ch.ROBOT_POSE, pose(6.0), robot="r2")
                planner.publish(ch.ROBOT_GOAL, GOAL, robot="r2")
                return poses and "r1" in goals and {"r1", "r2"} <= set(recorded)

            deadline = time.monotonic() + WAIT_S
            while not publish_as_other_robot():
                assert time.monotonic() < deadline, (poses, goals, recorded)
                r1.publish(ch.ROBOT_POSE, pose(1.0), robot="r1")
                planner.publish(ch.ROBOT_GOAL, GOAL, robot="r1")
                await asyncio.sleep(0.05)
            assert set(poses) == {("r1", 1.0)}
            assert set(goals) == {"r1"}


async def test_acl_for_all_sites_identifies_robots_by_their_role(tmp_path, opened):
    with zenoh_router(tmp_path, zenoh_acl()) as endpoint:
        async with opened(endpoint, "robot-agent") as robot, opened(endpoint, "planner") as planner:
            poses, heartbeats = [], []
            planner.subscribe(ch.ROBOT_POSE, m.RobotPose, lambda ids, _: poses.append(ids["robot"]))
            planner.subscribe(ch.MAP_HEARTBEAT, m.MapHeartbeat, lambda _, message: heartbeats.append(message))

            robot.publish(ch.MAP_HEARTBEAT, heartbeat(1))
            await publish_until(robot, ch.ROBOT_POSE, pose(1.0), lambda: poses, "poses arrive", robot="r7")
            robot.publish(ch.MAP_HEARTBEAT, heartbeat(2))
            poses.clear()
            await publish_until(robot, ch.ROBOT_POSE, pose(1.0), lambda: poses, "poses arrive", robot="r7")
            assert heartbeats == []
