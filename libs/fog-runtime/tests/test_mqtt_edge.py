"""The MQTT edge against a real Mosquitto."""

import asyncio
import contextlib
import json
import os
import signal
import subprocess
import time

import aiomqtt
import pytest
from paho.mqtt.publish import multiple
from prometheus_client import REGISTRY

from fog_contracts import channels as ch
from fog_contracts import messages as m
from fog_contracts.codec import ContractError, encode
from fog_runtime.clock import SystemClock
from fog_runtime.transports.mqtt_edge import MqttEdge, MqttEdgeWithInputs, Will
from fog_supervisor.servers import start_mosquitto

pytestmark = pytest.mark.live


@pytest.fixture(scope="module")
def shared_broker(tmp_path_factory):
    with start_mosquitto(tmp_path_factory.mktemp("mosquitto")) as broker:
        yield broker


@pytest.fixture
def broker(shared_broker):
    """Return a running broker, restarted if the previous test killed it."""
    shared_broker.start()
    return shared_broker


@contextlib.asynccontextmanager
async def running(*edges):
    tasks = [asyncio.create_task(edge.run()) for edge in edges]
    try:
        async with asyncio.timeout(60):
            for edge in edges:
                await edge.wait_connected()
        yield
    finally:
        for task in tasks:
            task.cancel()
        ended = await asyncio.gather(*tasks, return_exceptions=True)
    assert all(isinstance(end, asyncio.CancelledError) for end in ended), ended


def make_edge(broker, name, **keys):
    return MqttEdge(broker.url, name, SystemClock(), **{"site": "lab", **keys})


def reading(seq):
    return m.NodeReading(seq=seq, boot=1, uptime_ms=5, range_m=[1.0, None], status=["ok", "no_echo"], state="clear")


def hazard(seq, area="a1"):
    return m.AreaHazard(
        area=area, state="blocked", severity=1, penalty=254, since=1.0, seq=seq, epoch=1, cause="test", nodes={}
    )


def raw_client(broker):
    return aiomqtt.Client("127.0.0.1", broker.port)


