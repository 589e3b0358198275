"""Options of a debounce rule, layer or other part: a mapping in a message, site or request, checked by a type."""

from collections.abc import Mapping
from typing import Any, TypeVar

import msgspec

Options = TypeVar("Options", bound=msgspec.Struct)


class OptionError(ValueError):
    """An unknown, missing or invalid option: `field` is its name (empty: the whole mapping), `problem` says why."""

    def __init__(self, field: str, problem: str) -> None:
        super().__init__(f"{field}: {problem}" if field else problem)
        self.field = field
        self.problem = problem


def read_options(kind: type[Options], given: Mapping[str, Any]) -> Options:
    """Return the options as `kind`; raises `OptionError` for one that is unknown or has a wrong value."""
    known = [field.encode_name for field in msgspec.structs.fields(kind)]
    for name in given:
        if name not in known:
            raise OptionError(name, f"there is no such option (known: {', '.join(known) or 'none'})")
    try:
        return msgspec.convert(dict(given), kind)
    except msgspec.ValidationError as error:
        problem, _, path = str(error).partition(" - at ")
        raise OptionError(path.strip("`").removeprefix("$").lstrip("."), problem) from error
