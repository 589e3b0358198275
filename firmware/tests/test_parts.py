"""The core's small parts: its JSON agrees with a well-known parser's, its filter with its rule on recorded spikes."""

import ctypes
import json
import math

import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fog_contracts.messages import NodeConfig

VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=8,
)
OK, NO_ECHO, STUCK = 0, 1, 2


def number_milli(core, text):
    value = ctypes.c_int64()
    function = core["fognav_number_milli"]
    return value.value if function(text.encode(), ctypes.c_uint32(len(text)), ctypes.byref(value)) else None


def filtered(core, samples):
    count = len(samples)
    array = ctypes.c_int32 * count
    status, ranges = array(*(sample[0] for sample in samples)), array(*(sample[1] for sample in samples))
    out_status, out_ranges = array(), array()
    core["fognav_filter"](status, ranges, count, out_status, out_ranges)
    return list(zip(out_status, out_ranges, strict=True))


@given(st.floats(-1e6, 1e6))
@example(0.0005)
@example(-1.0015)
@example(1e-5)
def test_number_is_read_to_the_nearest_thousandth(core, number):
    assert number_milli(core, repr(number)) == pytest.approx(number * 1000, abs=0.5000001)


@pytest.mark.parametrize("text", ["2E0", "20e-1", "0.2e+1", "2.00000000000000000000000001"])
def test_number_in_any_notation(core, text):
    assert number_milli(core, text) == 2000


@pytest.mark.parametrize(
    "text", ["", "-", "01", "1.", ".5", "1e", "1e+", "+1", "0x10", "1e30", "Infinity", "NaN", "1 2"]
)
def test_what_is_no_number_is_refused(core, text):
    assert number_milli(core, text) is None


@given(VALUES)
def test_every_json_value_can_be_skipped_and_none_that_is_cut_short(core, value):
    text = json.dumps(value).encode()
    if _too_large(value):
        return
    assert core["fognav_skip"](text, ctypes.c_uint32(len(text)))
    if text[:1] in b'[{"':
        assert not core["fognav_skip"](text[:-1], ctypes.c_uint32(len(text) - 1))


def _too_large(value):
    """Whether a number in it is beyond what the reader takes for any setting."""
    if isinstance(value, dict):
        return any(map(_too_large, value.values()))
    if isinstance(value, list):
        return any(map(_too_large, value))
    return isinstance(value, int | float) and abs(value) > 1e14


@given(
    st.builds(
        NodeConfig,
        version=st.integers(0, 2**53),
        range_limit_m=st.lists(st.floats(0.001, 20.0), min_size=2, max_size=2),
        range_max_m=st.just([]) | st.lists(st.floats(0.0, 20.0), min_size=2, max_size=2),
        no_echo_is_clear=st.lists(st.booleans(), min_size=2, max_size=2),
        pause_ms=st.integers(10, 60_000),
    ),
    st.dictionaries(st.text(max_size=5), VALUES, max_size=2),
)
def test_every_valid_configuration_is_applied_whatever_else_it_holds(core, make_node, config, other):
    members = {**other, **msgspec.to_builtins(config)}
    if _too_large(other):
        return
    node = make_node()
    text = json.dumps(members).encode()
    assert core.configure(node._node, text, len(text)) is None
    for sonar, limit in enumerate(config.range_limit_m):
        assert core.limit_mm(node._node, sonar) == pytest.approx(limit * 1000, abs=0.5000001)
        farthest = config.range_max_m[sonar] if config.range_max_m else 0.0
        assert core.max_mm(node._node, sonar) == pytest.approx(farthest * 1000, abs=0.5000001)
        assert bool(core.no_echo_is_clear(node._node, sonar)) == config.no_echo_is_clear[sonar]


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "not a JSON object"),
        ("[]", "not a JSON object"),
        ('{"version": 1} x', "not a JSON object"),
        ('{"version": "1", "range_limit_m": [1, 1], "no_echo_is_clear": [true, true]}', "wrong type"),
        ('{"range_limit_m": [1, 1], "no_echo_is_clear": [true, true]}', "version is missing"),
        ('{"version": 1, "no_echo_is_clear": [true, true]}', "range_limit_m is missing"),
        ('{"version": 1, "range_limit_m": [1, 1]}', "no_echo_is_clear is missing"),
        ('{"version": 1, "range_limit_m": [1], "no_echo_is_clear": [true, true]}', "range_limit_m is for another"),
        ('{"version": 1, "range_limit_m": [1, 1], "no_echo_is_clear": [true]}', "no_echo_is_clear is for another"),
        ('{"version": 1, "range_limit_m": [1, 0], "no_echo_is_clear": [true, true]}', "from 0.001 to 20 m"),
        ('{"version": 1, "range_limit_m": [1, 20.1], "no_echo_is_clear": [true, true]}', "from 0.001 to 20 m"),
        (
            '{"version": 1, "range_limit_m": [1, 1], "range_max_m": [1], "no_echo_is_clear": [true, true]}',
            "range_max_m is for another",
        ),
        (
            '{"version": 1, "range_limit_m": [1, 1], "range_max_m": [2, 21], "no_echo_is_clear": [true, true]}',
            "from 0 to 20 m",
        ),
        ('{"version": 1.5, "range_limit_m": [1, 1], "no_echo_is_clear": [true, true]}', "version"),
        ('{"version": 1, "range_limit_m": [1, 1], "no_echo_is_clear": [true, true], "pause_ms": 9}', "pause_ms"),
        ('{"version": 1, "range_limit_m": [1, 1], "no_echo_is_clear": [true, true], "pause_ms": 60001}', "pause_ms"),
    ],
)
def test_invalid_configuration_is_refused_in_words_and_changes_nothing(core, make_node, text, problem):
    node = make_node()
    found = core.configure(node._node, text.encode(), len(text))
    assert problem in found.decode()
    assert [core.limit_mm(node._node, sonar) for sonar in range(2)] == [2000, 2500]