async def until(condition, failure, seconds=60.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, failure
        await asyncio.sleep(0.01)


def counter(name, channel):
    return REGISTRY.get_sample_value(name, {"channel": channel.name}) or 0.0


async def test_messages_and_texts_are_delivered_in_order_with_their_ids(broker):
    readings, texts, thesis = [], [], []
    a, b = make_edge(broker, "a"), make_edge(broker, "b")
    b.on(ch.NODE_READING, lambda ids, message: readings.append((ids["node"], message.seq)), m.NodeReading)
    b.on(ch.NODE_AVAILABILITY, lambda ids, text: texts.append((ids["node"], text)))
    b.on(ch.THESIS_AREA, lambda ids, text: thesis.append((ids["number"], text)), numbers=[1, "3"])
    async with running(a, b):
        for n in range(50):
            assert await a.publish(ch.NODE_READING, reading(n), node="n1")
        assert await a.publish(ch.NODE_AVAILABILITY, "online", wait=True, node="n2")
        for number in ("1", "2", "3"):
            assert await a.publish(ch.THESIS_AREA, "blocked", number=number)
        await until(lambda: len(readings) == 50 and texts and len(thesis) == 2, "not all messages arrived")
    assert readings == [("n1", n) for n in range(50)]
    assert ("n2", "online") in texts
    assert thesis == [("1", "blocked"), ("3", "blocked")]
    assert not a.connected


async def test_thesis_area_added_later_is_subscribed_at_once_and_after_a_reconnect(broker):
    received = []
    a, b = make_edge(broker, "a"), make_edge(broker, "b")
    b.on(ch.THESIS_AREA, lambda ids, text: received.append((ids["number"], text)), numbers=[])
    async with running(a, b):
        await b.add_number(ch.THESIS_AREA, 9)
        assert await a.publish(ch.THESIS_AREA, "blocked", wait=True, number="9")
        assert await a.publish(ch.THESIS_AREA, "blocked", wait=True, number="8")
        await until(lambda: received, "no message of the added area")
        broker.kill()
        await until(lambda: not a.connected and not b.connected, "the lost connection is not noticed")
        broker.start()
        await asyncio.gather(a.wait_connected(), b.wait_connected())
        assert await a.publish(ch.THESIS_AREA, "clear", wait=True, number="9")
        await until(lambda: len(received) == 2, "no message after the reconnect")
    assert received == [("9", "blocked"), ("9", "clear")]


async def test_retained_state_reaches_late_subscribers_until_it_is_cleared(broker):
    first, second, third = [], [], []
    a = make_edge(broker, "a")
    async with running(a):
        for n in range(20):
            await a.publish(ch.AREA_HAZARD, hazard(n, "kept"), area="kept")
        assert await a.publish(ch.AREA_HAZARD, hazard(20, "kept"), wait=True, area="kept")
        b = make_edge(broker, "b")
        b.on(ch.AREA_HAZARD, lambda ids, message: first.append((ids["area"], message.seq)), m.AreaHazard)
        async with running(b):
            await until(lambda: ("kept", 20) in first, "no retained hazard")
        c = make_edge(broker, "c")
        c.on(ch.AREA_HAZARD, lambda ids, message: second.append((ids["area"], message.seq)), m.AreaHazard)
        async with running(c):
            assert await a.clear(ch.AREA_HAZARD, wait=True, area="kept")
            await a.publish(ch.AREA_HAZARD, hazard(1, "last"), wait=True, area="last")
            await until(lambda: ("last", 1) in second, "no message after the deletion")
            a.publish_nowait(ch.AREA_HAZARD, None, area="last")
            with pytest.raises(ContractError, match="not retained"):
                a.publish_nowait(ch.NODE_READING, None, node="n1")
        d = make_edge(broker, "d")
        d.on(ch.AREA_HAZARD, lambda ids, _: third.append(ids["area"]), m.AreaHazard)
        async with running(d):
            await a.publish(ch.AREA_HAZARD, hazard(1, "mark"), wait=True, area="mark")
            await until(lambda: third, "no mark")
            await a.clear(ch.AREA_HAZARD, wait=True, area="mark")
    assert first == [("kept", 20)]
    assert third == ["mark"]


async def test_what_is_retained_is_delivered_before_anything_is_said_on_the_connection(broker):
    areas = [f"before{n}" for n in range(90)]  # a broker sends no more than 20 that are not acknowledged
    heard, known = [], []
    a, b = make_edge(broker, "a"), make_edge(broker, "b")

    async def say():
        known.extend(heard)

    b.on(ch.AREA_HAZARD, lambda ids, _: heard.append(ids["area"]), m.AreaHazard)
    b.on_connect(say)
    async with running(a):
        for area in areas:
            await a.publish(ch.AREA_HAZARD, hazard(1, area), wait=True, area=area)
        async with running(b):
            await until(lambda: set(heard) >= set(areas), f"of {len(areas)} retained messages came {len(heard)}")
        for area in areas:
            await a.clear(ch.AREA_HAZARD, wait=True, area=area)
    assert set(known) >= set(areas)


async def test_subscriptions_and_publishing_resume_after_a_restart_of_the_broker(broker):
    seen, on_connect_results = [], []
    a, b = make_edge(broker, "a"), make_edge(broker, "b")
    b.on(ch.NODE_READING, lambda _, message: seen.append(message.seq), m.NodeReading)

    async def publish_on_connect():
        on_connect_results.append(
            await a.publish(ch.AREA_HAZARD, hazard(len(on_connect_results)), wait=True, area="a1")
        )

    a.on_connect(publish_on_connect)
    lost = []
    a.on_connection_lost(lambda: lost.append(a.connected))
    async with running(a, b):
        await a.publish(ch.NODE_READING, reading(1), node="n1")
        await until(lambda: seen == [1] and on_connect_results == [True], "no message before the crash")
        broker.kill()
        await until(lambda: not a.connected and not b.connected, "the loss was not noticed")
        before = counter("fognav_dropped_messages_total", ch.NODE_READING)
        assert not await a.publish(ch.NODE_READING, reading(2), node="n1")
        assert not await a.publish(ch.AREA_HAZARD, hazard(9), wait=True, area="a1")
        assert counter("fognav_dropped_messages_total", ch.NODE_READING) == before + 1
        broker.start()
        await until(lambda: a.connected and b.connected and on_connect_results == [True, True], "no reconnection")
        assert lost == [False]
        assert await a.publish(ch.NODE_READING, reading(3), node="n1")
        await until(lambda: seen == [1, 3], f"no message after the restart: {seen}")


async def test_edge_started_before_its_broker_connects_later(broker):
    broker.stop()
    edge = make_edge(broker, "early")
    task = asyncio.create_task(edge.run())
    await asyncio.sleep(0.3)
    assert not task.done()
    assert not edge.connected
    broker.start()
    await until(lambda: edge.connected, "no connection")
    task.cancel()
    await asyncio.gather(task, return_exceptions=True)


async def test_last_will_is_published_when_the_connection_is_lost(broker):
    texts = []
    observer = make_edge(broker, "w")
    observer.on(ch.NODE_AVAILABILITY, lambda ids, text: texts.append((ids["node"], text)))
    edge = make_edge(broker, "x", will=Will(ch.NODE_AVAILABILITY, "offline", {"node": "gone"}))
    async with running(observer):
        async with running(edge):
            await edge.publish(ch.NODE_AVAILABILITY, "online", wait=True, node="gone")
            # A second client with the same id makes the broker disconnect the first, as a lost link would.
            async with aiomqtt.Client("127.0.0.1", broker.port, identifier="x"):
                await until(lambda: ("gone", "offline") in texts, "no will")
        await observer.clear(ch.NODE_AVAILABILITY, wait=True, node="gone")


@pytest.mark.parametrize(
    ("topic", "payload"),
    [
        ("fog/v1/lab/nodes/n1/reading", b"no json"),
        ("fog/v1/lab/nodes/n1/reading", b"\xff\xfe"),
        ("fog/v1/lab/nodes/n1/reading", b""),
        ("fog/v1/lab/nodes/n1/reading", b"{}"),
        ("fog/v1/lab/nodes/n1/reading", b"x" * 2000),
        ("fog/v1/lab/nodes/N 1/reading", b"{}"),
        ("fog/v1/lab/nodes/n1/reading", json.dumps({"seq": 1, "boot": 1, "uptime_ms": 1, "range_m": [0.0],
                                                "status": ["ok"], "state": "clear"}).encode()),
    ],
)  # fmt: skip
async def test_invalid_message_is_refused_and_counted_and_the_next_is_delivered(broker, topic, payload):
    seen = []
    before = counter("fognav_refused_messages_total", ch.NODE_READING)
    edge = make_edge(broker, "e")
    edge.on(ch.NODE_READING, lambda _, message: seen.append(message.seq), m.NodeReading)
    async with running(edge), raw_client(broker) as client:
        await client.publish(topic, payload)
        await edge.publish(ch.NODE_READING, reading(5), node="n1")
        await until(lambda: seen == [5], "no message after an invalid one")
    assert counter("fognav_refused_messages_total", ch.NODE_READING) == before + 1


async def test_retained_reading_is_refused(broker):
    seen = []
    before = counter("fognav_refused_messages_total", ch.NODE_READING)
    async with raw_client(broker) as client:
        await client.publish("fog/v1/lab/nodes/old/reading", json.dumps({
            "seq": 1, "boot": 1, "uptime_ms": 1, "range_m": [1.0], "status": ["ok"], "state": "clear",
        }), retain=True, qos=1)  # fmt: skip
        edge = make_edge(broker, "e")
        edge.on(ch.NODE_READING, lambda ids, _: seen.append(ids["node"]), m.NodeReading)
        async with running(edge):
            await until(lambda: counter("fognav_refused_messages_total", ch.NODE_READING) == before + 1, "not refused")
            await edge.publish(ch.NODE_READING, reading(1), node="new")
            await until(lambda: seen, "no message")
        await client.publish("fog/v1/lab/nodes/old/reading", b"", retain=True, qos=1)
    assert seen == ["new"]


@pytest.mark.parametrize("stored", [True, False], ids=["known at the start", "added later"])
async def test_topic_at_which_the_broker_ends_the_connection_is_left_out_and_no_other(broker, stored, caplog):
    """Mosquitto closes the connection of whoever subscribes to a topic with a control character."""
    seen, foreign = [], []
    topics = ["doors/a", "doors/\u0001", "doors/b"]

    def on_foreign(topic, payload, _retained):
        foreign.append((topic, payload))

    edge = make_edge(broker, "poisoned")
    edge.on(ch.NODE_READING, lambda ids, _: seen.append(ids["node"]), m.NodeReading)
    if stored:
        await edge.listen_to_foreign(topics, on_foreign)
    async with running(edge), raw_client(broker) as client:
        await edge.listen_to_foreign(topics, on_foreign)
        await until(lambda: "topic_left_out" in caplog.text and edge.connected, "the topic is still tried")
        for topic in ("doors/a", "doors/b"):
            await client.publish(topic, b"1", qos=1)
        await edge.publish(ch.NODE_READING, reading(1), wait=True, node="n1")
        await until(lambda: len(foreign) == 2 and seen, "not everything else is received")
    assert sorted(foreign) == [("doors/a", b"1"), ("doors/b", b"1")]


async def test_messages_are_delivered_after_a_handler_raised(broker):
    seen = []

    def handler(_, message):
        seen.append(message.seq)
        raise RuntimeError("a bug")

    before = counter("fognav_handler_errors_total", ch.NODE_READING)
    edge = make_edge(broker, "e")
    edge.on(ch.NODE_READING, handler, m.NodeReading)
    async with running(edge):
        await edge.publish(ch.NODE_READING, reading(1), node="n1")
        await edge.publish(ch.NODE_READING, reading(2), node="n1")
        await until(lambda: seen == [1, 2], "the second message was not delivered")
    assert counter("fognav_handler_errors_total", ch.NODE_READING) == before + 2


@pytest.fixture
def passwords(tmp_path):
    """Return a password file with the user `fog`."""
    file = tmp_path / "passwords"
    subprocess.run(["mosquitto_passwd", "-b", "-c", str(file), "fog", "p@ss"], check=True, capture_output=True)
    file.chmod(0o600)
    return file


async def test_edge_connects_with_the_url_s_password_and_retries_with_a_wrong_one(tmp_path, passwords):
    extra = f"allow_anonymous false\npassword_file {passwords}"
    with start_mosquitto(tmp_path / "broker", extra=extra) as broker:
        good = MqttEdge(f"mqtt://fog:p%40ss@127.0.0.1:{broker.port}", "good", SystemClock(), site="lab")
        bad = MqttEdge(f"mqtt://fog:wrong@127.0.0.1:{broker.port}", "bad", SystemClock(), site="lab")
        async with running(good):
            task = asyncio.create_task(bad.run())
            done, _ = await asyncio.wait([task], timeout=0.5)
            assert not done
            assert not bad.connected
            assert good.connected
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)


