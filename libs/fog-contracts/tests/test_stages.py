import msgspec
import pytest

from fog_contracts.messages import Trace
from fog_contracts.stages import SPANS, STAGES, TOTAL, Traces, durations_ms, hazard_to_path_ms

FULL = Trace(
    area="z1", epoch=1, seq=4, first_reading=10.0, confirmed=10.45, costmap_published=10.47, plan_published=10.5,
    path_received=10.51, first_command=10.6,
)  # fmt: skip


def test_stages_add_up_to_the_whole_way_of_a_hazard() -> None:
    took = durations_ms(FULL)
    assert list(took) == ["debounce", "costmap", "plan", "deliver", "command"]
    assert sum(took.values()) == pytest.approx(600.0)
    assert hazard_to_path_ms(FULL) == pytest.approx(510.0)


def test_traces_of_one_hazard_are_merged_from_whoever_tells_of_them() -> None:
    traces = Traces()
    traces.update([msgspec.structs.replace(FULL, path_received=0.0, first_command=0.0)])
    assert hazard_to_path_ms(traces.first_of("z1", since=9.0)) is None
    traces.update([msgspec.structs.replace(FULL, first_reading=0.0, confirmed=0.0)])
    assert traces.first_of("z1", since=9.0) == FULL


def test_only_the_hazard_of_this_barrier_is_measured() -> None:
    traces = Traces()
    earlier = msgspec.structs.replace(FULL, seq=2, first_reading=5.0)
    later = msgspec.structs.replace(FULL, seq=9, first_reading=30.0)
    elsewhere = msgspec.structs.replace(FULL, area="z2", first_reading=9.5)
    traces.update([later, elsewhere, earlier, FULL])
    assert traces.first_of("z1", since=9.0) == FULL
    assert traces.first_of("z3", since=0.0) is None


def test_a_trace_that_is_under_way_tells_what_it_knows() -> None:
    begun = Trace(area="z1", epoch=1, seq=1, first_reading=1.0, confirmed=1.5)
    assert durations_ms(begun) == {"debounce": 500.0}
    assert durations_ms(None) == {}


def test_the_total_spans_all_stages_without_a_gap() -> None:
    borders = list(STAGES.values())
    assert [end for _, end in borders[:-1]] == [begin for begin, _ in borders[1:]]
    assert SPANS[TOTAL] == (borders[0][0], borders[-1][1])
    assert {stamp for border in borders for stamp in border} == set(Trace.__struct_fields__) - {"area", "epoch", "seq"}
