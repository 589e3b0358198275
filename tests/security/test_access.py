"""What docs/security.md claims, tried on real servers with the credentials that `fognav ca create` hands out."""

import asyncio
import queue
import socket
import ssl

import paho.mqtt.client as paho
import pytest
from paho.mqtt.enums import CallbackAPIVersion

from fog_contracts import channels as ch
from fog_contracts import messages as m
from fog_runtime.clock import SystemClock
from fog_runtime.credentials import Credentials
from fog_runtime.security.site_security import SiteSecurity
from fog_runtime.stores.redis_connection import RedisConnection, StoreError
from fog_runtime.transports.mqtt_connection import Broker
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fog_supervisor.servers import start_mosquitto, start_redis, start_router

pytestmark = pytest.mark.live

WAIT_S = 60.0
MANY = 10  # more than pass before a publisher learns whether anybody listens
HOSTS = ("127.0.0.1", "localhost")
MQTT_CONNECT = b"\x10\x0f\x00\x04MQTT\x05\x02\x00\x0a\x00\x00\x02me"
"""Of a client without user and password."""


@pytest.fixture(scope="module")
def security(tmp_path_factory):
    made = SiteSecurity(tmp_path_factory.mktemp("locks"), "lab")
    made.make(HOSTS, robots=["r1", "r2"], nodes=["n1", "n2"])
    made.add_floor("attic", robots=["r1"], nodes=["n1"])
    made.add_device("zigbee2mqtt", ["zigbee2mqtt/#"])
    return made


@pytest.fixture(scope="module")
def servers(security, tmp_path_factory):
    folder = tmp_path_factory.mktemp("servers")
    with (
        start_mosquitto(folder / "mosquitto", security=security.folder("mosquitto")) as broker,
        start_redis(folder / "redis", security=security.folder("redis")) as redis,
        start_router(folder / "router", security=security.folder("zenoh")) as router,
    ):
        yield {"mosquitto": broker, "redis": redis, "zenoh": router}


@pytest.mark.parametrize(("program", "said"), [("mosquitto", MQTT_CONNECT), ("redis", b"PING\r\n")])
def test_server_answers_nobody_who_does_not_encrypt(servers, program, said):
    with socket.create_connection(("127.0.0.1", servers[program].port), timeout=WAIT_S) as connection:
        connection.sendall(said)
        try:
            answer = connection.recv(64)
        except ConnectionResetError:
            answer = b""
    assert not answer.startswith((b"\x20", b"+PONG", b"-NOAUTH")), answer


def test_broker_refuses_who_gives_no_name(servers, security):
    context = Credentials.read(security.credentials("n1")).tls_context()
    with socket.create_connection(("127.0.0.1", servers["mosquitto"].port), timeout=WAIT_S) as connection:
        encrypted = context.wrap_socket(connection, server_hostname="localhost")
        encrypted.sendall(MQTT_CONNECT)
        answer = encrypted.recv(64)
        encrypted.close()
    assert answer[:1] == b"\x20"
    assert answer[3] == 0x87, "not authorized"


@pytest.mark.parametrize("program", ["mosquitto", "redis", "zenoh"])
def test_certificate_proves_the_server_s_name_and_no_other(servers, security, program):
    """Who can redirect a connection, but has no key of the server, is noticed."""
    context = Credentials.read(security.credentials("planner")).tls_context()
    for name, accepted in (("localhost", True), ("127.0.0.1", True), ("fog.example", False)):
        with socket.create_connection(("127.0.0.1", servers[program].port), timeout=WAIT_S) as connection:
            if accepted:
                context.wrap_socket(connection, server_hostname=name).close()
            else:
                with pytest.raises(ssl.SSLCertVerificationError, match=r"fog\.example"):
                    context.wrap_socket(connection, server_hostname=name)


def publish_results(server, credentials, topics):
    """Publish on each topic with QoS 1, and return the broker's answers: with QoS 0 a refusal is not reported."""
    client = paho.Client(CallbackAPIVersion.VERSION2, protocol=paho.MQTTv5)
    client.username_pw_set(credentials.user, credentials.passwords["mqtt"])
    client.tls_set_context(credentials.tls_context())
    answers = queue.Queue()
    client.on_connect = lambda *_: answers.put("connected")
    client.on_publish = lambda _client, _data, _mid, code, _properties: answers.put(code.getName())
    client.connect("127.0.0.1", server.port)
    client.loop_start()
    try:
        assert answers.get(timeout=WAIT_S) == "connected"
        found = []
        for topic in topics:
            client.publish(topic, b"x", qos=1)
            found.append(answers.get(timeout=WAIT_S))
        return found
    finally:
        client.disconnect()
        client.loop_stop()


