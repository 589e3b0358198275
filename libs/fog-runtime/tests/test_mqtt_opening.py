"""What a relay makes of the first packets of MQTT connections, however they are cut into pieces."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fog_runtime.broker import MalformedError, MqttOpening, with_user_in_id

LEVELS = [3, 4, 5, 0x83, 0x84]
WORDS = st.text(alphabet="abcXYZ019-_.", max_size=200)


def text(data: bytes) -> bytes:
    return struct.pack(">H", len(data)) + data


def length(size: int) -> bytes:
    return bytes((size,)) if size < 128 else bytes((size % 128 | 128, size // 128))


def connect(level: int, client: str, user: str, *, will: bool) -> bytes:
    name = b"MQIsdp" if level & 0x7F == 3 else b"MQTT"
    properties = b"\x05\x11\x00\x00\x00\x0a" if level == 5 else b""
    body = (
        text(name) + struct.pack(">BBH", level, 0xC2 | (0x04 if will else 0), 30) + properties + text(client.encode())
    )
    if will:
        body += (b"\x00" if level == 5 else b"") + text(b"fog/a") + text(b"\x00\xff")
    body += text(user.encode()) + text(b"secret")
    return b"\x10" + length(len(body)) + body


@given(st.sampled_from(LEVELS), WORDS, WORDS, st.booleans(), st.binary(max_size=20), st.lists(st.integers(0, 900)))
def test_client_id_gets_the_users_name_and_nothing_else_changes(level, client, user, will, rest, cuts):
    sent = connect(level, client, user, will=will) + rest
    opening, at, passed = MqttOpening(), 0, b""
    for cut in [*sorted(cuts), len(sent)]:
        passed += opening.from_client(sent[at:cut])
        at = max(at, cut)
    own = f"{user}/{client}" if user and client else client
    assert passed == connect(level, own, user, will=will) + rest


@given(st.binary(max_size=300))
def test_nonsense_is_passed_on_unchanged_or_held_back_or_refused(data):
    try:
        passed = MqttOpening().from_client(data)
    except MalformedError:
        return
    assert len(passed) in {0, *range(len(data), len(data) + 400)}


@pytest.mark.parametrize(
    "data", [b"GET / HTTP/1.1", b"\x10\xff\xff\xff\xff\x01", b"\x10\xff\xff\x7f", b"\x10\x03\x00\x04M"]
)
def test_what_is_no_connect_packet_is_refused(data):
    with pytest.raises(MalformedError):
        MqttOpening().from_client(data)


def test_client_of_a_version_whose_user_the_broker_reads_elsewhere_is_refused():
    """Mosquitto takes this for n2's client with the id of n1's, and ended that one's connection."""
    will = b"\x00" + text(b"fog/a") + text(bytes(30_000))
    body = text(b"MQTT") + struct.pack(">BBH", 0x85, 0xC6, 30) + text(b"n1/node-lab-n1") + will + text(b"n2")
    with pytest.raises(MalformedError, match="version 0x85"):
        with_user_in_id(body + text(b"secret"))


@pytest.mark.parametrize(
    ("answer", "admitted"),
    [
        (b"\x20\x02\x00\x00", True),
        (b"\x20\x02\x00\x05", False),
        (b"\x20\x13\x00\x87", False),
        (b"\x20\x13\x01\x00", True),
    ],
)
def test_client_is_admitted_when_the_broker_says_so(answer, admitted):
    opening = MqttOpening()
    assert [opening.admits(bytes((byte,))) for byte in answer] == [False, False, False, admitted]
