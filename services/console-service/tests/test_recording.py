"""The last hour: the state at any of its times, whatever was forgotten to make room."""

import json

from hypothesis import given, settings
from hypothesis import strategies as st

from console_service.log import CompactedLog
from console_service.recording import KEEP_S, Frame, Recording, Shown, as_json, pack

CHANGES = st.lists(
    st.lists(st.tuples(st.sampled_from(["zone", "pose"]), st.sampled_from("abc"), st.integers(-1, 3)), max_size=4),
    min_size=1,
    max_size=12,
)


def encoded(thing: str, value: int | None) -> bytes:
    return json.dumps({"id": thing, "value": value}).encode()


def state_after(shown: Shown) -> dict[tuple[str, str], int]:
    state: dict[tuple[str, str], int] = {}
    frames = json.loads(b"[" + b"".join(as_json(shown)) + b"]")
    for event in (event for frame in frames for event in frame["events"]):
        state[event["event"], event["data"]["id"]] = event["data"]["value"]
    return {key: value for key, value in state.items() if value is not None}


@settings(max_examples=150, deadline=None)
@given(steps=CHANGES, keep=st.integers(1, 6), asked=st.tuples(st.integers(0, 12), st.integers(0, 12)))
def test_state_at_any_time_that_is_kept_is_that_of_the_log_then(steps, keep, asked):
    log, recording, states = CompactedLog("r"), Recording(), []
    step_s = KEEP_S / keep
    model: dict[tuple[str, str], int] = {}
    for number, changes in enumerate(steps):
        for event, thing, value in changes:
            if value < 0:
                log.remove(event, thing, encoded(thing, None), 0.0)
                model.pop((event, thing), None)
            else:
                log.put(event, thing, encoded(thing, value))
                model[event, thing] = value
        recording.add(Frame(number * step_s, pack(recording.changes(log))))
        states.append(dict(model))
    first, last = recording.span
    assert last - first <= KEEP_S
    begin, end = sorted(min(max(number * step_s, first), last) for number in asked)
    shown = recording.copy().show(begin, end)
    assert shown.frames[0][0] <= begin
    assert state_after(Shown(shown.frames[:1], None)) == states[round(shown.frames[0][0] / step_s)]
    assert state_after(shown) == states[round(shown.frames[-1][0] / step_s)]


def test_long_answer_is_continued_where_it_ended():
    log, recording = CompactedLog("r"), Recording()
    for number in range(10):
        log.put("pose", "r1", encoded("r1", number))
        recording.add(Frame(float(number), pack(recording.changes(log))))
    seen, begin = [], 0.0
    while begin is not None:
        shown = recording.show(begin, 9.0, limit=50)
        seen += [stamp for stamp, _ in shown.frames]
        begin = shown.next
    assert seen == [float(number) for number in range(10)]


def test_another_map_begins_the_recording_anew():
    log, recording = CompactedLog("r"), Recording()
    log.put("costmap", "0,0", b"{}")
    recording.add(Frame(0.0, pack(recording.changes(log))))
    log.forget("costmap", "0,0")
    log.put("zone", "wet", encoded("wet", 1))
    log.begin_anew()
    recording.add(Frame(5.0, pack(recording.changes(log))))
    assert recording.span == (5.0, 5.0)
    assert [event for event, _, _ in recording.show(0.0, 9.0).frames[0][1]] == ["zone"]
