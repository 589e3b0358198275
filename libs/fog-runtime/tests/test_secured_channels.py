"""Every channel with TLS and passwords: what a role may publish reaches every role that may receive it.

The sessions are opened, subscribed and served as the processes do it (a robot for itself, the fog for all robots), with
the credentials and lists that `fognav ca create` makes. A publisher that learned of no subscription is silent, but not
before it has asked: so many messages are awaited of each, not one.
"""

import asyncio
import contextlib
import dataclasses
import time

import pytest
from channel_traffic import (
    NODES,
    NUMBER,
    ONE_ROBOT,
    PAUSE_S,
    ROBOTS,
    SOURCES,
    WAIT_S,
    Process,
    Traffic,
    copies,
    frozen,
    until,
)
from sample_messages import sample, sample_of
from secured_servers import TESTER

from fog_contracts import channels as ch
from fog_contracts import messages as m
from fog_runtime.clock import SystemClock
from fog_runtime.credentials import Credentials
from fog_runtime.security.site_security import SiteSecurity
from fog_runtime.transports.mqtt_edge import MqttEdge
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fog_supervisor.servers import start_mosquitto, start_router

pytestmark = pytest.mark.live

LARGE = 300_000
"""Bytes of a reply that is fetched in parts."""
ZENOH = [row for row in ch.CHANNELS.values() if row.transport == "zenoh" and row.kind == "pub"]
QUERIES = [row for row in ch.CHANNELS.values() if row.kind == "query"]
MQTT = [row for row in ch.CHANNELS.values() if row.transport == "mqtt"]
WITHOUT_CREDENTIALS = {"thesis-node", "thesis-robot"}
"""Roles of devices that can neither encrypt nor give a name."""


@pytest.fixture(scope="module")
def security(tmp_path_factory):
    made = SiteSecurity(tmp_path_factory.mktemp("locks"), "lab", unrestricted=[TESTER])
    made.make(["127.0.0.1"], robots=ROBOTS, nodes=[*NODES, *SOURCES])
    return made


@pytest.fixture(scope="module")
def router(security, tmp_path_factory):
    with start_router(tmp_path_factory.mktemp("router"), security=security.folder("zenoh")) as server:
        yield server


@pytest.fixture(scope="module")
def broker(security, tmp_path_factory):
    with start_mosquitto(tmp_path_factory.mktemp("broker"), security=security.folder("mosquitto")) as server:
        yield server


# --- zenoh ----------------------------------------------------------------------------------------------------------

ROBOT_PROCESSES = [Process(ch.ROBOT, robot) for robot in ROBOTS]
TOOLS = [Process(role, role) for role in (ch.BRIDGE, ch.CONSOLE, "recorder", ch.SIM, ch.WEB)] + [
    Process(ch.CONSOLE, ch.CONSOLE, ONE_ROBOT),
    Process("recorder", TESTER),
]


class Sessions:
    """The zenoh sessions of several processes."""

    def __init__(self, security, router, stack, traffic):
        self._security, self._router, self._stack, self.traffic = security, router, stack, traffic
        self.edges = {}

    async def open(self, processes, *, subscribed=True):
        """Connect these processes, and subscribe each to whatever it may receive."""
        for process in processes:
            own = Credentials.read(self._security.credentials(process.user))
            opened = ZenohEdge.open(
                connect=[self._router.url], clock=SystemClock(), role=process.role, id=process.user, site="lab",
                credentials=own,
            )  # fmt: skip
            edge = self.edges[process] = await self._stack.enter_async_context(opened)
            assert edge.connected, process
            for row, ids in process.subscriptions(ZENOH) if subscribed else ():
                edge.subscribe(row, row.message, self.traffic.receiver(process, row), **ids)

    async def publish(self, process, row, ids):
        """Publish a sample of a channel as this process."""
        self.edges[process].publish(row, sample_of(row), **ids)

    async def until_all_arrive(self, publishing, subscribing):
        return await self.traffic.until_all_arrive(publishing, subscribing, self.publish, ZENOH)

    async def until_connected(self):
        await until(lambda: all(edge.connected for edge in self.edges.values()), lambda: "not connected")


@pytest.fixture
async def sessions(security, router):
    router.start()
    async with contextlib.AsyncExitStack() as stack:
        yield Sessions(security, router, stack, Traffic())


