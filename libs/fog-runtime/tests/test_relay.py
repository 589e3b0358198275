"""The relay before a server: how many connections a user has, and where they end."""

import asyncio
import contextlib
import json
import socket

import pytest
import zenoh

from fog_runtime import admission, relay
from fog_runtime.admission import FEW, Places
from fog_runtime.broker import MqttOpening
from fog_runtime.transports.zenoh_edge import session_config
from fog_supervisor import net

WAIT_S = 60.0
CONNECT = b"\x10\x12\x00\x04MQTT\x04\x82\x00\x1e\x00\x02id\x00\x02"
"""All but a user's name of two letters."""
CONNACK = b"\x20\x02\x00\x00"
OPEN_SYN = bytes.fromhex(
    "c20ae7c0891531308f894938b7736af33af3783b3be6ac0793763a246e7c46af9e2ce8aab1d4ccd97060f6ea30"
    "7f068e0b442342ed481630c212afdaad97a89ba9f17f010001020304050607432642240272312008f91c1fc1d9"
    "6379c3a92494b9610ebc6cad0abdf647de42507bb9107d99ff89"
)
"""What a client of zenoh 1.10.2 sends as the user r1."""
AUTHENTICATION_AT = 76
"""Where its extension begins that names the user."""


class Gone(asyncio.Transport):
    """As asyncio's encrypted transport in Python 3.11.2: once its connection is lost, it can't be aborted."""

    aborted = 0
    lost = False

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        pass

    def close(self) -> None:
        pass

    def abort(self) -> None:
        assert not self.lost
        self.aborted += 1


async def connections(monkeypatch):
    monkeypatch.setattr(relay, "_FLUSH_S", 0.0)
    ends = relay._End(), relay._End()
    for end, other in zip(ends, reversed(ends), strict=True):
        end.other = other
        end.connection_made(Gone())
    return ends


async def test_connection_that_is_lost_after_its_other_end_is_not_ended_again(monkeypatch):
    errors = []
    asyncio.get_running_loop().set_exception_handler(lambda _, context: errors.append(context))
    server, client = await connections(monkeypatch)
    transport = client.transport
    server.connection_lost(None)
    transport.lost = True
    client.connection_lost(None)
    await asyncio.sleep(0.01)
    assert errors == []


async def test_connection_that_does_not_take_what_is_left_is_ended_after_its_other_end(monkeypatch):
    server, client = await connections(monkeypatch)
    server.connection_lost(None)
    await asyncio.sleep(0.01)
    assert client.transport.aborted == 1


@contextlib.asynccontextmanager
async def relaying(connect_to, make_opening):
    """Run a relay; yield its port."""
    with admission.listen(net.LOOPBACK, 0) as listener:
        task = asyncio.create_task(relay.Relay(connect_to, make_opening).serve([listener]))
        yield listener.getsockname()[1]
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)


async def test_message_that_follows_another_does_not_wait_for_its_acknowledgement():
    """The kernel holds small messages back for up to 40 ms (Nagle), unless each accepted connection says no."""
    accepted = asyncio.get_running_loop().create_future()

    class Greeted(asyncio.Protocol):
        def connection_made(self, transport):
            accepted.set_result(transport)

    with admission.listen(net.LOOPBACK, 0) as listener:
        serving = asyncio.create_task(admission.Admission(lambda _: Greeted()).serve([listener]))
        _, writer = await asyncio.open_connection(net.LOOPBACK, listener.getsockname()[1])
        with contextlib.closing(writer):
            writer.write(b"x")
            transport = await asyncio.wait_for(accepted, WAIT_S)
            assert transport.get_extra_info("socket").getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
            transport.abort()
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)


async def test_user_with_too_many_connections_gets_no_more_and_others_do(tmp_path, monkeypatch):
    monkeypatch.setattr(relay, "OF_USER", 2)

    async def let_in(reader, writer):
        with contextlib.closing(writer):
            await reader.read(1)
            writer.write(CONNACK)
            await reader.read()  # until its client leaves

    async with (
        asyncio.timeout(WAIT_S),
        await asyncio.start_unix_server(let_in, tmp_path / "server"),
        relaying(relay.to_socket(tmp_path / "server"), MqttOpening) as port,
        contextlib.AsyncExitStack() as opened,
    ):

        async def let_in_as(user):
            reader, writer = await asyncio.open_connection(net.LOOPBACK, port)
            opened.callback(writer.close)
            writer.write(CONNECT + user)
            try:
                return writer if await reader.read(len(CONNACK)) else None
            except ConnectionResetError:
                return None

        first, second = await let_in_as(b"n1"), await let_in_as(b"n1")
        assert first
        assert second
        assert await let_in_as(b"n1") is None
        assert await let_in_as(b"n2")
        first.close()
        while not await let_in_as(b"n1"):
            pass


