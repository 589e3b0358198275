"""The attempts on a base that does not answer, and the sleep of one, by hand: when, in which order, and what is told.

Limits are literal.
"""

from __future__ import annotations

import pytest
from plain_base import PlainBase

from robot_agent.guardian.awakening import Attempt, BaseSleep, Revival
from robot_agent.hardware import Awakening, WakeLine

RTS = WakeLine(name="rts", seconds=1.1)
ONE_RATE = "the base does not answer at 115200 baud: wake it"
TWO_RATES = "the base does not answer at 115200 or 19200 baud: wake it"


def revival(*bauds: int, line: WakeLine | None = None) -> Revival:
    return Revival(Awakening(bauds=bauds, line=line, remedy="wake it"))


def attempts(tried: Revival, count: int, begin: float = 10.0) -> list[Attempt | None]:
    """Ask every 3 s; the first time only begins the wait."""
    return [tried.attempt(begin + 3.0 * number) for number in range(count + 1)][1:]


def test_attempts_are_three_seconds_apart() -> None:
    tried = revival(115_200, line=RTS)
    asked = {at: tried.attempt(at) is not None for at in (10.0, 12.9, 12.99, 13.0, 13.01, 15.9, 15.99, 16.0)}
    assert [at for at, due in asked.items() if due] == [13.0, 16.0]


def test_base_with_one_rate_and_no_line_is_given_up_at_once_but_asked_on() -> None:
    tried = revival(115_200)
    assert tried.attempt(10.0) is None
    assert tried.problem is None
    assert attempts(tried, 3, 10.0) == [None, None, None]
    assert (tried.baud, tried.problem) == (115_200, ONE_RATE)


def test_line_is_pulsed_twice_before_a_base_of_one_rate_is_given_up_and_on() -> None:
    tried = revival(115_200, line=RTS)
    assert attempts(tried, 1) == [Attempt(line=RTS)]
    assert tried.problem is None
    assert attempts(tried, 4, 13.0) == [Attempt(line=RTS)] * 4
    assert tried.problem == ONE_RATE


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


def test_three_rates_take_turns() -> None:
    tried = revival(115_200, 57_600, 19_200)
    bauds = [115_200, *(attempt.baud for attempt in attempts(tried, 24) if attempt is not None)]
    assert bauds == 3 * [115_200, 57_600, 19_200]


def test_line_is_pulsed_at_each_rate() -> None:
    tried = revival(115_200, 19_200, line=RTS)
    pulse = Attempt(line=RTS)
    expected = [pulse, Attempt(baud=19_200), pulse, Attempt(baud=115_200), pulse, pulse]
    assert attempts(tried, 5) == expected[:5]
    assert tried.problem is None
    assert attempts(tried, 1, 25.0) == expected[5:]
    assert tried.problem == TWO_RATES


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


def test_attempts_on_a_base_that_fell_silent_again_are_counted_anew() -> None:
    tried = revival(115_200, line=RTS)
    attempts(tried, 3)
    tried.on_answer()
    assert attempts(tried, 1, 100.0) == [Attempt(line=RTS)]
    assert tried.problem is None
    assert attempts(tried, 1, 103.0) == [Attempt(line=RTS)]
    assert tried.problem == ONE_RATE


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


def end_by_question(sleep: BaseSleep, at: float, number: int) -> None:
    """Put it to sleep, and let it answer to its question of this number."""
    assert sleep.begin(at) == b"sleep;"
    assert len(questions(sleep, at, 1.0 + 0.5 * number)) == number
    assert sleep.on_frame(at + 0.5 + 0.5 * number)
    assert not sleep.asleep


@pytest.mark.parametrize("base", [PlainBase(), SleepingBase(line=None)])
def test_base_that_nothing_wakes_is_not_put_to_sleep(base: PlainBase) -> None:
    sleep = BaseSleep(base)
    assert sleep.begin(0.0) == b""
    assert not sleep.asleep


def test_sleep_ends_by_a_pulse_of_the_line_that_wakes() -> None:
    sleep = asleep()
    assert sleep.end() == Attempt(line=RTS)
    assert not sleep.asleep
    assert sleep.begin(0.1) == b"sleep;", "it ended as it should"


def test_sleeping_base_is_asked_after_a_second_and_every_half_second() -> None:
    assert questions(asleep(), 0.0, 3.0) == [1.0, 1.5, 2.0, 2.5]


def test_questions_begin_anew_with_each_sleep() -> None:
    sleep = asleep()
    questions(sleep, 0.0, 10.0)
    sleep.end()
    sleep.begin(100.0)
    assert questions(sleep, 100.0, 2.0) == [1.0, 1.5]


@pytest.mark.parametrize(("at", "awake"), [(0.5, False), (0.9375, False), (1.0, True)])
def test_frame_counts_that_comes_a_second_after_the_word_to_sleep(at: float, *, awake: bool) -> None:
    sleep = asleep()
    assert sleep.on_frame(at) is awake
    assert sleep.asleep is not awake


def test_base_that_did_not_stay_asleep_is_left_awake_for_a_minute() -> None:
    sleep = asleep()
    sleep.on_frame(10.0)
    assert sleep.begin(69.9375) == b""
    assert not sleep.asleep
    assert sleep.begin(70.0) == b"sleep;"


@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_base_that_answers_first_questions_of_two_sleeps_in_a_row_is_asked_no_more(number: int) -> None:
    sleep = BaseSleep(SleepingBase())
    for at in (100.0, 200.0):
        end_by_question(sleep, at, number)
    for at in (300.0, 400.0):
        assert sleep.begin(at) == b"sleep;"
        assert questions(sleep, at, 90.0) == []
        sleep.on_frame(at + 30.0)


def test_base_that_answers_later_questions_is_asked_on() -> None:
    sleep = BaseSleep(SleepingBase())
    for at in (100.0, 200.0, 300.0, 400.0):
        end_by_question(sleep, at, 5)


def test_sleeps_count_in_a_row_only() -> None:
    sleep = BaseSleep(SleepingBase())
    for at, number in ((100.0, 1), (200.0, 5), (300.0, 1), (400.0, 5), (500.0, 4)):
        end_by_question(sleep, at, number)


def test_frame_before_any_question_is_no_answer() -> None:
    sleep = BaseSleep(SleepingBase())
    for at in (100.0, 200.0, 300.0):
        sleep.begin(at)
        assert sleep.on_frame(at + 1.0)
    sleep.begin(400.0)
    assert questions(sleep, 400.0, 1.5) == [1.0]