def test_node_publishes_as_itself_and_neither_as_another_nor_as_a_service(servers, security):
    topics = [
        ch.NODE_READING.key(site="lab", node="n1"),
        ch.NODE_READING.key(site="lab", node="n2"),
        ch.AREA_HAZARD.key(site="lab", area="hall"),
        ch.NODE_UPDATE.key(site="lab", node="n1"),
    ]
    own, *others = publish_results(servers["mosquitto"], Credentials.read(security.credentials("n1")), topics)
    assert own in {"Success", "No matching subscribers"}
    assert others == ["Not authorized"] * 3


def test_nodes_and_services_of_a_floor_publish_nothing_on_another(servers, security):
    """The same ids on two floors of one broker are two users, and the thesis's topics belong to the first floor."""
    reading = {site: ch.NODE_READING.key(site=site, node="n1") for site in ("lab", "attic")}
    hazard = {site: ch.AREA_HAZARD.key(site=site, area="hall") for site in ("lab", "attic")}
    for user, allowed, refused in (
        ("n1", [reading["lab"]], [reading["attic"]]),
        ("attic.n1", [reading["attic"]], [reading["lab"], "area 3"]),
        ("hazard-aggregator", [hazard["lab"], "WSN"], [hazard["attic"]]),
        ("attic.hazard-aggregator", [hazard["attic"]], [hazard["lab"], "WSN"]),
    ):
        answers = publish_results(
            servers["mosquitto"], Credentials.read(security.credentials(user)), [*allowed, *refused]
        )
        assert set(answers[: len(allowed)]) <= {"Success", "No matching subscribers"}, user
        assert answers[len(allowed) :] == ["Not authorized"] * len(refused), user


async def test_robot_is_heard_on_its_own_floor_only(servers, security):
    clock = SystemClock()

    def opened(user, role, site):
        own = Credentials.read(security.credentials(user))
        return ZenohEdge.open(
            connect=[servers["zenoh"].url], clock=clock, role=role, id=user.rpartition(".")[2], site=site,
            credentials=own,
        )  # fmt: skip

    def pose(x):
        return m.RobotPose(x=x, y=0.0, theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.2, height=0.3, stamp=1.0)

    heard = {"lab": set(), "attic": set()}
    async with (
        opened("r1", "robot-agent", "lab") as robot,
        opened("attic.r1", "robot-agent", "attic") as upstairs,
        opened("attic.r1", "robot-agent", "lab") as intruder,
        opened("planner", "planner", "lab") as planner,
        opened("attic.planner", "planner", "attic") as planner_upstairs,
    ):
        planner.subscribe(ch.ROBOT_POSE, m.RobotPose, lambda _, message: heard["lab"].add(message.x))
        planner_upstairs.subscribe(ch.ROBOT_POSE, m.RobotPose, lambda _, message: heard["attic"].add(message.x))
        sent = 0
        async with asyncio.timeout(WAIT_S):
            while sent < MANY or not all(heard.values()):
                intruder.publish(ch.ROBOT_POSE, pose(6.0), robot="r1")
                robot.publish(ch.ROBOT_POSE, pose(1.0), robot="r1")
                upstairs.publish(ch.ROBOT_POSE, pose(2.0), robot="r1")
                sent += 1
                await asyncio.sleep(0.05)
    assert heard == {"lab": {1.0}, "attic": {2.0}}


async def test_service_stores_nothing_for_another_floor(servers, security):
    own = Credentials.read(security.credentials("attic.map-service"))
    redis = RedisConnection(servers["redis"].url, timeout_s=WAIT_S, credentials=own)
    try:
        await redis.write(("HSET", "fog:attic:zones", "a", "b"))
        with pytest.raises(StoreError, match="permission"):
            await redis.write(("HSET", "fog:lab:zones", "a", "b"))
    finally:
        await redis.aclose()


def test_credentials_that_are_made_again_keep_the_floors(security):
    before = {user: security.credentials(user).read_text() for user in ("attic.n1", "attic.planner", "n1")}
    again = SiteSecurity(security.directory, "lab")
    again.make(HOSTS, robots=["r1", "r2"], nodes=["n1", "n2"])
    assert again.sites == ["lab", "attic"]
    assert {user: again.credentials(user).read_text() for user in before} == before
    assert "user attic.n1" in (security.folder("mosquitto") / "access").read_text()


