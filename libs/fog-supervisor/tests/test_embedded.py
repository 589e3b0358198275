"""The servers that stand in where nothing can be installed: with the same users they admit the same."""

import asyncio
import contextlib
import socket
import ssl
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

import aiomqtt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from redis.asyncio import Redis
from redis.asyncio.retry import Retry
from redis.backoff import ConstantBackoff
from redis.exceptions import AuthenticationError, BusyLoadingError, NoPermissionError

from fog_runtime.credentials import Credentials
from fog_runtime.security.site_security import SiteSecurity
from fog_supervisor.embedded_broker import AccessList, Passwords, matches
from fog_supervisor.servers import (
    Server,
    embedded_broker_program,
    embedded_redis_program,
    free_port,
    mosquitto_program,
)

WAIT_S = 60.0


@pytest.mark.parametrize(
    ("pattern", "topic", "covered"),
    [
        ("fog/v1/+/nodes", "fog/v1/estig/nodes", True),
        ("fog/v1/+/nodes", "fog/v1/estig", False),
        ("fog/v1/#", "fog/v1", True),
        ("fog/#", "fog/v1/+/nodes/#", True),
        ("fog/+", "fog/#", False),
        ("fog/+", "fog/+", True),
        ("fog/a", "fog/+", False),
        ("#", "$SYS/broker", False),
        ("$SYS/#", "$SYS/broker", True),
    ],
)
def test_pattern_covers_topics_and_filters(pattern, topic, covered):
    assert matches(pattern.split("/"), topic.split("/")) is covered


LEVEL = st.sampled_from(["a", "b", "+"])


@given(st.lists(LEVEL, min_size=1, max_size=4), st.lists(LEVEL, min_size=1, max_size=4), st.booleans(), st.booleans())
def test_filter_is_covered_only_if_each_of_its_topics_is(pattern, subscribed, open_pattern, open_filter):
    pattern += ["#"] * open_pattern
    subscribed += ["#"] * open_filter
    if matches(pattern, subscribed):
        plain = [level.replace("+", "b") for level in subscribed if level != "#"]
        assert matches(pattern, plain)
        assert not open_filter or matches(pattern, [*plain, "deeper", "still"])


def test_denied_topics_win_and_patterns_name_the_user():
    access = AccessList.parse(
        "# a comment\nuser old\ntopic readwrite +\ntopic deny  WSN\n\npattern write nodes/%u/reading\n"
    )
    assert access.allows("old", "write", "area 3")
    assert not access.allows("old", "read", "WSN")
    assert access.allows("n1", "write", "nodes/n1/reading")
    assert not access.allows("n1", "write", "nodes/n2/reading")
    assert not access.allows("n1", "read", "nodes/n1/reading")
    with pytest.raises(ValueError, match="no line of an access list"):
        AccessList.parse("topics read #")
    with pytest.raises(ValueError, match="no line of an access list"):
        AccessList.parse("user a\ntopic a/b")


def test_patterns_deny_too_and_a_comment_needs_no_blank():
    access = AccessList.parse(
        "#comment\nuser n1\ntopic read nodes/n1/secret\n\npattern read nodes/%u/#\npattern deny nodes/%u/secret\n"
    )
    assert access.allows("n2", "read", "nodes/n2/reading")
    assert not access.allows("n2", "read", "nodes/n2/secret")
    assert access.allows("n1", "read", "nodes/n1/secret")  # its own lines go before the patterns


def test_hash_that_can_not_be_read_admits_nobody():
    passwords = Passwords.parse("a:$7$20000$!$!\nb:plain\nc\n")
    assert not any(passwords.right(user, "plain") for user in "abcd")


@pytest.fixture
def security(tmp_path: Path) -> SiteSecurity:
    made = SiteSecurity(tmp_path / "locks", "estig")
    made.make(["localhost", "127.0.0.1"], robots=["r1"], nodes=["n1", "n2"])
    return made


def stand_in(folder: Path, security: SiteSecurity) -> Server:
    return Server(embedded_broker_program(free_port(), security=security.folder("mosquitto")), folder)


def mosquitto(folder: Path, security: SiteSecurity) -> Server:
    return Server(mosquitto_program(folder, free_port(), security=security.folder("mosquitto")), folder)


def client(broker: Server, security: SiteSecurity, user: str, **changes: object) -> aiomqtt.Client:
    own = Credentials.read(security.credentials(user))
    tls = ssl.create_default_context(cadata=own.authority)
    options = {"username": user, "password": own.passwords["mqtt"], "tls_context": tls, "timeout": WAIT_S, **changes}
    return aiomqtt.Client("127.0.0.1", broker.port, protocol=aiomqtt.ProtocolVersion.V311, **options)