async def test_every_channel_of_the_router_arrives_also_from_a_copy_that_takes_over_and_after_a_restart(
    sessions, router
):
    first, second = copies("first"), copies("second")
    everybody = [*first, *second, *ROBOT_PROCESSES, *TOOLS]
    await sessions.open(everybody)
    others = [*ROBOT_PROCESSES, *TOOLS]
    arrived = await sessions.until_all_arrive([*first, *others], everybody)
    assert arrived == {row.name for row in ZENOH}
    await sessions.until_all_arrive([*second, *others], everybody)
    router.restart()
    await sessions.until_connected()
    await sessions.until_all_arrive([*first, *others], everybody)
    await sessions.until_all_arrive([*second, *others], everybody)


KEPT = [row for row in ZENOH if row.durability != "volatile"]
NUMBERED = {"map_delta": "seq", "zones": "seq", "places": "epoch", "robot_path": "plan_id", "hazard": "epoch"}
"""By which field the messages of a kept channel are told apart here."""
STORED = 20


def has_all(row, got, last):
    """Whether a subscriber has what it must have when `last` messages were sent: of a recovered channel all, once."""
    numbers = [getattr(message, NUMBERED[row.name]) for message in got]
    if row.durability == "latest":
        return numbers[-1:] == [last - 1]
    assert numbers == list(range(len(numbers))), row.name
    return len(numbers) == last


async def test_late_subscriber_gets_what_was_published_before_and_while_no_router_ran(sessions, router):
    publishers, late = copies("first"), [*copies("late"), *ROBOT_PROCESSES, *TOOLS]
    await sessions.open(publishers, subscribed=False)
    sent = [(process, row, ids) for process in publishers for row, ids in process.publications(KEPT)]
    due = [(other, row, ids) for _, row, ids in sent for other in late if other.receives(row, ids)]

    def publish(numbers):
        for process, row, ids in sent:
            for number in numbers:
                message = sample(row.message, **{NUMBERED[row.name]: number})
                sessions.edges[process].publish(row, message, **ids)

    def without(last):
        got = sessions.traffic.messages
        return [(who, row.name) for who, row, ids in due if not has_all(row, got[who, row.name, frozen(ids)], last)]

    publish(range(STORED))
    await sessions.open(late)
    await until(lambda: not without(STORED), lambda: without(STORED))
    router.stop()
    await until(lambda: not any(edge.connected for edge in sessions.edges.values()), lambda: "still connected")
    publish(range(STORED, 2 * STORED))
    router.start()
    await until(lambda: not without(2 * STORED), lambda: without(2 * STORED))


async def test_every_query_is_answered_to_every_role_that_asks_also_after_a_restart(sessions, router):
    everybody = [*copies("first"), *ROBOT_PROCESSES, *TOOLS]
    await sessions.open(everybody, subscribed=False)
    answered = [*QUERIES, *(row for row in ZENOH if row.durability == "latest")]
    large = sample(m.MapSnapshot, cost=b"c" * LARGE)
    answers = {row: sample(row.reply or row.message) for row in answered} | {ch.MAP_SNAPSHOT: large}
    served = [(process, row, ids) for process in everybody for row, ids in process.publications(answered)]
    for process, row, ids in served:
        sessions.edges[process].serve(row, lambda *_, row=row: answers[row], **ids)

    async def ask_all():
        asked = set()
        for _, row, ids in served:
            for process in everybody:
                if not process.receives(row, ids) or process.role == "recorder":
                    continue
                request = None if row.kind == "pub" or row.message is None else sample(row.message)
                deadline = time.monotonic() + WAIT_S
                while True:
                    reply = await sessions.edges[process].query(row, request, row.reply or row.message, 5.0, **ids)
                    if reply == answers[row]:
                        break
                    assert time.monotonic() < deadline, (process, row.name, ids)
                asked.add((row.name, process.role))
        return asked

    roles = {process.role for process in everybody}
    expected = {(row.name, role) for row in answered for role in row.subscribers if role in roles}
    assert await ask_all() == expected
    router.restart()
    await sessions.until_connected()
    assert await ask_all() == expected


