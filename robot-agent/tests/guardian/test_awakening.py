"""The attempts on a base that does not answer, and the sleep of one, by hand: when, in which order, and what is told.

Limits are literal.
"""

from __future__ import annotations

import pytest
from plain_base import PlainBase

from robot_agent.guardian.base import Attempt, BaseSleep, Revival
from robot_agent.hardware import Awakening, WakeLine

RTS = WakeLine(name="rts", seconds=1.1)
ONE_RATE = "the base does not answer at 115200 baud: wake it"
TWO_RATES = "the base does not answer at 115200 or 19200 baud: wake it"


def revival(*bauds: int, line: WakeLine | None = None) -> Revival:
    return Revival(Awakening(bauds=bauds, line=line, remedy="wake it"))


def attempts(tried: Revival, count: int, begin: float = 10.0) -> list[Attempt | None]:
    """Ask every 3 s; the first time only begins the wait."""
    return [tried.attempt(begin + 3.0 * number) for number in range(count + 1)][1:]


def test_base_with_one_rate_and_no_line_is_given_up_at_once_but_asked_on() -> None:
    tried = revival(115_200)
    assert tried.attempt(10.0) is None
    assert tried.problem is None
    assert attempts(tried, 3, 10.0) == [None, None, None]
    assert (tried.baud, tried.problem) == (115_200, ONE_RATE)


def test_each_rate_is_tried_once_and_then_the_first_nine_times_for_each_time_of_another() -> None:
    tried = revival(115_200, 19_200)
    assert tried.baud == 115_200
    assert attempts(tried, 1) == [Attempt(baud=19_200)]
    assert (tried.baud, tried.problem) == (19_200, None)
    assert attempts(tried, 1, 13.0) == [Attempt(baud=115_200)]
    assert (tried.baud, tried.problem) == (115_200, None)
    assert attempts(tried, 1, 16.0) == [None]
    assert (tried.baud, tried.problem) == (115_200, TWO_RATES)
    again = [None] * 7 + [Attempt(baud=19_200), Attempt(baud=115_200)] + [None] * 8 + [Attempt(baud=19_200)]
    assert attempts(tried, 18, 19.0) == again


@pytest.mark.parametrize("count", [1, 2])
def test_rate_at_which_the_base_answered_is_the_first_one_when_all_begins_anew(count: int) -> None:
    tried = revival(115_200, 19_200)
    attempts(tried, count)
    answered = tried.baud
    tried.on_answer()
    assert (tried.baud, tried.problem) == (answered, None)
    assert tried.attempt(100.0) is None
    assert tried.attempt(102.9) is None
    other = 134_400 - answered
    assert tried.attempt(103.0) == Attempt(baud=other), "it may have been switched on at another one"
    assert attempts(tried, 2, 103.0) == [Attempt(baud=answered), None]
    assert (tried.baud, tried.problem) == (answered, TWO_RATES)


class SleepingBase(PlainBase):
    def __init__(self, line: WakeLine | None = RTS) -> None:
        super().__init__(awakening=Awakening(bauds=(115_200,), line=line))

    def sleep(self) -> bytes:
        return b"sleep;"


def asleep(at: float = 0.0) -> BaseSleep:
    sleep = BaseSleep(SleepingBase())
    assert sleep.begin(at) == b"sleep;"
    assert sleep.asleep
    return sleep


def questions(sleep: BaseSleep, begin: float, seconds: float) -> list[float]:
    """Return when it is asked (s after `begin`), looked at every 1/16 s, which is exact."""
    return [n / 16 for n in range(round(seconds * 16)) if sleep.ask(begin + n / 16)]


def test_sleeping_base_is_asked_after_a_second_and_every_half_second() -> None:
    assert questions(asleep(), 0.0, 3.0) == [1.0, 1.5, 2.0, 2.5]


def test_base_that_did_not_stay_asleep_is_left_awake_for_a_minute() -> None:
    sleep = asleep()
    sleep.on_frame(10.0)
    assert sleep.begin(69.9375) == b""
    assert not sleep.asleep
    assert sleep.begin(70.0) == b"sleep;"
