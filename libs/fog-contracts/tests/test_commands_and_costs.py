import hmac

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from msgspec.structs import replace

from fog_contracts import messages as m
from fog_contracts.channels import ROBOT_COMMAND
from fog_contracts.codec import decode, encode
from fog_contracts.commands import STOPS, VALID_S, CommandGate, sign, unsigned_stop
from fog_contracts.costs import (
    LETHAL,
    UNKNOWN,
    Inflation,
    is_traversable,
    penalty_cost,
)
from fog_contracts.grid import combine_costs, combine_speed_limits

KEY = b"k" * 32


def command(nonce="n" * 16, issued_at=100.0, **changes):
    return m.RobotCommand(
        **{
            "kind": "enable",
            "robot": "r1",
            "operator": "op",
            "nonce": nonce,
            "boot": "b1",
            "issued_at": issued_at,
            **changes,
        }
    )


@given(age=st.floats(0.0, VALID_S))
def test_signed_command_is_accepted_exactly_once_after_encoding(age):
    gate = CommandGate("r1", KEY, "b1")
    received = decode(ROBOT_COMMAND, encode(ROBOT_COMMAND, sign(command(), KEY)), m.RobotCommand)
    assert gate.refusal(received, 100.0 + age) is None
    assert gate.refusal(received, 100.0 + age).code == "repeated"


def test_hand_over_is_signed_with_its_mission_and_without_one_as_robots_of_before_sign_it():
    given_over = m.HandOver(origin="ground", floor="upstairs", epoch=1, who="anna")
    unsigned = command(kind="hand_over", given=given_over)
    told = msgspec.msgpack.decode(encode(ROBOT_COMMAND, unsigned))
    assert told["given"].pop("mission") is None
    assert sign(unsigned, KEY).signature == hmac.digest(KEY, msgspec.msgpack.encode(told), "sha256")
    carrying = sign(command(kind="hand_over", given=replace(given_over, mission=m.Tour(id="t"))), KEY)
    other = replace(carrying, given=replace(given_over, mission=m.Tour(id="t", ahead=(m.Stop(place="b"),))))
    assert CommandGate("r1", KEY, "b1").refusal(other, 100.0).code == "not_signed"
    received = decode(ROBOT_COMMAND, encode(ROBOT_COMMAND, carrying), m.RobotCommand)
    assert CommandGate("r1", KEY, "b1").refusal(received, 100.0) is None


@given(wait=st.floats(0.0, 30.0), first=st.floats(0.0, VALID_S))
def test_command_is_never_accepted_twice(wait, first):
    gate = CommandGate("r1", KEY, "b1")
    signed = sign(command(), KEY)
    assert gate.refusal(signed, 100.0 + first) is None
    gate.refusal(sign(command(nonce="m" * 16, issued_at=100.0 + first + wait), KEY), 100.0 + first + wait)
    assert gate.refusal(signed, 100.0 + first + wait) is not None


@pytest.mark.parametrize(
    ("now", "code"),
    [(99.99, "from_future"), (100.0 + VALID_S + 0.01, "too_old"), (1e9, "too_old"), (0.0, "from_future")],
)
def test_command_of_the_future_or_expired_is_refused_and_its_nonce_stays_unused(now, code):
    gate = CommandGate("r1", KEY, "b1")
    assert gate.refusal(sign(command(), KEY), now).code == code
    assert gate.refusal(sign(command(), KEY), 100.0) is None


@pytest.mark.parametrize(
    "changes",
    [
        {"kind": "reset"},
        {"operator": "other"},
        {"nonce": "x" * 16},
        {"issued_at": 99.5},
        {"boot": "b2"},
        {"pose": m.Pose(x=1.0, y=1.0, theta=0.0)},
        {"signature": b""},
        {"signature": b"x" * 32},
    ],
)
def test_changing_any_field_of_a_signed_command_invalidates_its_signature(changes):
    forged = msgspec.structs.replace(sign(command(), KEY), **changes)
    assert CommandGate("r1", KEY, "b1").refusal(forged, 100.0).code == "not_signed"


