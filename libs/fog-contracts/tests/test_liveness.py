"""Whether a sender lives: late and queued heartbeats prove nothing, and clocks may drift."""

import math
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fog_contracts.liveness import CLOCK_DRIFT, MAX_CLOCKS, Delays, HeartbeatWatch

MAX_AGE, TRUSTED_AFTER, PERIOD = 1.5, 0.5, 0.2
ORIGIN = 7000.0
"""How far apart the two monotonic clocks are."""


def watch() -> HeartbeatWatch:
    return HeartbeatWatch(MAX_AGE, trusted_after_s=TRUSTED_AFTER)


def beat(watched: HeartbeatWatch, begin: float, end: float, delay: float = 0.0) -> None:
    """Let heartbeats that were sent from `begin` to `end` arrive `delay` later."""
    for i in range(round((end - begin) / PERIOD) + 1):
        watched.on_heartbeat(ORIGIN + begin + i * PERIOD, begin + i * PERIOD + delay)


def test_sender_lives_once_its_heartbeats_kept_arriving_and_until_they_stop():
    watched = watch()
    assert not watched.alive(0.0)
    assert watched.age(0.0) == math.inf
    beat(watched, 0.0, 0.4)
    assert not watched.alive(0.4)
    beat(watched, 0.6, 10.0)
    assert watched.alive(10.0 + MAX_AGE)
    assert not watched.alive(10.0 + MAX_AGE + 0.01)


def test_queued_heartbeats_of_a_sender_that_died_meanwhile_prove_no_life():
    watched = watch()
    beat(watched, 0.0, 10.0)
    for i in range(25):  # sent from 10.2 to 15.0, released together by a broker that was frozen until 30.0
        watched.on_heartbeat(ORIGIN + 10.2 + i * PERIOD, 30.0 + i * 1e-4)
        assert not watched.alive(30.0 + i * 1e-4)
    assert watched.delay_s == pytest.approx(15.0, abs=0.05)
    assert watched.age(30.0) == pytest.approx(15.0, abs=0.05)


def test_queued_heartbeats_of_an_unknown_sender_prove_no_life():
    watched = watch()
    for chunk in (30.0, 30.7):  # in two parts
        for i in range(25):
            watched.on_heartbeat(ORIGIN + (chunk - 30.0) * 10 + i * PERIOD, chunk + i * 1e-4)
            assert not watched.alive(chunk + i * 1e-4)


def test_sender_whose_queued_heartbeats_are_followed_by_timely_ones_lives_again():
    watched = watch()
    beat(watched, 0.0, 10.0)
    for i in range(100):
        watched.on_heartbeat(ORIGIN + 10.2 + i * PERIOD, 30.0)
    assert not watched.alive(30.0)
    beat(watched, 30.2, 30.8)
    assert watched.alive(30.8)


def test_heartbeats_that_come_ten_seconds_late_at_their_usual_rate_are_no_sign_of_life():
    watched = watch()
    beat(watched, 0.0, 10.0)
    beat(watched, 10.2, 60.0, delay=10.0)
    assert not watched.alive(70.0)


@pytest.mark.parametrize("drift", [-2e-4, 2e-4])
def test_clocks_that_drift_apart_for_a_day_cause_no_false_alarm(drift):
    watched, generator = watch(), random.Random(1)
    for i in range(24 * 3600):
        now = i + generator.uniform(0.0, 0.02)
        watched.on_heartbeat(ORIGIN + i * (1 + drift), now)
        assert i == 0 or watched.alive(now + 0.9)


@given(st.lists(st.tuples(st.floats(0.0, 2.0), st.floats(0.0, 5.0)), min_size=1, max_size=60), st.floats(0.0, 10.0))
@settings(max_examples=300, deadline=None)
def test_sender_never_lives_longer_than_the_limit_after_its_last_heartbeat(steps, later):
    """With a first heartbeat that was not delayed, whatever the delays of the others."""
    watched = watch()
    watched.on_heartbeat(ORIGIN, 0.0)
    sent = arrived = 0.0
    for gap, delay in steps:
        sent += gap
        arrived = max(arrived, sent + delay)  # in order
        watched.on_heartbeat(ORIGIN + sent, arrived)
        assert watched.age(arrived) >= arrived - sent - 5e-4 * arrived - 1e-6
    if later > MAX_AGE + 5e-4 * (arrived + later):
        assert not watched.alive(max(arrived, sent + later))


TRIPS = st.lists(st.tuples(st.floats(0.01, 2.0), st.floats(0.0, 20.0)), min_size=1, max_size=60)


@given(TRIPS, st.floats(-1e-4, 1e-4))
@settings(max_examples=300, deadline=None)
def test_delay_is_the_time_on_the_way_beyond_that_of_the_fastest_message_whatever_the_clocks_drift(trips, drift):
    delays, sent, fastest = Delays(), 0.0, math.inf
    for gap, way in trips:
        sent += gap
        fastest = min(fastest, way)
        found = delays.update((1, ORIGIN + sent * (1.0 + drift)), sent + way)
        slack = (CLOCK_DRIFT + 1e-4) * (sent + 20.0) + 1e-6
        assert found >= -1e-9
        assert way - fastest - slack <= found <= way - fastest + slack


def test_clock_of_another_host_begins_anew_and_a_known_one_goes_on():
    delays = Delays()
    assert delays.update((1, 100.0), 0.0) == 0.0
    assert delays.update((2, 5e6), 1.0) == 0.0
    assert delays.update((1, 101.0), 11.0) == pytest.approx(10.0, abs=0.01)
    assert delays.update((2, 5e6 + 1.0), 12.0) == pytest.approx(10.0, abs=0.01)
    assert delays.update(None, 12.0) == 0.0


def test_only_the_latest_clocks_are_remembered():
    delays = Delays()
    for clock in range(MAX_CLOCKS + 1):
        delays.update((clock, 0.0), 0.0)
    assert delays.update((MAX_CLOCKS, 1.0), 11.0) == pytest.approx(10.0, abs=0.01)
    assert delays.update((0, 1.0), 11.0) == 0.0