SAMPLES = st.lists(
    st.tuples(st.just(OK), st.integers(20, 4000)) | st.just((NO_ECHO, 0)) | st.just((STUCK, 0)), min_size=1, max_size=40
)


def agree(a, b):
    return a[0] == b[0] and abs(a[1] - b[1]) <= 150


@given(SAMPLES)
def test_filter_reports_only_what_was_measured_and_never_older_than_two_samples(core, samples):
    for at, counted in enumerate(filtered(core, samples)):
        assert counted in samples[max(0, at - 2) : at + 1]


def spikes(samples, out):
    """Return the samples that only themselves confirm: what counts was measured before and after them.

    In a burst the sample before may itself be one that does not count.
    """
    return [
        at
        for at in range(1, len(samples) - 1)
        if out[at - 1] == samples[at - 1]
        and agree(samples[at - 1], samples[at + 1])
        and not agree(samples[at - 1], samples[at])
    ]


@given(SAMPLES)
def test_filter_ignores_what_neither_the_sample_before_nor_the_one_after_confirms(core, samples):
    out = filtered(core, samples)
    for at in spikes(samples, out):
        assert out[at] == out[at - 1]
        assert out[at + 1] == samples[at + 1]


def test_a_burst_is_no_spike_of_a_single_sample(core):
    """Measured between two echoes that do not count themselves: what counted before them still does."""
    burst = [(OK, 1000), (OK, 3000), (OK, 1500), (OK, 3000), (OK, 1000)]
    out = filtered(core, burst)
    assert out[:3] == [(OK, 1000)] * 3
    assert spikes(burst, out) == []


@pytest.mark.data
def test_recorded_spikes_are_filtered_and_the_hand_is_not(core, recordings):
    for file in sorted((recordings / "hcsr04").glob("*.csv")):
        lines = file.read_text().splitlines()[1:]
        samples = [(OK, round(float(line.split(",")[1]) * 10)) for line in lines]
        out = filtered(core, samples)
        found = spikes(samples, out)
        assert found, f"{file.name} holds single-sample spikes"
        assert all(out[at] == out[at - 1] for at in found)
        held = sum(not agree(a, b) for a, b in zip(samples, out, strict=True))
        assert held <= len(found) + math.ceil(0.1 * len(samples))


@pytest.mark.data
def test_recorded_single_spike_never_changes_the_state_whatever_the_limit(core, recordings):
    lines = (recordings / "hcsr04" / "hand_and_object_25s.csv").read_text().splitlines()[1:]
    samples = [(OK, round(float(line.split(",")[1]) * 10)) for line in lines]
    ranges = [metres for _, metres in samples]
    array = ctypes.c_int32 * len(samples)
    changes = 0
    for limit in range(min(ranges) + 1, max(ranges) + 50, 7):
        states = array()
        core["fognav_states"](array(), array(*ranges), len(samples), limit, states)
        for at in range(1, len(samples)):
            if states[at] == states[at - 1]:
                continue
            changes += 1
            alone = not agree(samples[at], samples[at - 1])
            # Three samples in a row of which no two agree: the newest counts, since hiding it may hide somebody.
            scattered = alone and at >= 2 and not agree(samples[at - 1], samples[at - 2])
            assert not alone or scattered, f"sample {at} changed the state by itself, with a limit of {limit} mm"
    assert changes > 100


def test_line_that_is_held_high_or_low_is_stuck(core, make_node, run):
    node = make_node()
    # A line that is held high rises once, when its module is switched on.
    node._trigger = lambda _world, at_us: core.edge(node._node, 0, 1, at_us + 500)
    assert run(node, (3.0, 3.0), 2.0)[0].status == ["no_echo", "stuck"]
    node._trigger = lambda _world, _at_us: None
    last = run(node, (3.0, 3.0), 2.0)[-1]
    assert (last.status, last.state) == (["stuck", "stuck"], "unknown")