async def next_of(subscriber: aiomqtt.Client) -> tuple[str, object]:
    message = await asyncio.wait_for(anext(aiter(subscriber.messages)), WAIT_S)
    return str(message.topic), message.payload


def text(words: str) -> bytes:
    return struct.pack(">H", len(words)) + words.encode()


def packet(kind: int, body: bytes) -> bytes:
    assert len(body) < 128
    return bytes((kind, len(body))) + body


@contextlib.contextmanager
def cut_connection(
    broker: Server, security: SiteSecurity, user: str, will: tuple[str, str]
) -> Iterator[Callable[..., None]]:
    """Yield how to publish; the connection ends without a word (MQTT 3.1.1, sections 3.1, 3.3)."""
    own = Credentials.read(security.credentials(user))
    tls = ssl.create_default_context(cadata=own.authority)
    body = text("MQTT") + struct.pack(">BBH", 4, 0xC6 | 0x28, 30) + text(user) + text(will[0]) + text(will[1])
    with (
        socket.create_connection(("127.0.0.1", broker.port), timeout=WAIT_S) as plain,
        tls.wrap_socket(plain, server_hostname="127.0.0.1") as connection,
    ):
        connection.sendall(packet(0x10, body + text(user) + text(own.passwords["mqtt"])))
        assert connection.recv(4) == b"\x20\x02\x00\x00"

        def publish(topic: str, payload: str, *, retain: bool = False) -> None:
            connection.sendall(packet(0x30 | retain, text(topic) + payload.encode()))

        yield publish


@pytest.mark.live
@pytest.mark.parametrize("start", [mosquitto, stand_in])
async def test_brokers_admit_and_refuse_the_same(
    start: Callable[[Path, SiteSecurity], Server], tmp_path: Path, security: SiteSecurity
) -> None:
    prefix = "fog/v1/estig"
    with start(tmp_path, security) as broker:
        for changes in ({"password": "wrong"}, {"username": "n3"}, {"tls_context": None, "timeout": 1.0}):
            with pytest.raises(aiomqtt.MqttError):
                async with client(broker, security, "n1", **changes):
                    pass
        async with client(broker, security, "hazard-aggregator") as aggregator:
            await aggregator.subscribe(f"{prefix}/nodes/+/reading", qos=0)
            await aggregator.subscribe(f"{prefix}/nodes/+/availability", qos=1)
            await aggregator.publish(f"{prefix}/areas/z1/hazard", "blocked", qos=1, retain=True)
            with cut_connection(broker, security, "n1", will=(f"{prefix}/nodes/n1/availability", "offline")) as publish:
                publish(f"{prefix}/nodes/n2/reading", "in the name of another")
                publish(f"{prefix}/areas/z1/hazard", "clear", retain=True)
                publish(f"{prefix}/nodes/n1/reading", "own")
                assert await next_of(aggregator) == (f"{prefix}/nodes/n1/reading", b"own")
            assert await next_of(aggregator) == (f"{prefix}/nodes/n1/availability", b"offline")
        async with client(broker, security, "map-service") as later:
            await later.subscribe(f"{prefix}/areas/+/hazard", qos=1)
            assert await next_of(later) == (f"{prefix}/areas/z1/hazard", b"blocked")


@pytest.mark.live
async def test_stand_in_for_redis_admits_its_users_to_their_keys(tmp_path: Path, security: SiteSecurity) -> None:
    program = embedded_redis_program(tmp_path, free_port(), security=security.folder("redis"))
    password = Credentials.read(security.credentials("map-service")).passwords["redis"]
    with Server(program, tmp_path) as server:
        async with Redis.from_url(program.url, username="map-service", password=password) as own:
            await own.set("fog:estig:zones", "wet floor")
            assert (await own.config_get("appendfsync"))["appendfsync"] == "always"
            with pytest.raises(NoPermissionError):
                await own.set("fog:estig:areas", "clear")
        async with Redis.from_url(program.url) as stranger:
            with pytest.raises(AuthenticationError):
                await stranger.get("fog:estig:zones")
        server.kill()
        server.start()
        loading = {"retry": Retry(ConstantBackoff(0.1), 100), "retry_on_error": [BusyLoadingError]}
        async with Redis.from_url(program.url, username="map-service", password=password, **loading) as own:
            assert await own.get("fog:estig:zones") == b"wet floor"