@pytest.mark.parametrize(
    ("user", "own", "of_others"),
    [
        ("zigbee2mqtt", "zigbee2mqtt/fire_door", "shellies/door"),
        ("thesis-node", ch.THESIS_AREA.key(number="3"), ch.THESIS_WSN.key()),
    ],
)
def test_sensors_of_others_publish_on_their_own_topics_only(servers, security, user, own, of_others):
    topics = [own, of_others, ch.AREA_HAZARD.key(site="lab", area="hall"), ch.NODE_READING.key(site="lab", node="n1")]
    done, *refused = publish_results(servers["mosquitto"], Credentials.read(security.credentials(user)), topics)
    assert done in {"Success", "No matching subscribers"}
    assert refused == ["Not authorized"] * 3


async def test_home_assistant_discovers_the_areas_of_all_floors_and_its_states_are_sources_there(servers, security):
    """It has one connection: for discovery, its birth and will messages, and `mqtt_statestream`."""

    def client(user):
        own = Credentials.read(security.credentials(user))
        return Broker.of(servers["mosquitto"].url, own).client(user, None)

    async def topics(connection, number):
        async with asyncio.timeout(WAIT_S):
            found = {(await anext(connection.messages)).topic.value}
            while len(found) < number:
                found.add((await anext(connection.messages)).topic.value)
        return found

    state = "homeassistant/binary_sensor/lift_door/state"
    async with (
        client("home-assistant") as home,
        client("hazard-aggregator") as lab,
        client("attic.hazard-aggregator") as up,
    ):
        for_home = set()
        for floor, connection in (("lab", lab), ("attic", up)):
            own = [
                ch.HOME_ASSISTANT_AREA.key(site=floor, area="hall"),
                ch.AREA_HAZARD.key(site=floor, area="hall"),
                ch.AGGREGATOR_AVAILABILITY.key(site=floor),
                ch.AGGREGATOR_ALERTS.key(site=floor),
            ]
            for topic in own:
                await connection.publish(topic, b"x", qos=1, retain=True)
            for_home |= {*own}
            await connection.subscribe([(state, 1), ("homeassistant/status", 1)])
        await home.subscribe([("homeassistant/#", 1), ("fog/v1/#", 1)])
        assert await topics(home, len(for_home)) == for_home
        await home.publish("homeassistant/status", b"online", qos=1, retain=True)
        await home.publish(state, b"off", qos=1, retain=True)
        for connection in (lab, up):
            assert await topics(connection, 2) == {state, "homeassistant/status"}
    refused = [ch.HOME_ASSISTANT_AREA.key(site="lab", area="hall"), ch.AREA_HAZARD.key(site="lab", area="hall"), "door"]
    own = Credentials.read(security.credentials("home-assistant"))
    assert publish_results(servers["mosquitto"], own, refused) == ["Not authorized"] * len(refused)


async def test_robot_neither_changes_the_map_nor_speaks_for_another_robot(servers, security):
    clock = SystemClock()

    def opened(user, role):
        own = Credentials.read(security.credentials(user))
        return ZenohEdge.open(
            connect=[servers["zenoh"].url], clock=clock, role=role, id=user, site="lab", credentials=own
        )

    def delta(seq):
        return m.MapDelta(
            epoch=1, seq=seq, part=0, parts=1, layer="cost", x=0, y=0, w=1, h=1, packing="raw", cells=b"0", hash=0
        )

    def pose(x):
        return m.RobotPose(x=x, y=0.0, theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.2, height=0.3, stamp=1.0)

    deltas, poses = [], []
    async with (
        opened("r1", "robot-agent") as robot,
        opened("map-service", "map-service") as map_service,
        opened("planner", "planner") as planner,
    ):
        planner.subscribe(ch.MAP_DELTA, m.MapDelta, lambda _, message: deltas.append(message.seq))
        planner.subscribe(ch.ROBOT_POSE, m.RobotPose, lambda ids, _: poses.append(ids["robot"]))
        async with asyncio.timeout(WAIT_S):
            while len(deltas) < MANY or len(poses) < MANY:
                robot.publish(ch.MAP_DELTA, delta(666))
                robot.publish(ch.ROBOT_POSE, pose(6.0), robot="r2")
                robot.publish(ch.ROBOT_POSE, pose(1.0), robot="r1")
                map_service.publish(ch.MAP_DELTA, delta(1))
                await asyncio.sleep(0.05)
        assert set(deltas) == {1}
        assert set(poses) == {"r1"}
