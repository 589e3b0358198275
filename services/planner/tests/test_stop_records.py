"""Which stops without a token have an entry of the audit trail, whoever sends them and however often."""

from collections import Counter

from hypothesis import given
from hypothesis import strategies as st

from planner.stop_records import OTHERS, PERIOD_S, SENDERS, StopRecords


def test_first_stops_of_some_senders_are_recorded_alone_and_all_else_is_counted():
    records = StopRecords()
    alone = [records.count("r1", f"s{n}", 0.0) for n in range(SENDERS + 2)]
    assert alone == [True] * SENDERS + [False, False]
    assert not records.count("r1", "s0", 1.0)
    assert records.count("r2", "s0", 1.0), "another robot's stops are another matter"
    assert records.due(PERIOD_S - 0.1) == {}
    assert records.due(PERIOD_S) == {"r1": {OTHERS: 2, "s0": 1}}


def test_sender_who_goes_on_gets_no_entry_of_its_own_again_and_one_who_returns_does():
    records = StopRecords()
    for sender in ("flood", "once", "flood"):
        records.count("r1", sender, 0.0)
    records.recorded("r1", records.due(PERIOD_S)["r1"], PERIOD_S)
    assert not records.count("r1", "flood", PERIOD_S + 1.0)
    assert records.count("r1", "once", PERIOD_S + 1.0)


STOPS = st.lists(
    st.tuples(st.floats(0.0, 400.0), st.sampled_from(["r1", "r2"]), st.integers(0, 7), st.integers(1, 50)), max_size=60
)


@given(STOPS)
def test_every_stop_is_recorded_or_counted_once_in_few_entries(stops):
    records, entries, sent, told = StopRecords(), Counter(), 0, 0
    now = 0.0

    def record() -> None:
        nonlocal told
        for robot, repeats in records.due(now).items():
            entries[robot] += 1
            told += sum(repeats.values())
            records.recorded(robot, repeats, now)

    for pause, robot, sender, repetitions in stops:
        now += pause
        record()
        for _ in range(repetitions):
            sent += 1
            if records.count(robot, f"s{sender}", now):
                entries[robot] += 1
                told += 1
    periods = now / PERIOD_S + 1.0
    assert max(entries.values(), default=0) <= (SENDERS + 1) * periods
    now += PERIOD_S + 1.0
    record()
    assert told == sent
    now += PERIOD_S + 1.0
    record()
    assert records.due(now) == {}
