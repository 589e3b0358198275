"""A part's own options as a mapping in a message, a site or a request, checked by the part's own type."""

from collections.abc import Mapping
from typing import Any, TypeVar

import msgspec

Options = TypeVar("Options", bound=msgspec.Struct)


class OptionError(ValueError):
    """An option that can't be used: `field` is its name (empty: the whole), the message says what is wrong."""

    def __init__(self, field: str, problem: str) -> None:
        super().__init__(f"{field}: {problem}" if field else problem)
        self.field = field
        self.problem = problem


def read_options(kind: type[Options], given: Mapping[str, Any]) -> Options:
    """Return the options as their own type; raises `OptionError` for one that is unknown or has a wrong value."""
    known = [field.encode_name for field in msgspec.structs.fields(kind)]
    for name in given:
        if name not in known:
            raise OptionError(name, f"there is no such option (known: {', '.join(known) or 'none'})")
    try:
        return msgspec.convert(dict(given), kind)
    except msgspec.ValidationError as error:
        problem, _, path = str(error).partition(" - at ")
        raise OptionError(path.strip("`").removeprefix("$").lstrip("."), problem) from error
