"""What a source's messages mean: a value in a payload becomes blocked, clear or unknown, with the reason. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import msgspec

from hazard_aggregator.sensors.plausibility import Classification

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.messages import Availability, Limits, Source

_SHOWN: Final = 40
"""Characters of a payload that a reason quotes."""


_NOTHING: Final = frozenset({"nan", "none", "null"})
"""What is sent instead of a number that was not measured; ESPHome sends `nan`, or `None` if so configured."""


class _FormatError(ValueError):
    """A payload is not what its source says; the text is the reason."""


class _NoValueError(_FormatError):
    """A payload has no value where it should be; a distance sensor without an echo sends such ones."""


class SourceReader:
    """Reads the messages of one source, whose profile is filled in.

    It remembers on which side of its limits the number was, and whether it measured anything.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self._exceeded: bool | None = None
        self._measured = False

    def reset(self) -> None:
        """Forget on which side of its limits the number was, and that there was any."""
        self._exceeded = None
        self._measured = False

    def classify(self, payload: bytes | None) -> Classification:
        """Return what a message says; one that is too long, or not in its format, is `unknown`."""
        source = self._source
        try:
            value = _value(payload, source.pointers)
            if source.number is not None:
                number = _number(value)
                self._measured = True
                return self._classify_number(number, source.number)
            for state, meaning in (("blocked", source.blocked), ("clear", source.clear)):
                if is_one_of(value, meaning):
                    return Classification(state, f"it reports {_quoted(value)}")  # type: ignore[arg-type]  # a literal
        except _FormatError as error:
            if source.number is not None and isinstance(error, _NoValueError):
                return self._without_value(str(error))
            return Classification("unknown", f"its format has changed: {error}")
        return Classification("unknown", f"{_quoted(value)} means neither blocked nor clear")

    def classify_value(self, value: float) -> Classification:
        """Return what a number means that came as such, from a node of Fognav."""
        limits = self._source.number
        return Classification("unknown", "it has no limits") if limits is None else self._classify_number(value, limits)

    def _without_value(self, problem: str) -> Classification:
        """Return what it means that nothing was measured; a sensor that never did may be one that is not there."""
        meaning = self._source.no_value
        if meaning == "clear" and not self._measured:
            return Classification("unknown", f"it has measured nothing yet: {problem}")
        self._exceeded = None if meaning == "unknown" else meaning == "blocked"
        return Classification(meaning, f"it measures nothing: {problem}")

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
    for pointer in dict.fromkeys((availability.pointer, None)):  # some versions of a gateway send JSON, others text
        try:
            value = _value(payload, [pointer])
        except _FormatError:
            continue
        if is_one_of(value, availability.offline):
            return False
        if is_one_of(value, availability.online):
            return True
    return None


def _value(payload: bytes | None, pointers: Sequence[str | None]) -> Any:  # noqa: ANN401  # any JSON value
    """Return the value in a payload, by the first JSON pointer (RFC 6901) to one; None: the payload as text."""
    if payload is None:
        raise _FormatError("its message is too long")
    try:
        if None in pointers:
            return payload.decode("utf-8").strip()
        document = msgspec.json.decode(payload)
    except (UnicodeDecodeError, msgspec.DecodeError, RecursionError) as error:
        raise _FormatError(f"{_quoted(payload.decode('utf-8', 'replace'))} is not JSON text") from error
    for pointer in pointers:
        try:
            return _at(document, pointer or "")
        except LookupError:
            continue
    raise _NoValueError(f"there is no {' and no '.join(str(pointer) for pointer in pointers)} in it")


def _at(document: Any, pointer: str) -> Any:  # noqa: ANN401  # any JSON value
    """Return the value to which a JSON pointer leads; raises `LookupError`."""
    found = document
    for part in pointer.split("/")[1:]:
        key = part.replace("~1", "/").replace("~0", "~")
        if isinstance(found, dict) and key in found:
            found = found[key]
        elif isinstance(found, list) and key.isdecimal() and int(key) < len(found):
            found = found[int(key)]
        else:
            raise LookupError(pointer)
    return found


def _number(value: Any) -> float:  # noqa: ANN401  # any JSON value
    if value is None or (isinstance(value, str) and value.casefold() in _NOTHING):
        raise _NoValueError(f"{_quoted(value)} is no number")
    is_text = isinstance(value, str) and value.isascii() and "_" not in value  # Python would read 1_9 as 19
    try:
        number = float(value) if is_text or (isinstance(value, int | float) and not isinstance(value, bool)) else None
    except (ValueError, OverflowError):
        number = None
    if number is None or not abs(number) < float("inf"):
        raise _FormatError(f"{_quoted(value)} is no number")
    return number


def is_one_of(value: Any, meaning: list[str | bool | float]) -> bool:  # noqa: ANN401  # any JSON value
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
