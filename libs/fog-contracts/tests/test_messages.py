"""What is computed of messages: the digest of hazards, the durations of stages, options that are checked."""

from typing import Annotated

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import structs

from fog_contracts.messages import AggregatorHeartbeat, AreaHazard, Trace, hazards_digest
from fog_contracts.site import OptionError, read_options
from fog_contracts.stages import SPANS, STAGES, TOTAL, Traces, durations_ms, hazard_to_path_ms

HAZARDS = st.lists(
    st.builds(
        AreaHazard, area=st.from_regex(r"[a-z][a-z0-9]{0,5}", fullmatch=True), state=st.just("clear"),
        severity=st.just(0), penalty=st.integers(0, 254), since=st.just(0.0), seq=st.integers(0, 2**53),
        epoch=st.just(1), cause=st.just(""),
    ),
    max_size=8, unique_by=lambda hazard: hazard.area,
)  # fmt: skip


@given(HAZARDS, st.randoms(use_true_random=False))
def test_digest_does_not_depend_on_the_order_and_fits_into_the_heartbeat(hazards, order):
    shuffled = list(hazards)
    order.shuffle(shuffled)
    assert hazards_digest(shuffled) == hazards_digest(hazards)
    AggregatorHeartbeat(epoch=1, areas={}, complete=True, digest=hazards_digest(hazards), uptime=0.0, stamp=0.0)
    assert 0 <= hazards_digest(hazards) < 2**63


@pytest.mark.parametrize("change", [{"seq": 8}, {"state": "unknown"}, {"penalty": 1}, {"area": "gate"}])
def test_digest_covers_area_seq_state_and_penalty(change):
    hazard = AreaHazard(
        area="hall", state="clear", severity=0, penalty=0, since=0.0, seq=7, epoch=1, cause="", nodes={"n1": "clear"}
    )
    assert hazards_digest([structs.replace(hazard, **change)]) != hazards_digest([hazard])
    assert hazards_digest([structs.replace(hazard, cause="another", since=5.0)]) == hazards_digest([hazard])


FULL = Trace(
    area="z1", epoch=1, seq=4, first_reading=10.0, confirmed=10.45, costmap_published=10.47, plan_published=10.5,
    path_received=10.51, first_command=10.6,
)  # fmt: skip


def test_stage_durations_add_up_to_the_total() -> None:
    durations = durations_ms(FULL)
    assert list(durations) == ["debounce", "costmap", "plan", "deliver", "command"]
    assert sum(durations.values()) == pytest.approx(600.0)
    assert hazard_to_path_ms(FULL) == pytest.approx(510.0)


def test_partial_traces_of_one_hazard_are_merged() -> None:
    traces = Traces()
    traces.update([msgspec.structs.replace(FULL, path_received=0.0, first_command=0.0)])
    assert hazard_to_path_ms(traces.earliest("z1", since=9.0)) is None
    traces.update([msgspec.structs.replace(FULL, first_reading=0.0, confirmed=0.0)])
    assert traces.earliest("z1", since=9.0) == FULL


def test_earliest_trace_is_of_the_area_and_not_before_the_given_stamp() -> None:
    traces = Traces()
    earlier = msgspec.structs.replace(FULL, seq=2, first_reading=5.0)
    later = msgspec.structs.replace(FULL, seq=9, first_reading=30.0)
    elsewhere = msgspec.structs.replace(FULL, area="z2", first_reading=9.5)
    traces.update([later, elsewhere, earlier, FULL])
    assert traces.earliest("z1", since=9.0) == FULL
    assert traces.earliest("z3", since=0.0) is None


def test_incomplete_trace_gives_the_durations_of_its_finished_stages() -> None:
    begun = Trace(area="z1", epoch=1, seq=1, first_reading=1.0, confirmed=1.5)
    assert durations_ms(begun) == {"debounce": 500.0}
    assert durations_ms(None) == {}


def test_total_spans_all_stages_without_a_gap() -> None:
    borders = list(STAGES.values())
    assert [end for _, end in borders[:-1]] == [begin for begin, _ in borders[1:]]
    assert SPANS[TOTAL] == (borders[0][0], borders[-1][1])
    assert {stamp for border in borders for stamp in border} == set(Trace.__struct_fields__) - {"area", "epoch", "seq"}


class Limits(msgspec.Struct, kw_only=True):
    low: Annotated[float, msgspec.Meta(ge=0.0)] = 1.0
    high: float


def test_options_are_converted_to_their_type_with_defaults():
    assert read_options(Limits, {"high": 2}) == Limits(low=1.0, high=2.0)


@pytest.mark.parametrize(
    ("given", "field", "text"),
    [
        ({"high": 2, "mid": 1}, "mid", "known: low, high"),
        ({"high": 2, "low": -1}, "low", "Expected `float` >= 0.0"),
        ({"high": "two"}, "high", "Expected `float`"),
        ({}, "", "missing required field `high`"),
    ],
)
def test_unknown_invalid_or_missing_option_is_refused_by_name(given, field, text):
    with pytest.raises(OptionError) as caught:
        read_options(Limits, given)
    assert caught.value.field == field
    assert text in caught.value.problem
