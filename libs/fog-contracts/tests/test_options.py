from typing import Annotated

import msgspec
import pytest

from fog_contracts.site import OptionError, read_options


class Limits(msgspec.Struct, kw_only=True):
    low: Annotated[float, msgspec.Meta(ge=0.0)] = 1.0
    high: float


def test_options_are_converted_to_their_type_with_defaults():
    assert read_options(Limits, {"high": 2}) == Limits(low=1.0, high=2.0)


@pytest.mark.parametrize(
    ("given", "field", "text"),
    [
        ({"high": 2, "mid": 1}, "mid", "known: low, high"),
        ({"high": 2, "low": -1}, "low", "Expected `float` >= 0.0"),
        ({"high": "two"}, "high", "Expected `float`"),
        ({}, "", "missing required field `high`"),
    ],
)
def test_unknown_invalid_or_missing_option_is_refused_by_name(given, field, text):
    with pytest.raises(OptionError) as caught:
        read_options(Limits, given)
    assert caught.value.field == field
    assert text in caught.value.problem
