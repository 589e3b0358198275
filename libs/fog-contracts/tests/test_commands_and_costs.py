import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from fog_contracts import messages as m
from fog_contracts.channels import ROBOT_COMMAND
from fog_contracts.codec import decode, encode
from fog_contracts.commands import VALID_S, CommandGate, sign
from fog_contracts.costs import (
    COST_PER_FACTOR,
    COST_WEIGHT,
    LETHAL,
    NEUTRAL_WEIGHT,
    UNKNOWN,
    Inflation,
    combine_costs,
    combine_speed_limits,
    is_traversable,
)

KEY = b"k" * 32


def command(nonce="n" * 16, issued_at=100.0, **changes):
    return m.RobotCommand(
        **{"kind": "enable", "robot": "r1", "operator": "op", "nonce": nonce, "issued_at": issued_at, **changes}
    )


@given(late=st.floats(-VALID_S, VALID_S))
def test_signed_command_passes_once_and_only_once_over_the_wire(late):
    gate = CommandGate("r1", KEY)
    sent = decode(ROBOT_COMMAND, encode(ROBOT_COMMAND, sign(command(), KEY)), m.RobotCommand)
    assert gate.refusal(sent, 100.0 + late) is None
    assert "already" in gate.refusal(sent, 100.0 + late)


@given(wait=st.floats(0.0, 30.0), first=st.floats(-VALID_S, VALID_S))
def test_no_moment_lets_a_command_through_twice(wait, first):
    gate = CommandGate("r1", KEY)
    signed = sign(command(), KEY)
    assert gate.refusal(signed, 100.0 + first) is None
    gate.refusal(sign(command(nonce="m" * 16, issued_at=100.0 + first + wait), KEY), 100.0 + first + wait)
    assert gate.refusal(signed, 100.0 + first + wait) is not None


@pytest.mark.parametrize("stamp", [100.0 - VALID_S - 0.01, 100.0 + VALID_S + 0.01, 1e9, 0.0])
def test_command_out_of_its_time_is_refused_and_keeps_its_nonce(stamp):
    gate = CommandGate("r1", KEY)
    assert "old" in gate.refusal(sign(command(), KEY), stamp)
    assert gate.refusal(sign(command(), KEY), 100.0) is None


@pytest.mark.parametrize(
    "changes",
    [
        {"kind": "reset"},
        {"operator": "other"},
        {"nonce": "x" * 16},
        {"issued_at": 100.5},
        {"pose": m.Pose(x=1.0, y=1.0, theta=0.0)},
        {"signature": b""},
        {"signature": b"x" * 32},
    ],
)
def test_nothing_of_a_signed_command_can_be_changed(changes):
    forged = msgspec.structs.replace(sign(command(), KEY), **changes)
    assert "signature" in CommandGate("r1", KEY).refusal(forged, 100.0)


def test_wrong_key_wrong_robot_and_short_key_are_refused():
    gate = CommandGate("r1", KEY)
    assert "signature" in gate.refusal(sign(command(), b"x" * 32), 100.0)
    assert "r2" in gate.refusal(sign(command(robot="r2"), KEY), 100.0)
    with pytest.raises(ValueError, match="32 bytes"):
        sign(command(), b"short")


def test_gate_forgets_nonces_that_could_not_pass_any_more():
    gate = CommandGate("r1", KEY)
    for n in range(1000):
        assert gate.refusal(sign(command(nonce=f"{n:016}", issued_at=float(n)), KEY), float(n)) is None
    assert len(gate._seen) <= 2 * VALID_S + 1


grids = hnp.arrays(np.uint8, (3, 4))


@given(below=grids, layer=grids, opinion=hnp.arrays(np.bool_, (3, 4)))
def test_no_layer_lowers_a_cost_or_opens_unknown_space(below, layer, opinion):
    out = combine_costs(below, layer, opinion)
    assert np.array_equal(out[~opinion], below[~opinion])
    known = below != UNKNOWN
    assert (out[known] >= below[known]).all()
    assert set(np.unique(out[~known])) <= {LETHAL, UNKNOWN}
    danger = opinion & (layer == LETHAL)
    assert not any(is_traversable(int(cost)) for cost in out[danger])
    assert np.array_equal(combine_costs(out, layer, opinion), out)


@given(a=grids, b=grids)
def test_lower_speed_limit_wins_and_none_is_no_limit(a, b):
    out = combine_speed_limits(a, b)
    assert np.array_equal(out, combine_speed_limits(b, a))
    for one, other, got in zip(a.flat, b.flat, out.flat, strict=True):
        limits = [v for v in (one, other) if v]
        assert got == (min(limits) if limits else 0)


@pytest.mark.parametrize("factor", [1.0, 2.0, 5.0])
def test_cost_of_a_factor_weighs_that_many_free_cells(factor):
    assert NEUTRAL_WEIGHT + COST_WEIGHT * COST_PER_FACTOR * (factor - 1.0) == pytest.approx(factor * NEUTRAL_WEIGHT)


@pytest.mark.parametrize("name", ["inscribed_radius", "inflation_radius", "cost_scaling"])
@pytest.mark.parametrize("value", [-0.1, float("nan"), float("inf")])
def test_inflation_that_cannot_be_is_refused_by_name(name, value):
    with pytest.raises(ValueError, match=name):
        Inflation(**{name: value})
