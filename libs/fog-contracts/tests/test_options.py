from typing import Annotated

import msgspec
import pytest

from fog_contracts.options import OptionError, read_options


class Limits(msgspec.Struct, kw_only=True):
    low: Annotated[float, msgspec.Meta(ge=0.0)] = 1.0
    high: float


def test_options_are_their_own_type_with_defaults():
    assert read_options(Limits, {"high": 2}) == Limits(low=1.0, high=2.0)


@pytest.mark.parametrize(
    ("given", "field", "words"),
    [
        ({"high": 2, "mid": 1}, "mid", "known: low, high"),
        ({"high": 2, "low": -1}, "low", "Expected `float` >= 0.0"),
        ({"high": "two"}, "high", "Expected `float`"),
        ({}, "", "missing required field `high`"),
    ],
)
def test_an_option_that_cannot_be_used_is_named(given, field, words):
    with pytest.raises(OptionError) as caught:
        read_options(Limits, given)
    assert caught.value.field == field
    assert words in caught.value.problem