async def test_invalid_url_channel_type_or_message_raises():
    with pytest.raises(ValueError, match="mqtt://"):
        MqttEdge("http://broker", "e", SystemClock(), site="lab")
    edge = MqttEdge("mqtt://127.0.0.1", "e", SystemClock(), site="lab")
    with pytest.raises(ValueError, match="NodeReading"):
        edge.on(ch.NODE_READING, print)
    with pytest.raises(ValueError, match="zenoh"):
        edge.on(ch.ROBOT_POSE, print, m.RobotPose)
    with pytest.raises(ContractError, match="over the limit"):
        await edge.publish(ch.NODE_AVAILABILITY, "x" * 100, node="n1")
    with pytest.raises(ContractError, match="not text"):
        await edge.publish(ch.NODE_READING, "text", node="n1")


@pytest.mark.live
async def test_sites_that_share_a_broker_receive_only_their_own_messages(broker):
    our_messages, their_messages = [], []
    ours, theirs = make_edge(broker, "ours"), make_edge(broker, "theirs", site="other")
    for edge, received in ((ours, our_messages), (theirs, their_messages)):
        edge.on(ch.NODE_READING, lambda ids, message, to=received: to.append((ids, message.seq)), m.NodeReading)
        edge.on(ch.AREA_HAZARD, lambda ids, message, to=received: to.append((ids, message.seq)), m.AreaHazard)
    async with running(ours, theirs):
        assert await theirs.publish(ch.AREA_HAZARD, hazard(2), wait=True, area="shared")
        assert await ours.publish(ch.AREA_HAZARD, hazard(1), wait=True, area="shared")
        await until(lambda: ({"area": "shared"}, 1) in our_messages and their_messages, "no message")
        assert await theirs.clear(ch.AREA_HAZARD, wait=True, area="shared")
        assert await ours.clear(ch.AREA_HAZARD, wait=True, area="shared")
        with pytest.raises(ValueError, match="fills in the site"):
            await ours.publish(ch.NODE_READING, reading(1), site="other", node="n1")
    assert [seq for ids, seq in our_messages if ids == {"area": "shared"}] == [1]
    assert their_messages == [({"area": "shared"}, 2)]