async def test_console_sees_who_is_there_also_after_a_restart(sessions, router):
    console = Process(ch.CONSOLE, ch.CONSOLE)
    present = [*copies("first"), *ROBOT_PROCESSES]
    await sessions.open([*present, console], subscribed=False)
    for process in present:
        sessions.edges[process].declare_liveliness(process.role, process.user)
    expected = {(process.role, process.user) for process in present}

    async def until_seen():
        async with asyncio.timeout(WAIT_S):
            while await sessions.edges[console].present() != expected:  # noqa: ASYNC110  # the router tells nobody unasked
                await asyncio.sleep(PAUSE_S)

    await until_seen()
    router.restart()
    await sessions.until_connected()
    await until_seen()


# --- MQTT -----------------------------------------------------------------------------------------------------------

DEVICES = [
    *(Process(ch.NODE, node) for node in NODES),
    *(Process(ch.ZONE_SOURCE, source) for source in SOURCES),
]
MQTT_TOOLS = [Process(role, role) for role in (ch.CONSOLE, "recorder", "home-assistant", ch.WEB, ch.BRIDGE)]


class Connections:
    """The MQTT connections of several processes."""

    def __init__(self, security, broker, traffic):
        self._security, self._broker, self.traffic = security, broker, traffic
        self.edges = {}
        self._running = []

    async def open(self, processes):
        """Connect these processes, and subscribe each to whatever it may receive."""
        for process in processes:
            own = Credentials.read(self._security.credentials(process.user))
            name = f"{process.user} {process.copy}"
            edge = self.edges[process] = MqttEdge(self._broker.url, name, SystemClock(), site="lab", credentials=own)
            for row, _ in process.subscriptions(MQTT):
                handler = self.traffic.receiver(process, row)
                if row.message is None:
                    edge.on(row, handler, numbers=[NUMBER])
                else:
                    edge.on(row, handler, row.message)
            self._running.append(asyncio.create_task(edge.run()))
        await self.until_connected()

    async def until_connected(self):
        async with asyncio.timeout(WAIT_S):
            for edge in self.edges.values():
                await edge.wait_connected()

    async def publish(self, process, row, ids):
        """Publish a sample of a channel as this process."""
        await self.edges[process].publish(row, sample_of(row), **ids)

    async def close(self):
        for task in self._running:
            task.cancel()
        await asyncio.gather(*self._running, return_exceptions=True)


@pytest.fixture
async def connections(security, broker):
    broker.start()
    made = Connections(security, broker, Traffic())
    yield made
    await made.close()


async def test_every_topic_arrives_also_after_a_restart_of_the_broker(connections, broker):
    everybody = [*copies("first"), *DEVICES, *MQTT_TOOLS]
    everybody = [process for process in everybody if process.role != ch.PLANNER]
    await connections.open(everybody)
    rows = [row for row in MQTT if not WITHOUT_CREDENTIALS.intersection(row.publishers)]
    arrived = await connections.traffic.until_all_arrive(everybody, everybody, connections.publish, rows)
    assert arrived == {row.name for row in rows}
    broker.restart()
    await connections.until_connected()
    await connections.traffic.until_all_arrive(everybody, everybody, connections.publish, rows)


async def test_late_subscriber_gets_what_the_broker_retains_and_nothing_else(connections):
    publishers = [*copies("first")[:2], *DEVICES, *(Process(role, role) for role in (ch.CONSOLE, ch.BRIDGE))]
    late = [*copies("late")[:2], *(dataclasses.replace(each, copy="late") for each in [*MQTT_TOOLS, *DEVICES])]
    await connections.open(publishers)
    rows = [row for row in MQTT if not WITHOUT_CREDENTIALS.intersection(row.publishers)]
    sent = [(process, row, ids) for process in publishers for row, ids in process.publications(rows)]
    for process, row, ids in sent:
        await connections.edges[process].publish(row, sample_of(row), wait=True, **ids)
    await connections.open(late)
    due = {
        (other, row.name, frozen(ids))
        for _, row, ids in sent
        for other in late
        if row.durability == "latest" and other.receives(row, ids)
    }
    await until(lambda: due <= set(connections.traffic.found), lambda: due - set(connections.traffic.found))
    found = {each: count for each, count in connections.traffic.found.items() if each[0] in late}
    assert found == dict.fromkeys(due, 1)
