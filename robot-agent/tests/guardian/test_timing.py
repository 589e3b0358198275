"""Looks at the base are seldom and yet soon after each frame, and heartbeats come in time for the watchdog."""

from __future__ import annotations

import itertools
import math
import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_agent.guardian.timing import (
    EARLIER_S,
    FRAMES,
    HEARTBEAT_MAX_S,
    HEARTBEAT_MIN_S,
    LATENESS_S,
    LATER_S,
    UNKNOWN_S,
    FrameClock,
    Heartbeats,
    silence_limit,
)

FRAME_S = 0.015
END_S = 6.0
WAKING_S = 0.0015
"""By so much the kernel, which counts in milliseconds, wakes a process late."""
LATE_S = FRAME_S + LATER_S + 3.0 * WAKING_S


class Base:
    """The frames of a base, and when each was whole; `damaged` ones are not valid."""

    def __init__(self, phase=0.0, period=FRAME_S, jitter=0.0, seed=0, damaged=()):
        chance = random.Random(seed)
        numbers = [number for number in range(int(END_S / period)) if number not in damaged]
        self.whole = [phase + number * period + chance.uniform(0.0, jitter) for number in numbers]
        self.restart()

    def restart(self):
        """Let no frame have been read yet."""
        self._waiting = list(self.whole)

    def read(self, until):
        """Return how many frames have come, and take them away."""
        count = sum(at <= until for at in self._waiting)
        del self._waiting[:count]
        return count


def looks_at(base, frame_s=FRAME_S, seed=0):
    """Return the times of the looks of a guardian whose wheels turn all the time."""
    chance, clock, now = random.Random(seed), FrameClock(frame_s), 0.0
    clock.begin(now)
    times = []
    while now < END_S - 2.0 * FRAME_S:
        now += math.ceil(1000.0 * clock.wait(now)) / 1000.0 + chance.uniform(0.0, WAKING_S - 0.001)
        clock.on_look(base.read(now), now)
        times.append(now)
        now += 0.0003
    return times


def delays(base, looks):
    """Return how long each frame waited for its look."""
    following = iter(looks)
    look, waits = next(following), []
    for at in base.whole:
        while look < at:
            look = next(following, math.inf)
        if look < math.inf:
            waits.append(look - at)
    return waits


@given(
    phase=st.floats(0.0, FRAME_S),
    drift=st.floats(-0.01, 0.01),
    jitter=st.floats(0.0, 0.001),
    seed=st.integers(0, 99),
)
def test_each_frame_is_looked_at_soon_whatever_its_phase_and_exact_rate(phase, drift, jitter, seed):
    base = Base(phase, FRAME_S * (1.0 + drift), jitter, seed)
    looks = looks_at(base, seed=seed)
    waits = delays(base, looks)
    # As if one looked once a frame: then it waits for 15 ms at most, and for 7.5 on average at no particular moment. A
    # base 1 % faster than it says drifts through all moments, and stays long at the late ones.
    assert sum(waits) / len(waits) < FRAME_S
    assert max(waits) < LATE_S
    assert len(looks) / looks[-1] < 1.4 / (FRAMES * FRAME_S)


@given(
    slower=st.floats(1.01, 1.4), phase=st.floats(0.0, FRAME_S), jitter=st.floats(0.0, 0.001), seed=st.integers(0, 99)
)
def test_frames_that_come_more_slowly_than_the_base_says_are_looked_at_no_more_often(slower, phase, jitter, seed):
    base = Base(phase, FRAME_S * slower, jitter, seed)
    looks = looks_at(base, seed=seed)
    late = [look for look in looks if look > END_S / 2.0]
    assert len(late) / (late[-1] - late[0]) < 1.4 / (FRAMES * FRAME_S * slower)
    assert max(delays(base, looks)) < LATE_S + FRAME_S * (slower - 1.0)


@pytest.mark.parametrize("slower", [1.05, 1.15, 1.33, 1.45])
def test_frames_that_come_faster_again_wait_long_for_a_moment_only(slower):
    base = Base(period=slower * FRAME_S)
    slow = [at for at in base.whole if at < END_S / 2.0]
    base = Base(phase=slow[-1] + FRAME_S)
    base.whole = slow + [at for at in base.whole if at < END_S]
    base.restart()
    waits = delays(base, looks_at(base))
    again = waits[len(slow) :]
    assert max(again) < 3.0 * FRAME_S
    assert max(again[100:]) < LATE_S


