"""Readings of a node: their order and age, which state they tell, and which of them count."""

import math

import msgspec
import pytest
from fusion_rig import LIMIT, PERIOD, Rig, measured, site

from fog_contracts.messages import NodeReading
from fog_contracts.site import Sonar
from hazard_aggregator.readings import FORGOTTEN_S, ReadingOrder, Taken


def reading_at(seq: int, uptime_s: float) -> NodeReading:
    return NodeReading(seq=seq, boot=1, uptime_ms=round(1000 * uptime_s), range_m=[3.0], status=["ok"], state="clear")


def test_duplicate_and_outdated_readings_are_ignored():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    rig.seq -= 3
    rig.read(0.8, 3.0, times=3)
    reading = NodeReading(seq=50, boot=1, uptime_ms=10**6, range_m=[0.8, 3.0], status=["ok", "ok"], state="blocked")
    for _ in range(20):
        rig.core.on_reading("n1", reading, rig.now, rig.now)
    assert rig.hazard.state == "clear"
    assert rig.core.pop_rejections() == [("n1", "outdated")] * 2 + [("n1", "duplicate")] + [("n1", "duplicate")] * 19


def test_reading_of_an_earlier_boot_is_ignored_until_the_node_is_silent():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)

    def read_from_boot(boot: int, seq: int) -> None:
        rig.now += PERIOD
        late = NodeReading(
            seq=seq, boot=boot, uptime_ms=100 * seq, range_m=[0.8, 3.0], status=["ok", "ok"], state="blocked"
        )
        rig.core.on_reading("n1", late, rig.now, rig.now)

    read_from_boot(9, 0)
    rig.core.pop_rejections()
    rig.read(3.0, 3.0)
    assert rig.core.pop_rejections() == [("n1", "earlier_boot")]
    for seq in range(1, 5):
        read_from_boot(9, seq)
    assert rig.hazard.state == "blocked", "boots are random: one that was never heard is new, whatever its number"
    rig.wait(FORGOTTEN_S + 0.5)
    rig.read(3.0, 3.0, times=5)
    assert rig.hazard.state == "clear"


def test_node_that_counts_from_zero_again_is_heard_after_thirty_seconds():
    rig = Rig(site("n1"))
    rig.seq = 6000
    rig.read(3.0, 3.0, times=5)
    rig.seq = -1
    rig.read(0.8, 3.0, times=299)
    assert rig.hazard.state == "clear"
    assert set(rig.core.pop_rejections()) == {("n1", "outdated")}
    rig.read(0.8, 3.0, times=7)
    assert rig.hazard.state == "blocked"


@pytest.mark.parametrize("boot", [1, 2])
def test_old_burst_in_any_order_is_not_fresh_after_a_silence(boot):
    order = ReadingOrder()
    for i in range(60):
        order.place(measured(100 + i, uptime_ms=10_000 + 100 * i), 10.0 + i / 10)
    if boot == 2:
        order.place(msgspec.structs.replace(measured(0, uptime_ms=0), boot=2), 16.0)
    late = [order.place(measured(100 + i, uptime_ms=10_000 + 100 * i), 26.0) for i in (3, 7, 4, 5, 6)]
    assert set(late) == {"outdated" if boot == 1 else "earlier_boot"}


def test_seq_of_32_bits_may_wrap():
    rig = Rig(site("n1"))
    rig.seq = 2**32 - 3
    rig.read(3.0, 3.0, times=2)
    rig.seq = -1
    rig.read(3.0, 3.0, times=3)
    assert rig.core.pop_rejections() == []
    assert rig.hazard.state == "clear"


def test_uptime_may_begin_anew():
    order = ReadingOrder()
    for i in range(40):
        uptime = 2**32 - 1000 + 100 * i
        placed = order.place(measured(i, uptime_ms=uptime % 2**32), 500.0 + i / 10)
        assert placed == (pytest.approx(500.0 + i / 10, abs=0.01), True)


def test_burst_of_delayed_readings_is_not_taken_for_fresh_ones():
    rig = Rig(site("n1"))
    rig.read(0.8, 3.0, times=5)
    taken = rig.now
    rig.wait(20.0)
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 254)
    for i in range(1, 160):  # the queue of a frozen broker: sixteen seconds, the last four of which are missing
        reading = measured(rig.seq + i, uptime_ms=round(1000 * (taken + i * PERIOD)))
        rig.changes += rig.core.on_reading("n1", reading, rig.now, rig.now)
    assert (rig.hazard.state, rig.hazard.penalty) == ("unknown", 254)
    assert set(rig.core.pop_rejections()) == {("n1", "late")}


def test_silence_counts_from_when_a_reading_was_taken():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    rig.now += 2.0
    reading = measured(rig.seq + 1, uptime_ms=round(1000 * (rig.now - 1.9)))
    rig.core.on_reading("n1", reading, rig.now, rig.now)
    rig.wait(0.9)
    assert rig.hazard.state == "clear"
    rig.wait(0.5)
    assert rig.hazard.state == "unknown"


def test_readings_closer_together_than_a_node_can_measure_count_as_one():
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    start = round(1000 * rig.now)
    for i in range(1, 20):
        rig.core.on_reading("n1", measured(rig.seq + i, uptime_ms=start + 100 + i, state="blocked"), rig.now, rig.now)
    assert rig.hazard.state == "clear"
    assert rig.core.pop_rejections() == [("n1", "too_soon")] * 18


