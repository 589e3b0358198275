"""Who is found late, and who is quick enough to take over."""

import math

from hypothesis import given
from hypothesis import strategies as st

from fog_runtime.punctuality import LATE_S, QUICK_S, Punctuality

PERIOD_S = 0.1


def judged(delays: list[float], *, since: float = 100.0) -> tuple[Punctuality, float]:
    """Return what is known after questions whose answers took so long (s), and when that is."""
    judge = Punctuality()
    judge.follow(5)
    events = [(since + PERIOD_S * n, 0, n) for n in range(len(delays))]
    events += [(since + PERIOD_S * n + delay, 1, n) for n, delay in enumerate(delays) if delay < math.inf]
    now = since + PERIOD_S * len(delays)
    for at, answer, number in sorted(event for event in events if event[0] <= now):
        question = (7, 1000.0 + PERIOD_S * number)
        if answer:
            judge.on_answer(question, at)
        else:
            judge.on_question(question, at)
    return judge, now


def test_half_a_second_late_is_found_within_a_second_and_lost_answers_likewise():
    for delay in (0.5, math.inf):
        judge, now = judged([0.01] * 30 + [delay] * 5)
        assert not judge.is_late(now), "less than half of a second's answers are known to be"
        judge, now = judged([0.01] * 30 + [delay] * 9)
        assert judge.is_late(now)
        assert judge.median(now) > LATE_S


def test_single_pause_is_not_late_nor_is_a_process_between_quick_and_late():
    judge, now = judged([0.01] * 30 + [0.5, 0.4, 0.3, 0.2, 0.1] + [0.01] * 5)
    assert not judge.is_late(now)
    judge, now = judged([0.15] * 30)
    assert not judge.is_late(now)
    assert not judge.is_quick(now), "it is not to take over"


@given(st.lists(st.sampled_from([0.0, 0.05, 0.09, 0.3, 0.7, math.inf]), min_size=20, max_size=40))
def test_nobody_is_late_and_quick(delays):
    judge, now = judged(delays)
    assert not (judge.is_late(now) and judge.is_quick(now))
    if max(delays) <= QUICK_S:
        assert judge.is_quick(now)


def test_what_delays_question_and_answer_alike_delays_nobody():
    judge = Punctuality()
    judge.follow(5)
    for n in range(40):
        heard = 100.0 + PERIOD_S * n + 0.6  # later than it was asked, as the answer is
        judge.on_question((7, PERIOD_S * n), heard)
        judge.on_answer((7, PERIOD_S * n), heard + 0.01)
    assert judge.is_quick(heard + LATE_S)


def test_nobody_is_judged_without_questions_nor_before_a_new_leader_was_asked_some():
    judge, now = judged([math.inf] * 30)
    assert judge.is_late(now)
    assert not judge.is_late(now + 2.0), "the map-service is silent"
    judge.follow(6)
    assert not judge.is_late(now)
    assert not judge.is_quick(now)


def test_leader_that_announces_itself_and_knows_of_no_questions_is_not_judged():
    judge = Punctuality()
    judge.follow(5)
    for n in range(30):
        judge.on_question((7, PERIOD_S * n), 100.0 + PERIOD_S * n)
        judge.on_no_answer()
    assert not judge.is_late(103.0)


def test_answer_of_another_map_service_answers_nothing():
    judge = Punctuality()
    judge.follow(5)
    for n in range(30):
        judge.on_question((7, PERIOD_S * n), 100.0 + PERIOD_S * n)
        judge.on_answer((8, PERIOD_S * n), 100.0 + PERIOD_S * n)
    assert judge.is_late(103.0)