class VanishingBroker:
    """A broker that is lost at the moment when its client disconnects, and then can't be reached."""

    def __init__(self) -> None:
        self.connections = 0

    @contextlib.asynccontextmanager
    async def client(self, *_):
        self.connections += 1
        try:
            yield self
        except asyncio.CancelledError:
            raise aiomqtt.MqttError("Unexpected disconnection") from None

    @property
    async def messages(self):
        await asyncio.Event().wait()
        yield

    async def publish(self, *_args, **_options):
        with contextlib.suppress(asyncio.CancelledError):  # as asyncio.wait_for does when its wait has just ended
            await asyncio.Event().wait()

    unsubscribe = publish

    async def subscribe(self, topics):
        await self.publish()
        return [1] * len(topics)


async def test_cancellation_ends_a_connection_that_is_being_made(broker):
    edge = make_edge(broker, "n1")
    edge._brokers[0] = VanishingBroker()
    edge.on(ch.NODE_READING, lambda *_: None, m.NodeReading)
    running = asyncio.create_task(edge.run())
    for _ in range(3):  # until it waits for the answer to its subscription
        await asyncio.sleep(0)
    running.cancel()
    done, _ = await asyncio.wait([running], timeout=5)
    assert (done, running.cancelled()) == ({running}, True)