@pytest.mark.parametrize(
    ("ranges", "state", "cause"),
    [
        ((0.8, 3.0), "clear", "reports clear"),
        ((3.0, 3.0), "blocked", "reports blocked"),
        ((0.001, 3.0), "blocked", "nearer than a sonar can measure"),
        ((3.0,), "clear", "reports 1 sonars"),
        ((3.0, 3.0), "unknown", "the node reports unknown"),
    ],
)
def test_reading_whose_state_contradicts_its_ranges_is_unknown(ranges, state, cause):
    rig = Rig(site("n1"))
    rig.read(3.0, 3.0, times=5)
    rig.read(*ranges, state=state, times=5)
    assert rig.hazard.state == "unknown"
    assert cause in rig.hazard.cause


def test_range_within_rounding_of_the_limit_takes_the_nodes_reported_state():
    rig = Rig(site("n1"))
    rig.read(LIMIT - 0.005, 3.0, state="clear", times=5)
    assert rig.hazard.state == "clear"
    rig.read(LIMIT + 0.005, 3.0, state="blocked", times=5)
    assert rig.hazard.state == "blocked"
    rig.read(LIMIT - 0.005, 0.4, state="clear", times=5)
    assert rig.hazard.state == "unknown"


def test_node_that_stays_blocked_a_little_beyond_the_limit_is_believed_but_not_farther():
    rig = Rig(site("n1"))
    rig.read(LIMIT + 0.045, 3.0, state="blocked", times=5)
    assert rig.hazard.state == "blocked"
    rig.read(LIMIT + 0.07, 3.0, state="blocked", times=5)
    assert rig.hazard.state == "unknown"


def test_no_echo_is_clear_only_where_calibration_found_nothing_in_range():
    free = Rig(site("n1", no_echo_is_clear=True))
    free.read(None, 3.0, state="clear", times=5)
    assert free.hazard.state == "clear"
    walled = Rig(site("n1", no_echo_is_clear=False))
    walled.read(None, 3.0, state="clear", times=20)
    assert walled.hazard.state == "unknown"
    assert "opposite wall" in walled.hazard.cause


@pytest.mark.parametrize("reported", ["clear", "unknown"])
def test_silence_of_all_its_sonars_clears_nothing_since_dead_and_covered_ones_are_silent_too(reported):
    rig = Rig(site("n1", no_echo_is_clear=True))
    rig.read(3.0, 3.0, times=5)
    assert rig.hazard.state == "clear"
    rig.read(None, None, state=reported, times=20)
    assert rig.hazard.state == "unknown"
    assert "dead or covered" in rig.hazard.cause or reported == "unknown"


@pytest.mark.parametrize("reported", ["clear", "unknown"])
def test_echo_from_behind_the_wall_clears_nothing(reported):
    """Wall at 2.1 m: what is flush to it, slants or is soft sends the sound on a detour, and the echo comes late."""
    sonars = [Sonar(angle=angle, range_limit=1.8, range_max=2.4) for angle in (0.0, 0.1)]
    rig = Rig(msgspec.structs.replace(site("n1"), sonars=sonars))
    rig.read(2.1, 2.38, state="clear", times=5)
    assert rig.hazard.state == "clear"
    rig.read(3.3, 2.1, state=reported, times=20)
    assert rig.hazard.state == "unknown"
    assert "none from beyond 2.40 m" in rig.hazard.cause or reported == "unknown"
    rig.read(3.3, 0.8, state="blocked", times=5)
    assert rig.hazard.state == "blocked"


@pytest.mark.parametrize("period", [0.1, 1.0])
@pytest.mark.parametrize("slew", [0.0, 0.5, 5.0, 100.0, -0.5, -5.0, -100.0])
@pytest.mark.parametrize("ppm", [500, 83_333])
def test_readings_count_while_a_nodes_clock_is_slewed_and_afterwards(ppm, slew, period):
    order, uptime, taken = ReadingOrder(), 1000.0, []
    # A slew of nothing: an oscillator that is slow for good.
    lasts = abs(slew) / (1e-6 * ppm) if slew else 20_000.0
    for seq in range(round(min(lasts + 200.0, 20_000.0) / period)):
        now = seq * period
        slewed = 100.0 < now <= 100.0 + lasts
        uptime += period * (1.0 + math.copysign(1e-6 * ppm, slew or -1.0) * slewed)
        taken.append(order.place(reading_at(seq, uptime), 5000.0 + now))
    assert all(isinstance(one, Taken) and one.counts for one in taken)


@pytest.mark.parametrize("ppm", [1_000, 83_333])
def test_slewed_clock_is_followed_though_the_radio_holds_back_readings_now_and_then(ppm):
    order, uptime, arrived, refused = ReadingOrder(), 1000.0, 0.0, 0
    for seq in range(60_000):
        now = 0.1 * seq
        uptime += 0.1 * (1.0 - 1e-6 * ppm * (100.0 < now < 100.0 + 5e6 / ppm))
        arrived = max(arrived, now + max(0.0, 0.4 - now % 10.0))  # every 10 s one waits for 0.4 s, and others behind it
        refused += not isinstance(order.place(reading_at(seq, uptime), 5000.0 + arrived), Taken)
    assert refused == 0


def test_readings_that_the_network_holds_back_for_seconds_do_not_count():
    order = ReadingOrder()
    for seq in range(600):
        assert isinstance(order.place(reading_at(seq, 0.1 * seq), 0.1 * seq), Taken)
    held = [order.place(reading_at(seq, 0.1 * seq), 70.0) for seq in range(600, 700)]
    assert held[:60] == ["late"] * 60
    assert isinstance(held[-1], Taken)
    assert held[-1].at > 69.0
