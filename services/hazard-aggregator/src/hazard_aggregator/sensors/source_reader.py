"""What a source's messages mean: a value in a payload becomes blocked, clear or unknown, with the reason. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import msgspec

from hazard_aggregator.sensors.plausibility import Classification

if TYPE_CHECKING:
    from fog_contracts.messages import Availability, Limits, Source

_SHOWN: Final = 40
"""Characters of a payload that a reason quotes."""


class _FormatError(ValueError):
    """A payload is not what its source says; the text is the reason."""


class SourceReader:
    """Reads the messages of one source, whose profile is filled in; remembers on which side of its limits it was."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._exceeded: bool | None = None

    def reset(self) -> None:
        """Forget on which side of its limits the number was."""
        self._exceeded = None

    def classify(self, payload: bytes | None) -> Classification:
        """Return what a message says; one that is too long, or not in its format, is `unknown`."""
        source = self._source
        if payload is None:
            return Classification("unknown", "its message is too long")
        try:
            value = _value(payload, source.pointer)
            if source.number is not None:
                return self._classify_number(_number(value), source.number)
            for state, meaning in (("blocked", source.blocked), ("clear", source.clear)):
                if _is_one_of(value, meaning):
                    return Classification(state, f"it reports {_quoted(value)}")  # type: ignore[arg-type]  # a literal
        except _FormatError as error:
            return Classification("unknown", f"its format has changed: {error}")
        return Classification("unknown", f"{_quoted(value)} means neither blocked nor clear")

    def classify_value(self, value: float) -> Classification:
        """Return what a number means that came as such, from a node of Fognav."""
        limits = self._source.number
        return Classification("unknown", "it has no limits") if limits is None else self._classify_number(value, limits)

    def _classify_number(self, value: float, limits: Limits) -> Classification:
        if not _within(value, limits.minimum, limits.maximum):
            self._exceeded = None
            bounds = f"{_bound(limits.minimum, 'at least')}{_bound(limits.maximum, 'at most')}".removesuffix(", ")
            return Classification("unknown", f"{value:g} is implausible: it should be {bounds}")
        # Within the hysteresis a number stays on its side; one that has none yet counts as a danger.
        margin = 0.0 if self._exceeded is False else limits.hysteresis
        above = limits.above is not None and value > limits.above - margin
        below = limits.below is not None and value < limits.below + margin
        self._exceeded = above or below
        if above:
            return Classification("blocked", f"{value:g} is above {limits.above:g}")
        if below:
            return Classification("blocked", f"{value:g} is below {limits.below:g}")
        return Classification("clear", f"{value:g} is within its limits")


def is_online(availability: Availability, payload: bytes | None) -> bool | None:
    """Return whether a source's sensor is connected; None if the message does not say so."""
    if payload is None:
        return None
    try:
        value = _value(payload, availability.pointer)
    except _FormatError:
        return None
    if _is_one_of(value, availability.offline):
        return False
    return True if _is_one_of(value, availability.online) else None


def _value(payload: bytes, pointer: str | None) -> Any:  # noqa: ANN401  # any JSON value
    """Return the value in a payload, by a JSON pointer (RFC 6901); None: the payload as text."""
    try:
        if pointer is None:
            return payload.decode("utf-8").strip()
        found = msgspec.json.decode(payload)
    except (UnicodeDecodeError, msgspec.DecodeError, RecursionError) as error:
        raise _FormatError(f"{_quoted(payload.decode('utf-8', 'replace'))} is not JSON text") from error
    for part in pointer.split("/")[1:]:
        key = part.replace("~1", "/").replace("~0", "~")
        if isinstance(found, dict) and key in found:
            found = found[key]
        elif isinstance(found, list) and key.isdecimal() and int(key) < len(found):
            found = found[int(key)]
        else:
            raise _FormatError(f"there is no {pointer} in it")
    return found


def _number(value: Any) -> float:  # noqa: ANN401  # any JSON value
    try:
        number = float(value) if isinstance(value, str | int | float) and not isinstance(value, bool) else None
    except (ValueError, OverflowError):
        number = None
    if number is None or not abs(number) < float("inf"):
        raise _FormatError(f"{_quoted(value)} is no number")
    return number


def _is_one_of(value: Any, meaning: list[str | bool | float]) -> bool:  # noqa: ANN401  # any JSON value
    """Whether a value is one of these; true is not 1, and texts are compared without regard to case."""
    if isinstance(value, str):
        return any(isinstance(other, str) and value.casefold() == other.casefold() for other in meaning)
    return any(isinstance(value, bool) == isinstance(other, bool) and value == other for other in meaning)


def _bound(value: float | None, words: str) -> str:
    return "" if value is None else f"{words} {value:g}, "


def _within(value: float, minimum: float | None, maximum: float | None) -> bool:
    return (minimum is None or value >= minimum) and (maximum is None or value <= maximum)


def _quoted(value: object) -> str:
    text = str(value)
    return f"{text[:_SHOWN]!r}" + ("..." if len(text) > _SHOWN else "")