async def test_cancellation_ends_a_connection_that_is_lost_meanwhile(broker):
    edge, vanishing = make_edge(broker, "n1"), VanishingBroker()
    edge._brokers[0] = vanishing
    running = asyncio.create_task(edge.run())
    async with asyncio.timeout(60):
        await edge.wait_connected()
        publishing = asyncio.create_task(edge.publish(ch.NODE_READING, reading(1), node="n1"))
        asking = asyncio.create_task(edge.broker_answers())
        await asyncio.sleep(0)
        for task in (asking, publishing, running):
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
    assert vanishing.connections == 1


async def test_what_a_process_says_does_not_wait_behind_inputs_that_it_has_not_read(broker):
    backlog, said = 400, 100  # a client sends no more than 20 publications that are not acknowledged
    heard: list[int] = []

    def slow(_ids, message):
        heard.append(message.seq)
        time.sleep(0.004)  # work: the loop has nothing to wait for

    edge = MqttEdgeWithInputs(broker.url, "slow", SystemClock(), site="lab", inputs=[ch.NODE_READING])
    edge.on(ch.NODE_READING, slow, m.NodeReading)
    topic = ch.NODE_READING.key(site="lab", node="n1")
    async with running(edge):
        # It blocks, and the edge reads nothing meanwhile.
        multiple([(topic, encode(ch.NODE_READING, reading(seq)), 1) for seq in range(backlog)], port=broker.port)
        for seq in range(said):
            edge.publish_nowait(ch.AREA_HAZARD, hazard(seq), area="a1")
        await until(lambda: edge.pending == 0, "the broker acknowledged no hazard")
        assert len(heard) < backlog / 2
        await until(lambda: len(heard) == backlog, "readings were lost")
        assert heard == sorted(heard)


async def test_loss_of_either_connection_is_told_and_only_that_of_the_inputs_to_those_who_need_them(broker):
    lost: list[str] = []
    edge = MqttEdgeWithInputs(broker.url, "two", SystemClock(), site="lab", inputs=[ch.NODE_READING])
    readings: list[m.NodeReading] = []
    edge.on(ch.NODE_READING, lambda _, message: readings.append(message), m.NodeReading)
    edge.on_connection_lost(lambda: lost.append("inputs"))
    async with running(edge):
        for name, expected in (("two", []), ("two-inputs", ["inputs"])):
            async with aiomqtt.Client("127.0.0.1", broker.port, identifier=name):  # a broker ends the older one
                await until(lambda: not edge.connected, f"{name} is still connected")
            await asyncio.wait_for(edge.wait_connected(), 60)
            assert lost == expected
        await edge.publish(ch.NODE_READING, reading(1), node="n1")
        await until(lambda: readings, "no reading after the reconnect")


async def test_broker_that_hangs_answers_no_more_on_a_connection_that_is_up_and_again_when_it_goes_on(broker):
    edge = make_edge(broker, "a")
    assert not await edge.broker_answers()
    both = MqttEdgeWithInputs(broker.url, "b", SystemClock(), site="lab", inputs=[ch.NODE_READING])
    async with running(edge, both):
        assert await edge.broker_answers(60.0)
        assert await both.broker_answers(60.0)
        os.kill(broker.pid, signal.SIGSTOP)
        try:
            assert not await edge.broker_answers(0.2)
            assert not await both.broker_answers(0.2)
            assert edge.connected
        finally:
            os.kill(broker.pid, signal.SIGCONT)
        assert await edge.broker_answers(60.0)
        assert await both.broker_answers(60.0)
