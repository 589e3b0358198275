"""Which hazards are announced before they are stored, and in what order."""

from hypothesis import given
from hypothesis import strategies as st

from fog_contracts.hazards import is_relief
from fog_contracts.messages import AreaHazard
from hazard_aggregator.outbox import Outbox


def hazard(state: str, seq: int, penalty: int | None = None, area: str = "hall") -> AreaHazard:
    cost = {"blocked": 254, "unknown": 200, "clear": 0}[state] if penalty is None else penalty
    return AreaHazard(area=area, state=state, severity=0, penalty=cost, since=0.0, seq=seq, epoch=1, cause="")


def test_danger_is_announced_at_once_and_relief_once_it_is_stored():
    outbox = Outbox()
    blocked, clear = hazard("blocked", 1), hazard("clear", 2)
    assert outbox.offer([blocked]) == [blocked]
    assert outbox.offer([clear]) == []
    assert outbox.announced() == [blocked]
    assert outbox.withheld() == ["hall"]
    assert outbox.mark_stored([clear]) == [clear]
    assert outbox.announced() == [clear]
    assert outbox.unstored() == []


def test_stored_clear_is_not_announced_after_a_newer_danger():
    outbox = Outbox()
    outbox.offer([hazard("blocked", 1)])
    clear = hazard("clear", 2)
    outbox.offer([clear])
    newer = hazard("blocked", 3)
    assert outbox.offer([newer]) == [newer]
    assert outbox.mark_stored([clear]) == []
    assert outbox.announced() == [newer]
    assert outbox.unstored() == [newer]


states = st.sampled_from([("blocked", 254), ("unknown", 254), ("unknown", 200), ("clear", 0)])


@given(st.lists(st.one_of(states, st.just("store"), st.just("begin")), max_size=60))
def test_no_relief_is_announced_before_it_is_stored(steps):
    outbox = Outbox()
    on_disk: AreaHazard | None = None
    announced: AreaHazard | None = None
    in_flight: list[AreaHazard] = []
    for seq, step in enumerate(steps):
        if step == "begin":
            in_flight = outbox.unstored()
            continue
        if step == "store":
            on_disk = in_flight[0] if in_flight else on_disk
            released = outbox.mark_stored(in_flight)
            in_flight = []
        else:
            released = outbox.offer([hazard(step[0], seq, step[1])])
        for newest in released:
            if is_relief(newest, announced):
                assert on_disk is newest
            assert announced is None or newest.seq > announced.seq
            announced = newest
    assert outbox.announced() == ([announced] if announced else [])
