"""The sleep of a base, by hand: when it is asked whether it is awake, and what its answers mean. Limits are literal."""

from __future__ import annotations

import pytest
from plain_base import PlainBase

from robot_agent.guardian.base_sleep import BaseSleep
from robot_agent.guardian.revival import Attempt
from robot_agent.hardware import Awakening, WakeLine

RTS = WakeLine(name="rts", seconds=1.1)


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