def test_command_with_wrong_key_or_wrong_robot_is_refused_and_short_key_raises():
    gate = CommandGate("r1", KEY, "b1")
    assert gate.refusal(sign(command(), b"x" * 32), 100.0).code == "not_signed"
    assert gate.refusal(sign(command(robot="r2"), KEY), 100.0).code == "other_robot"
    with pytest.raises(ValueError, match="32 bytes"):
        sign(command(), b"short")


@given(stamp=st.floats(0.0, 1e10), kind=st.sampled_from(sorted(STOPS)), signature=st.binary(max_size=64))
def test_stop_passes_unsigned_repeatedly_and_from_any_clock(stamp, kind, signature):
    gate = CommandGate("r1", KEY, "b1")
    stop = command(kind=kind, signature=signature)
    assert gate.refusal(stop, stamp) is None
    assert gate.refusal(stop, stamp) is None
    assert gate.refusal(command(kind=kind, robot="r2"), stamp).code == "other_robot"


@pytest.mark.parametrize("kind", ["enable", "reset", "initial_pose", "egress"])
def test_nothing_but_a_stop_may_be_unsigned(kind):
    with pytest.raises(ValueError, match="must be signed"):
        unsigned_stop(kind, robot="r1", operator="op", nonce="n" * 16)
    assert CommandGate("r1", KEY, "b1").refusal(command(kind=kind), 100.0).code == "not_signed"


@given(boot=st.text("b12", max_size=3).filter(lambda boot: boot != "b1"), age=st.floats(0.0, VALID_S))
def test_command_to_another_run_of_the_agent_is_refused(boot, age):
    assert CommandGate("r1", KEY, "b1").refusal(sign(command(boot=boot), KEY), 100.0 + age).code == "other_run"


def test_nonces_of_expired_commands_are_dropped():
    gate = CommandGate("r1", KEY, "b1")
    for n in range(1000):
        assert gate.refusal(sign(command(nonce=f"{n:016}", issued_at=float(n)), KEY), float(n)) is None
    assert len(gate._nonce_expiry) <= 2 * VALID_S + 1


grids = hnp.arrays(np.uint8, (3, 4))


@given(below=grids, layer=grids, mask=hnp.arrays(np.bool_, (3, 4)))
def test_no_layer_lowers_a_cost_or_makes_unknown_space_traversable(below, layer, mask):
    out = combine_costs(below, layer, mask)
    assert np.array_equal(out[~mask], below[~mask])
    known = below != UNKNOWN
    assert (out[known] >= below[known]).all()
    assert set(np.unique(out[~known])) <= {LETHAL, UNKNOWN}
    lethal = mask & (layer == LETHAL)
    assert not any(is_traversable(int(cost)) for cost in out[lethal])
    assert np.array_equal(combine_costs(out, layer, mask), out)


@given(a=grids, b=grids)
def test_lower_speed_limit_wins_and_zero_means_no_limit(a, b):
    out = combine_speed_limits(a, b)
    assert np.array_equal(out, combine_speed_limits(b, a))
    for one, other, got in zip(a.flat, b.flat, out.flat, strict=True):
        limits = [v for v in (one, other) if v]
        assert got == (min(limits) if limits else 0)


def test_penalty_factors_are_distinguishable_over_their_whole_range_and_mean_free_cells():
    factors = np.arange(100, 501, 2) / 100
    found = [penalty_cost(float(factor)) for factor in factors]
    assert np.all(np.diff(found) > 0)
    assert found[-1] == penalty_cost(5.0) == 250
    for factor, cost in zip(factors, found, strict=True):
        assert 50 + 0.8 * cost == pytest.approx(50 * factor, abs=0.41)
    for factor in (0.99, 5.01, float("nan")):
        with pytest.raises(ValueError, match="from 1 to 5"):
            penalty_cost(factor)


@pytest.mark.parametrize("name", ["inscribed_radius", "inflation_radius", "cost_scaling"])
@pytest.mark.parametrize("value", [-0.1, float("nan"), float("inf")])
def test_negative_or_non_finite_inflation_parameter_is_refused_by_name(name, value):
    with pytest.raises(ValueError, match=name):
        Inflation(**{name: value})
