import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fog_contracts.channels import (
    CHANNELS,
    MAP_DELTA,
    NODE_READING,
    ROBOT_POSE,
    THESIS_AREA,
    THESIS_WSN,
    find_channel,
)

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
        NODE_READING.key(node=bad)
    assert NODE_READING.match(f"fog/v1/nodes/{bad}/reading") is None


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
    assert CHANNELS[channel.name] is channel
    assert channel.about
    assert channel.publishers
    assert channel.subscribers
    assert (channel.reply is None) == (channel.reply_limit == 0)
    assert channel.kind != "query" or channel.reply is not None
    if channel.transport == "zenoh":
        assert channel.template.startswith("fog/{site}/")
        assert not channel.retained
    if channel.rate_hz is not None and channel.max_age_s is not None:
        assert channel.max_age_s > 1 / channel.rate_hz, "stale between two messages of the normal rate"
