"""The debounce rules: evidence by likelihoods, N of M readings, agreement for a time."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fog_contracts.site import learned_share
from hazard_aggregator.debounce import DebounceError, Observation, SonarSample, make_rule
from hazard_aggregator.registry import find_rule

LIMIT = 2.65
PERIOD = 0.11
FREE = SonarSample("clear", 3.0, LIMIT)
LOST = SonarSample("unknown", None, LIMIT)


def echo(distance: float, *, explained: bool = False) -> SonarSample:
    return SonarSample("blocked", distance, LIMIT, explained)


def seen(*sonars: SonarSample) -> Observation:
    states = {sonar.state for sonar in sonars}
    return Observation("blocked" if "blocked" in states else "unknown" if "unknown" in states else "clear", sonars)


def run(readings, period: float = PERIOD, rule=None, **options):
    rule = rule or make_rule("hall", {"rule": "evidence", **options}, find_rule)
    return [rule.update(reading, i * period) for i, reading in enumerate(readings)]


def free_rule(*sonars: SonarSample):
    rule = make_rule("hall", {}, find_rule)
    assert run([seen(*(sonars or (FREE,)))] * 8, rule=rule)[-1] == "clear"
    return rule


RATES = st.floats(1e-6, 0.999)
SEQUENCES = st.lists(
    st.one_of(
        st.tuples(st.just("blocked"), st.floats(0.1, 2.6)),
        st.tuples(st.sampled_from(["clear", "unknown"]), st.none()),
    ),
    min_size=1,
    max_size=40,
)


def first_blocked(sequence, rate: float | None, **options) -> float:
    """Return the number of the first reading that confirms `blocked`, or infinity."""
    samples = [SonarSample(state, at, LIMIT, false_echo_rate=rate) for state, at in sequence]
    confirmed = run([seen(sample) for sample in samples], **options)
    return confirmed.index("blocked") if "blocked" in confirmed else math.inf


@given(SEQUENCES, RATES, RATES, st.floats(0.1, 0.95))
def test_sonar_with_more_false_echoes_never_confirms_an_obstacle_sooner(sequence, one, other, echo_rate):
    few, many = sorted((one, other))
    options = {"echo_rate": echo_rate, "false_echo_rate": 0.05}
    assert first_blocked(sequence, few, **options) <= first_blocked(sequence, many, **options)


@given(RATES, st.floats(0.1, 0.95), st.floats(1e-9, 0.5))
def test_whatever_a_calibration_has_shown_three_agreeing_echoes_confirm_and_one_never_does(
    rate, echo_rate, false_alarm
):
    steady = [("blocked", 0.80 + 0.004 * (i % 2)) for i in range(4)]
    found = first_blocked(steady, rate, echo_rate=echo_rate, false_echo_rate=0.05, false_alarm=false_alarm)
    assert 1 <= found <= 2


@given(st.lists(st.booleans(), min_size=12, max_size=12).filter(lambda echoed: sum(echoed) >= 7))
def test_sonar_that_counted_many_false_echoes_still_sees_what_swallows_a_part_of_them(echoed):
    readings = [("blocked", 0.80 + 0.004 * (i % 2)) if each else ("clear", None) for i, each in enumerate(echoed)]
    assert first_blocked(readings, 0.5) < 12


def test_calibrated_sonar_without_false_echoes_confirms_as_soon_as_one_that_was_not_calibrated():
    walking = [("blocked", 1.60 - 0.1 * i) for i in range(6)]
    assert first_blocked(walking, learned_share(0, 256)) == first_blocked(walking, None) == 1


def test_probabilities_of_error_that_decide_nothing_are_refused():
    with pytest.raises(DebounceError, match="must sum to less than 1"):
        run([], false_alarm=0.6, missed=0.5)


@pytest.mark.parametrize("limit", [1.2, 2.0, 2.5])
@pytest.mark.parametrize(
    ("false_echoes", "standing", "walking"), [(None, 2, 2), (0, 2, 2), (2, 2, 3)], ids=["uncalibrated", "clean", "two"]
)
def test_sonar_that_heard_two_false_echoes_at_its_calibration_wants_a_third_echo_of_what_walks(
    limit, false_echoes, standing, walking
):
    """Of 256 samples; the second echo is verified 50 ms after the first, and a person walks at 1 m/s."""
    rate = None if false_echoes is None else learned_share(false_echoes, 256)
    moments = [0.0, 0.05, *(0.05 + i * PERIOD for i in range(1, 8))]
    for needed, speed in ((standing, 0.0), (walking, 1.0)):
        rule = make_rule("hall", {}, find_rule)
        ranges = [limit - 0.2 - speed * at - 0.001 * (i % 2) for i, at in enumerate(moments)]
        confirmed = [
            rule.update(seen(SonarSample("blocked", measured, limit, false_echo_rate=rate)), at)
            for measured, at in zip(ranges, moments, strict=True)
        ]
        assert confirmed.index("blocked") + 1 == needed


def test_learned_rate_of_a_sonar_counts_before_the_option_of_its_area():
    walking = [("blocked", 1.60 - 0.1 * i) for i in range(6)]
    assert first_blocked(walking, None) < first_blocked(walking, 0.03)
    assert first_blocked(walking, None, false_echo_rate=0.03) == first_blocked(walking, 0.03)
    assert first_blocked(walking, 0.01, false_echo_rate=0.03) == first_blocked(walking, 0.01)


def test_two_agreeing_echoes_block_and_one_does_not():
    assert run([seen(echo(0.80)), seen(echo(0.81))], rule=free_rule()) == [None, "blocked"]
    assert run([seen(echo(0.80)), seen(FREE), seen(FREE)], rule=free_rule())[:2] == [None, "clear"]


def test_echoes_of_somebody_who_walks_agree():
    assert run([seen(echo(1.60)), seen(echo(1.45))], rule=free_rule())[-1] == "blocked"


def test_echoes_from_everywhere_wait_for_more_of_them():
    scattered = [seen(echo(distance)) for distance in (0.4, 2.1, 1.2, 2.4)]
    assert run(scattered[:2], rule=free_rule()) == [None, None]
    assert "blocked" in run([*scattered, *scattered], rule=free_rule())


def test_echoes_just_within_the_limit_wait_longer_than_clear_ones():
    doubtful = [seen(echo(LIMIT - 0.01 - 0.001 * (i % 3))) for i in range(10)]
    confirmed = run(doubtful, rule=free_rule())
    assert 3 <= confirmed.index("blocked") <= 8


def test_range_that_a_filter_repeats_counts_once_until_it_comes_too_often_for_that():
    assert run([seen(echo(0.80))] * 4, rule=free_rule()) == [None, None, None, "blocked"]


def test_half_of_the_echoes_suffice():
    readings = [seen(echo(0.8 + 0.01 * (i % 2)) if i % 2 == 0 else FREE) for i in range(12)]
    assert "blocked" in run(readings, rule=free_rule())


def test_eight_free_readings_clear_and_one_echo_restarts_them():
    rule = make_rule("hall", {}, find_rule)
    assert run([seen(echo(0.80)), seen(echo(0.81))], rule=rule)[-1] == "blocked"
    assert run([seen(FREE)] * 7 + [seen(echo(0.80))] + [seen(FREE)] * 7, rule=rule).count("clear") == 0
    assert run([seen(FREE)], rule=rule) == ["clear"]


def test_one_sonar_blocks_a_node_and_all_clear_it():
    rule = free_rule(FREE, FREE)
    assert run([seen(FREE, echo(0.80)), seen(FREE, echo(0.82))], rule=rule)[-1] == "blocked"
    assert run([seen(FREE, FREE)] * 7, rule=rule) == [None] * 7
    assert run([seen(FREE, FREE)], rule=rule) == ["clear"]


def test_sonar_whose_echo_a_robot_explains_does_not_count():
    readings = [seen(echo(0.80 + 0.01 * i, explained=True), echo(2.0)) for i in range(2)]
    assert "blocked" not in run(readings, rule=free_rule(FREE, FREE))


def test_five_unknown_readings_confirm_unknown_and_fewer_change_nothing():
    assert run([seen(LOST)] * 5, rule=free_rule()) == [None] * 4 + ["unknown"]
    rule = free_rule()
    run([seen(LOST)] * 4, rule=rule)
    assert run([seen(FREE)], rule=rule) == ["clear"]


def test_sensor_without_sonars_needs_three_readings():
    assert run([Observation("blocked")] * 3)[-1] == "blocked"
    assert "blocked" not in run([Observation("blocked")] * 2)


def test_learned_likelihoods_of_a_noisy_sonar_ask_for_more_echoes():
    echoes = [seen(echo(0.80 + 0.01 * i)) for i in range(6)]
    quiet, noisy = run(echoes, false_echo_rate=0.001), run(echoes, false_echo_rate=0.2)
    assert quiet.index("blocked") < noisy.index("blocked")


def test_likelihoods_that_contradict_each_other_are_refused():
    with pytest.raises(DebounceError, match=r"echo_rate 0\.2 must exceed false_echo_rate 0\.5"):
        run([], echo_rate=0.2, false_echo_rate=0.5)


SAMPLES = st.one_of(
    st.just(FREE), st.just(LOST), st.floats(0.02, LIMIT - 0.001).map(echo), st.sampled_from([echo(0.8), echo(0.801)])
)


@given(st.lists(SAMPLES, max_size=60))
def test_clear_is_only_confirmed_after_eight_more_free_than_lost_readings_without_an_echo(samples):
    """However the readings are mixed: an echo within the last seven readings forbids `clear` after a blockage."""
    rule = make_rule("hall", {}, find_rule)
    run([seen(echo(0.80)), seen(echo(0.81))], rule=rule)
    free = 0
    for sample in samples:
        confirmed = rule.update(seen(sample), 0.0)
        free = free + 1 if sample is FREE else 0 if sample.state == "blocked" else free
        if confirmed == "clear":
            assert free >= 8
        if confirmed in ("clear", "unknown"):
            return


@given(st.lists(SAMPLES, min_size=1, max_size=60), st.floats(0.05, 0.95))
def test_decision_bounds_are_those_of_wald(samples, echo_rate):
    """A single echo never blocks: with these errors no likelihood of one reading reaches the bound."""
    rule = make_rule("hall", {"rule": "evidence", "echo_rate": echo_rate}, find_rule)
    if math.log(echo_rate / 0.01) < math.log(0.999 / 2e-4):
        assert rule.update(seen(samples[0]), 0.0) is None


@pytest.mark.parametrize(
    ("choice", "problem"),
    [
        ({"window": 3, "to_blocked": 4}, "can't exceed the window of 3"),
        ({"window": 9, "to_blocked": 2, "to_clear": 3}, "must exceed the window of 9"),
    ],
)
def test_n_of_m_refuses_counts_that_confirm_both_states_or_none(choice, problem):
    with pytest.raises(DebounceError, match=problem):
        make_rule("hall", {"rule": "n-of-m", **choice}, find_rule)


def test_n_of_m_ignores_single_wrong_readings():
    rule = make_rule("hall", {"rule": "n-of-m"}, find_rule)
    states = ["blocked", "clear", "blocked", "blocked", "clear", "blocked"]
    assert run([Observation(state) for state in states], rule=rule)[-1] == "blocked"


def test_duration_sets_fast_and_clears_slowly_by_the_readings_times():
    rule = make_rule("hall", {"rule": "duration", "blocked_s": 0.3, "clear_s": 1.0}, find_rule)
    assert run([Observation("blocked")] * 4, rule=rule) == [None, None, None, "blocked"]
    assert run([Observation("clear")] * 11, rule=rule).index("clear") == 10


def test_options_without_a_rule_are_those_of_the_rule_that_has_them():
    blocked = [Observation("blocked")] * 3
    assert run(blocked, rule=make_rule("hall", {"to_blocked": 3}, find_rule)) == [None, None, "blocked"]
    assert run(blocked, rule=make_rule("hall", {"echo_rate": 0.9}, find_rule))[-1] == "blocked"
    with pytest.raises(DebounceError, match="to_blockd"):
        make_rule("hall", {"to_blockd": 3}, find_rule)
