import copy
import math
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fog_contracts import channels
from fog_contracts.channels import (
    CHANNELS,
    DURABILITIES,
    MAP_DELTA,
    NODE_READING,
    ROBOT_POSE,
    ROLES,
    THESIS_AREA,
    THESIS_WSN,
    find_channel,
)
from fog_contracts.messages import UnknownPolicy

ids = st.from_regex(r"[a-z0-9][a-z0-9-]{0,31}", fullmatch=True)
numbers = st.from_regex(r"[0-9]{1,4}", fullmatch=True)


def matches(pattern, key):
    """MQTT's and zenoh's one-level wildcards."""
    parts, levels = pattern.split("/"), key.split("/")
    return len(parts) == len(levels) and all(p in {"+", "*", k} for p, k in zip(parts, levels, strict=True))


@given(data=st.data(), channel=st.sampled_from(list(CHANNELS.values())))
def test_key_and_ids_are_each_others_inverse(data, channel):
    chosen = {name: data.draw(numbers if name == "number" else ids) for name in channel.fields}
    key = channel.key(**chosen)
    assert channel.match(key) == chosen
    assert find_channel(channel.transport, key) == (channel, chosen)
    if "number" not in chosen:
        assert matches(channel.pattern(), key)
        some = dict(list(chosen.items())[:1])
        assert matches(channel.pattern(**some), key)


@given(key=st.text(max_size=60))
def test_a_key_belongs_to_at_most_one_channel(key):
    for transport in ("mqtt", "zenoh"):
        assert sum(c.transport == transport and c.match(key) is not None for c in CHANNELS.values()) <= 1


@pytest.mark.parametrize("bad", ["", "A", "a/b", "+", "#", "*", "**", "a b", "a\n", "-a", "x" * 33, "é"])
def test_malformed_ids_make_no_key_and_match_none(bad):
    with pytest.raises(ValueError, match="node"):
        NODE_READING.key(site="lab", node=bad)
    assert NODE_READING.match(f"fog/v1/lab/nodes/{bad}/reading") is None
    assert NODE_READING.match(f"fog/v1/{bad}/nodes/n1/reading") is None


def test_missing_and_unknown_ids_are_named():
    with pytest.raises(ValueError, match=re.escape("['robot', 'site']")):
        ROBOT_POSE.key(robot="r1")
    with pytest.raises(ValueError, match="colour"):
        MAP_DELTA.key(site="lab", colour="red")


def test_thesis_topics_are_spelt_as_in_the_thesis():
    assert THESIS_AREA.key(number="3") == "area 3"
    assert THESIS_WSN.key() == "WSN"
    with pytest.raises(ValueError, match="wildcard"):
        THESIS_AREA.pattern()


@pytest.mark.parametrize("channel", CHANNELS.values(), ids=lambda c: c.name)
def test_row_is_consistent(channel):
    assert CHANNELS[channel.name] is channel is getattr(channels, channel.name.upper())
    assert channel.publishers
    assert channel.subscribers
    assert {*channel.publishers, *channel.subscribers} <= set(ROLES)
    assert channel.durability in DURABILITIES
    assert channel.message or channel.reply or channel.about, "nothing says what it carries"
    assert (channel.reply is None) == (channel.reply_limit == 0) == (channel.kind != "query")
    assert (channel.limit > 0) == (channel.message is not None or channel.encoding == "text")
    assert bool(channel.message) == (channel.encoding != "text") or channel.kind != "pub"
    assert all(len(word) <= channel.limit for word in channel.words)
    if channel.transport == "zenoh":
        assert channel.template.startswith("fog/{site}/")
        assert channel.encoding == "msgpack"
        assert not channel.retained
        assert channel.qos == 0
    else:
        assert channel.kind == "pub"
        assert channel.durability != "recovered"
        assert channel.template.startswith("fog/v1/{site}/") or "site" not in channel.fields
        assert channel.qos == 1 or not channel.retained, "a lost retained message stays lost"
    if channel.rate_hz is not None:
        assert channel.period_s == pytest.approx(1 / channel.rate_hz)
        assert channel.max_age_s > channel.period_s, "stale between two messages of the normal rate"
    else:
        assert channel.period_s == math.inf


def test_every_channel_of_the_module_is_in_the_table_once():
    rows = [value for value in vars(channels).values() if isinstance(value, channels.Channel)]
    assert {id(row) for row in rows} == {id(row) for row in CHANNELS.values()}
    assert len({(row.transport, row.template) for row in rows}) == len(rows) == len(CHANNELS)


def test_every_role_stands_at_the_end_of_a_channel():
    ends = {role for row in CHANNELS.values() for role in (*row.publishers, *row.subscribers)}
    assert ends | {"recorder"} == set(ROLES)


def test_an_area_becomes_unknown_when_its_nodes_readings_are_stale():
    assert NODE_READING.max_age_s == UnknownPolicy().silent_after_s


def test_channels_are_told_apart_by_identity_and_quick_to_hash():
    twin = copy.copy(NODE_READING)
    assert {NODE_READING: 1}.get(twin) is None
    assert hash(NODE_READING) == object.__hash__(NODE_READING)
