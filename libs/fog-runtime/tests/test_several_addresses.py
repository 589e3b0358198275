"""Clients that know several brokers or routers of one site, which share their messages, go on when one of them dies."""

import asyncio
import contextlib
import sys

import pytest

from fog_contracts import channels as ch
from fog_contracts import messages as m
from fog_runtime.clock import SystemClock
from fog_runtime.credentials import Credentials
from fog_runtime.security.site_security import SiteSecurity
from fog_runtime.transports.mqtt_edge import MqttEdge
from fog_runtime.transports.zenoh_edge import ZenohEdge
from fog_supervisor import configurations
from fog_supervisor.net import LOOPBACK, free_port
from fog_supervisor.servers import Server, ServerProgram, start_mosquitto, start_router

pytestmark = pytest.mark.live


def hazard(seq: int) -> m.AreaHazard:
    return m.AreaHazard(
        area="hall", state="blocked", severity=3, penalty=254, since=1.0, seq=seq, epoch=1, cause="test"
    )


def zones(seq: int) -> m.ZoneSet:
    return m.ZoneSet(epoch=1, seq=seq, zones=[], active=[])


class Received:
    """Collects the sequence numbers of messages, and waits for one."""

    def __init__(self) -> None:
        self.seqs: list[int] = []

    def add(self, _ids: object, message: m.AreaHazard | m.ZoneSet) -> None:
        self.seqs.append(message.seq)

    async def until(self, seq: int, publish) -> None:
        """Publish again and again until this one arrives."""
        async with asyncio.timeout(60):
            while seq not in self.seqs:  # another thread or process changes it
                await publish()
                await asyncio.sleep(0.05)


@pytest.fixture
def brokers(tmp_path):
    with start_mosquitto(tmp_path / "first") as first:
        extra = configurations.bridge(f"{LOOPBACK}:{first.port}")
        with start_mosquitto(tmp_path / "second", extra=extra) as second:
            yield first, second


async def test_mqtt_clients_move_to_the_other_broker_and_retained_messages_are_there(brokers):
    first, second = brokers
    clock, received = SystemClock(), Received()
    publisher = MqttEdge(f"{first.url},{second.url}", "publisher", clock, site="lab")
    subscriber = MqttEdge(f"{second.url}, {first.url}", "subscriber", clock, site="lab")
    subscriber.on(ch.AREA_HAZARD, received.add, m.AreaHazard)
    late, received_late = MqttEdge(f"{first.url},{second.url}", "late", clock, site="lab"), Received()
    late.on(ch.AREA_HAZARD, received_late.add, m.AreaHazard)
    tasks = [asyncio.create_task(edge.run()) for edge in (publisher, subscriber)]
    try:
        await received.until(1, lambda: publisher.publish(ch.AREA_HAZARD, hazard(1), area="hall", wait=True))
        first.kill()
        await received.until(2, lambda: publisher.publish(ch.AREA_HAZARD, hazard(2), area="hall", wait=True))
        # The first of its addresses is dead from the beginning.
        tasks.append(asyncio.create_task(late.run()))
        await received_late.until(2, lambda: asyncio.sleep(0))
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)


def test_each_listed_broker_needs_a_valid_address():
    with pytest.raises(ValueError, match="mqtt://host:1883"):
        MqttEdge("mqtt://a:1883,b", "x", SystemClock(), site="lab")


@pytest.fixture
def routers(tmp_path):
    with start_router(tmp_path) as first, contextlib.ExitStack() as stack:
        port = free_port({first.port})
        endpoint = f"tcp/{LOOPBACK}:{port}"
        arguments = [*configurations.router_arguments(endpoint), "--connect", first.endpoint]
        command = (sys.executable, "-m", "fog_runtime.router", *arguments)
        (tmp_path / "second").mkdir()
        program = ServerProgram(name="zenoh-router", port=port, url=endpoint, command=command)
        yield first, stack.enter_context(Server(program, tmp_path / "second"))


async def test_zenoh_clients_move_to_the_other_router_and_queries_are_answered(routers):
    first, second = routers
    clock, received = SystemClock(), Received()
    both = [first.endpoint, second.endpoint]
    async with (
        ZenohEdge.open(connect=both, clock=clock, role="test", id="a", site="lab") as publisher,
        ZenohEdge.open(connect=both[::-1], clock=clock, role="test", id="b", site="lab") as subscriber,
    ):
        subscriber.subscribe(ch.ZONES, m.ZoneSet, received.add)
        publisher.serve(ch.ZONES, lambda _ids, _request: zones(9))

        async def publish(seq: int) -> None:
            publisher.publish(ch.ZONES, zones(seq))

        await received.until(1, lambda: publish(1))
        first.kill()
        await received.until(2, lambda: publish(2))
        async with asyncio.timeout(60):
            while (reply := await subscriber.query(ch.ZONES, None, m.ZoneSet, 1.0)) is None:
                pass
        assert reply.seq == 9


@pytest.fixture
def locked_routers(tmp_path):
    """Two meshed routers that admit only the users of a site, and its credentials."""
    security = SiteSecurity(tmp_path / "locks", "lab")
    security.make([LOOPBACK, "localhost"], copies=True)
    ports: list[int] = []
    for _ in range(2):
        ports.append(free_port(set(ports)))
    with contextlib.ExitStack() as stack:
        urls = [f"tls/{LOOPBACK}:{port}" for port in ports]
        for number, url in enumerate(urls):
            arguments = configurations.router_arguments(url, security=str(security.folder("zenoh")))
            arguments += ["--connect", urls[1 - number], "--credentials", str(security.credentials("peer"))]
            command = (sys.executable, "-m", "fog_runtime.router", *arguments)
            (home := tmp_path / f"router-{number}").mkdir()
            program = ServerProgram(name="zenoh-router", port=ports[number], url=url, command=command)
            stack.enter_context(Server(program, home))
        yield urls, security


async def test_locked_routers_pass_on_what_each_ones_clients_may_send_and_nothing_else(locked_routers):
    (first, second), security = locked_routers
    received = Received()
    sessions = [
        ZenohEdge.open(
            connect=[url], clock=SystemClock(), role=role, id="x", site="lab",
            credentials=Credentials.read(security.credentials(role)),
        )
        for url, role in ((first, "map-service"), (first, "console"), (second, "planner"))
    ]  # fmt: skip
    async with sessions[0] as allowed, sessions[1] as forger, sessions[2] as subscriber:
        subscriber.subscribe(ch.ZONES, m.ZoneSet, received.add)

        async def publish() -> None:
            forger.publish(ch.ZONES, zones(2))
            allowed.publish(ch.ZONES, zones(1))

        await received.until(1, publish)
        await publish()
        await received.until(1, publish)
    assert set(received.seqs) == {1}