@pytest.mark.live
async def test_relay_knows_as_whom_zenoh_has_let_each_client_in(tmp_path, monkeypatch):
    users, seen = {"r1": "secret", "attic.r2": "other", "a" * 200: "long"}, []
    monkeypatch.setattr(relay.Relay, "admitted", lambda _self, _client, user, _source: seen.append(user))
    (tmp_path / "users").write_text("".join(f"{name}:{password}\n" for name, password in users.items()))

    def config(mode, user, password, **endpoints):
        made = session_config(mode, **endpoints)
        made.insert_json5("transport/auth/usrpwd", json.dumps({"user": user, "password": password}))
        return made

    secured = config("router", "router", "x", listen=[f"unixsock-stream/{tmp_path}/zenoh"])
    secured.insert_json5("transport/auth/usrpwd/dictionary_file", json.dumps(str(tmp_path / "users")))
    router = await asyncio.to_thread(zenoh.open, secured)
    async with relaying(relay.to_socket(tmp_path / "zenoh"), relay.ZenohOpening) as port:
        for user, password in users.items():
            opened = await asyncio.to_thread(
                zenoh.open, config("client", user, password, connect=[f"tcp/{net.LOOPBACK}:{port}"])
            )
            await asyncio.to_thread(opened.close)
    await asyncio.to_thread(router.close)
    assert seen == [*users]


@pytest.mark.parametrize("damage", [slice(0, 60), slice(0, 100), slice(0, 3)])
def test_client_that_does_not_say_whole_who_it_is_is_refused(damage):
    with pytest.raises(ValueError, match="end"):
        relay._user_of_open_syn(OPEN_SYN[damage])


def test_client_that_names_two_users_is_refused():
    """Zenoh would take one of them, and the relay the other."""
    assert relay._user_of_open_syn(OPEN_SYN) == "r1"
    twice = bytes((OPEN_SYN[AUTHENTICATION_AT] | relay._MORE,)) + OPEN_SYN[AUTHENTICATION_AT + 1 :]
    with pytest.raises(ValueError, match="more than one user"):
        relay._user_of_open_syn(OPEN_SYN[:AUTHENTICATION_AT] + twice + OPEN_SYN[AUTHENTICATION_AT:])


@pytest.mark.parametrize("size", [1, 2, 3, 7, 200, 10_000])
def test_each_part_of_what_the_broker_says_ends_with_a_packet_or_within_the_first_one(size):
    packets = [CONNACK, b"\x90\x03\x00\x01\x00", b"\x30\x80\x03" + b"x" * 384, b"\xd0\x00", b"\x30\x05\x00\x01tab"]
    whole, opening = b"".join(packets), MqttOpening()
    ends = {sum(map(len, packets[:count])) for count in range(len(packets) + 1)}
    parts = [part for at in range(0, len(whole), size) for part in opening.parts(whole[at : at + size])]
    assert b"".join(parts) == whole
    begun = 0
    for part in parts:
        assert not any(begun < end < begun + len(part) for end in ends), part
        begun += len(part)


KNOWN = "192.168.7.9"


class Waiting:
    """A connection that wants a place."""

    def __init__(self, source):
        self.source = source
        self.places = None


def add(places, *sources):
    """Return whose connections were displaced by new ones of these sources."""
    displaced = [places.add(Waiting(source)) for source in sources]
    return [each.source for each in displaced if each is not None]


def take(places, number):
    """Return whose turn it is, one after another."""
    turns = []
    for _ in range(number):
        visitor = places.next()
        turns.append(visitor.source)
        places.remove(visitor)
    return turns


def test_oldest_of_the_source_with_the_most_is_displaced():
    places = Places(3)
    assert add(places, "a", "b", "b", "c") == ["b"]
    assert take(places, 3) == ["a", "b", "c"]


def test_source_from_which_somebody_was_admitted_keeps_its_place_among_many_others_and_is_next():
    strangers = [f"10.0.0.{number}" for number in range(50)]
    places = Places(10, {KNOWN})
    assert KNOWN not in add(places, KNOWN, *strangers)
    assert KNOWN in take(places, 2)


def test_source_from_which_somebody_was_admitted_gets_no_more_when_many_wait_there():
    places = Places(10, {KNOWN})
    assert add(places, *[KNOWN] * 30, *"abc") == [KNOWN] * 23
    assert set(take(places, 4)) == {KNOWN, *"abc"}


def test_others_have_their_turn_while_few_wait_at_a_source_from_which_somebody_was_admitted():
    places = Places(20, {KNOWN})
    add(places, *"abc", *[KNOWN] * FEW)
    assert set(take(places, 6)) == {KNOWN, *"abc"}
