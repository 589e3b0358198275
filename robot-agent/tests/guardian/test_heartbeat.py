"""The guardian's heartbeats come in time for its watchdog, whatever wakes it, and with the same margin at any speed."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from robot_agent.guardian.heartbeat import LATENESS_S, LONGEST_S, SHORTEST_S, Heartbeats, silence_limit

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


@given(st.lists(st.floats(0.001, 0.999), max_size=40), st.sampled_from([0.015, 0.034, LONGEST_S]))
def test_pause_between_two_heartbeats_has_both_limits_whatever_wakes_the_guardian(commands, period):
    sent = heartbeats(commands, period)
    pauses = [after - before for before, after in itertools.pairwise(sent)]
    assert max(pauses) <= LONGEST_S + 1e-9
    assert min(pauses) >= SHORTEST_S - 1e-9


def test_command_shortly_before_a_heartbeat_at_rest_does_not_delay_it():
    sent = heartbeats([SHORTEST_S - 0.001], LONGEST_S)
    assert sent[1] == pytest.approx(LONGEST_S)


def test_commands_to_a_robot_that_stands_are_all_that_wakes_its_guardian():
    commands = [0.1 * number for number in range(1, 10)]
    assert heartbeats(commands, LONGEST_S) == pytest.approx([0.0, *commands])


@pytest.mark.parametrize("speed", [0.5, 1.0, 1.4, 2.0, 3.0, 10.0])
def test_watchdog_leaves_the_machine_the_same_real_time_at_every_speed(speed):
    margin = silence_limit(speed) - LONGEST_S / speed
    assert margin == pytest.approx(LATENESS_S)
    assert margin > 1.5 * AHEAD_OF_REAL_TIME_S


def test_hung_guardian_of_a_robot_is_given_up_after_200_ms():
    assert silence_limit(1.0) == pytest.approx(0.2)