@pytest.mark.parametrize("damaged", [{200}, {201}, {200, 201}, {200, 202, 203}])
def test_damaged_frames_delay_others_for_moments_only(damaged):
    base = Base(damaged=damaged)
    waits = delays(base, looks_at(base))
    assert len([wait for wait in waits if wait > LATE_S]) <= 1
    assert max(waits) < 2.0 * FRAME_S


def test_silent_base_is_looked_at_as_often_as_one_whose_rate_is_not_known():
    looks = looks_at(Base(phase=END_S))
    assert len(looks) / looks[-1] < 75.0
    assert max(after - before for before, after in itertools.pairwise(looks)) < UNKNOWN_S + 2.0 * WAKING_S


@pytest.mark.parametrize("kept_back_s", [0.05, 0.1, 0.3])
def test_frames_that_a_busy_computer_keeps_back_cause_no_storm_of_looks(kept_back_s):
    base = Base()
    base.whole = [math.ceil(at / kept_back_s) * kept_back_s for at in base.whole]
    base.restart()
    looks = looks_at(base)
    assert len(looks) / looks[-1] < 2.0 / UNKNOWN_S
    assert max(delays(base, looks)) < 2.0 * FRAME_S + WAKING_S


def test_base_whose_rate_is_not_known_is_looked_at_by_the_clock():
    pauses = [after - before for before, after in itertools.pairwise(looks_at(Base(), frame_s=0.0))]
    assert all(UNKNOWN_S - 1e-9 < pause < UNKNOWN_S + 2.0 * WAKING_S for pause in pauses)


def test_other_events_do_not_move_the_looks():
    clock = FrameClock(FRAME_S)
    clock.begin(0.0)
    clock.on_look(2, 0.0)
    due = clock.wait(0.0)
    assert due == pytest.approx(FRAMES * FRAME_S - EARLIER_S)
    clock.on_look(1, 0.02)
    assert clock.wait(0.02) == pytest.approx(due - 0.02)
    clock.on_look(1, due)  # the second one: both have come
    assert clock.wait(due) == pytest.approx(FRAMES * FRAME_S - EARLIER_S)


def test_pause_of_the_machine_is_not_made_up_for_by_looks_at_once():
    clock = FrameClock(FRAME_S)
    clock.begin(0.0)
    clock.on_look(40, 0.6)
    assert clock.wait(0.6) >= 0.5 * FRAMES * FRAME_S - EARLIER_S


AHEAD_OF_REAL_TIME_S = 0.05
"""What the kernel keeps for programs of normal priority in each second."""


def heartbeats(commands, period):
    """Times of the heartbeats of a guardian that waits for `period` s, and is woken at the times of `commands`, too."""
    beats, now, sent = Heartbeats(), 0.0, []
    pending = sorted(commands)
    while now < 1.0:
        if beats.is_due(now):
            sent.append(now)
        timeout = now + beats.wait(period, now)
        while pending and pending[0] <= now:
            pending.pop(0)
        now = min([timeout, *pending[:1]])
    return sent


@given(st.lists(st.floats(0.001, 0.999), max_size=40), st.sampled_from([0.015, 0.034, HEARTBEAT_MAX_S]))
def test_pause_between_two_heartbeats_has_both_limits_whatever_wakes_the_guardian(commands, period):
    sent = heartbeats(commands, period)
    pauses = [after - before for before, after in itertools.pairwise(sent)]
    assert max(pauses) <= HEARTBEAT_MAX_S + 1e-9
    assert min(pauses) >= HEARTBEAT_MIN_S - 1e-9


def test_command_shortly_before_a_heartbeat_at_rest_does_not_delay_it():
    sent = heartbeats([HEARTBEAT_MIN_S - 0.001], HEARTBEAT_MAX_S)
    assert sent[1] == pytest.approx(HEARTBEAT_MAX_S)


def test_commands_to_a_robot_that_stands_are_all_that_wakes_its_guardian():
    commands = [0.1 * number for number in range(1, 10)]
    assert heartbeats(commands, HEARTBEAT_MAX_S) == pytest.approx([0.0, *commands])


@pytest.mark.parametrize("speed", [0.5, 1.0, 1.4, 2.0, 3.0, 10.0])
def test_watchdog_leaves_the_machine_the_same_real_time_at_every_speed(speed):
    margin = silence_limit(speed) - HEARTBEAT_MAX_S / speed
    assert margin == pytest.approx(LATENESS_S)
    assert margin > 1.5 * AHEAD_OF_REAL_TIME_S


def test_hung_guardian_of_a_robot_is_given_up_after_200_ms():
    assert silence_limit(1.0) == pytest.approx(0.2)
