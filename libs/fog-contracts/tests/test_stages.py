import msgspec
import pytest

from fog_contracts.messages import Trace
from fog_contracts.stages import SPANS, STAGES, TOTAL, Traces, durations_ms, hazard_to_path_ms

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
