"""What a source's messages mean, and ready-made profiles of common sensors. Pure.

Each profile is written from the documentation of its project: Zigbee2MQTT (MQTT topics and messages), ESPHome
(MQTT client component), Tasmota (MQTT, HC-SR04), Shelly (Gen1: MQTT of the door/window sensors; Gen2 and later: status
of an input), Home Assistant (MQTT statestream).
"""

from __future__ import annotations

import math
import re
import unicodedata
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec import structs

from fog_contracts.messages import Availability, NodeCode, Reason, Source
from hazard_aggregator.area_size import AreaError
from hazard_aggregator.readings import Classification

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from fog_contracts.messages import Limits

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
                    reported = Reason(NodeCode.REPORTED, f"it reports {_quoted(value)}")
                    return Classification(state, reported)  # type: ignore[arg-type]  # a literal
        except _FormatError as error:
            if source.number is not None and isinstance(error, _NoValueError):
                return self._without_value(str(error))
            return _unknown(NodeCode.NOT_UNDERSTOOD, f"its format has changed: {error}")
        return _unknown(NodeCode.NOT_UNDERSTOOD, f"{_quoted(value)} means neither blocked nor clear")

    def classify_value(self, value: float) -> Classification:
        """Return what a number means that came as such, from a node of Fognav."""
        limits = self._source.number
        if limits is None:
            return _unknown(NodeCode.NO_LIMITS, "it has no limits")
        return self._classify_number(value, limits)

    def _without_value(self, problem: str) -> Classification:
        """Return what it means that nothing was measured; a sensor that never did may be one that is not there."""
        meaning = self._source.no_value
        if meaning == "clear" and not self._measured:
            return _unknown(NodeCode.MEASURES_NOTHING, f"it has measured nothing yet: {problem}")
        self._exceeded = None if meaning == "unknown" else meaning == "blocked"
        return Classification(meaning, Reason(NodeCode.MEASURES_NOTHING, f"it measures nothing: {problem}"))

    def _classify_number(self, value: float, limits: Limits) -> Classification:
        if not _within(value, limits.minimum, limits.maximum):
            self._exceeded = None
            bounds = f"{_bound(limits.minimum, 'at least')}{_bound(limits.maximum, 'at most')}".removesuffix(", ")
            return _unknown(NodeCode.IMPLAUSIBLE, f"{value:g} is implausible: it should be {bounds}")
        # Within the hysteresis a number stays on its side; one that has none yet counts as a danger.
        margin = 0.0 if self._exceeded is False else limits.hysteresis
        above = limits.above is not None and value > limits.above - margin
        below = limits.below is not None and value < limits.below + margin
        self._exceeded = above or below
        if above:
            return Classification("blocked", Reason(NodeCode.BEYOND_LIMITS, f"{value:g} is above {limits.above:g}"))
        if below:
            return Classification("blocked", Reason(NodeCode.BEYOND_LIMITS, f"{value:g} is below {limits.below:g}"))
        return Classification("clear", Reason(NodeCode.WITHIN_LIMITS, f"{value:g} is within its limits"))


def _unknown(code: NodeCode, sentence: str) -> Classification:
    return Classification("unknown", Reason(code, sentence))


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


# The gateway's own state; its device's, which it publishes if its `availability` is enabled. Once it has started it
# publishes what it knows of each device from before, unless its `cache_state_send_on_startup` is off.
_Z2M: Final = [
    Availability(topic="zigbee2mqtt/bridge/state", pointer="/state", recalls=True),
    Availability(topic="zigbee2mqtt/{device}/availability", pointer="/state"),
]
_TASMOTA: Final = Availability(topic="tele/{device}/LWT", online=["Online"], offline=["Offline"])
_SHELLY: Final = Availability(topic="{device}/online", online=["true"], offline=["false"])

PROFILES: Final[Mapping[str, Source]] = {
    "zigbee2mqtt-occupancy": Source(
        id="profile", topic="zigbee2mqtt/{device}", pointer="/occupancy", blocked=[True], clear=[False],
        availability=_Z2M,
    ),
    # A magnet beside its contact (`contact` is true) is a closed door: the area behind it is not open to robots.
    "zigbee2mqtt-contact": Source(
        id="profile", topic="zigbee2mqtt/{device}", pointer="/contact", blocked=[True], clear=[False],
        availability=_Z2M,
    ),
    # `device`: PREFIX/sensor/NAME or PREFIX/binary_sensor/NAME; the device's state is published on PREFIX/status.
    "esphome-distance": Source(id="profile", topic="{device}/state", period_s=60.0),
    "esphome-binary": Source(
        id="profile", topic="{device}/state", blocked=["ON"], clear=["OFF"],
        availability=Availability(topic="{prefix}/status"),
    ),
    # In cm; Tasmota publishes at its TelePeriod, which is 300 s unless it is set: 10 s is the least. It numbers its
    # sensors, with a separator that its SetOption64 chooses; older versions did not number a single one.
    "tasmota-distance": Source(
        id="profile", topic="tele/{device}/SENSOR", period_s=10.0, availability=_TASMOTA,
        pointer=["/SR04-1/Distance", "/SR04_1/Distance", "/SR04/Distance"],
    ),
    # These sleep between two messages, and are not connected then; they wake up at least every 12 hours.
    "shelly-door-gen1": Source(
        id="profile", topic="shellies/{device}/sensor/state", blocked=["close"], clear=["open"], period_s=43_200.0,
    ),
    # A reed contact on the input of a Gen2 device that is always powered.
    "shelly-door-gen2": Source(
        id="profile", topic="{device}/status/input:0", pointer="/state", blocked=[True], clear=[False],
        availability=_SHELLY,
    ),
    # `device`: BASE/binary_sensor/NAME. Home Assistant publishes `unavailable` and `unknown` as states, and says by its
    # own birth and will message whether it runs.
    "home-assistant": Source(
        id="profile", topic="{device}/state", blocked=["on"], clear=["off"],
        availability=Availability(topic="homeassistant/status"),
    ),
}  # fmt: skip
"""What a source of each profile does not say itself; `{device}` is its `device`, `{prefix}` the beginning of that."""

_ENTITY: Final = re.compile(r"/(binary_sensor|sensor)/[^/]+$")

_SLASHES: Final = 200
"""In a topic to which Mosquitto lets one subscribe."""
_VALUE_PERIOD_S: Final = 2.0
"""A node with several quantities takes turns."""


class SourceError(AreaError):
    """A source is invalid; the message names area, source, field and remedy."""


def resolve(area: str, source: Source) -> Source:
    """Return a source with what its profile gives, and its topics filled in; raises `SourceError`."""
    if source.quantity is not None:
        return _quantity(area, source)
    if source.profile is not None:
        profile = PROFILES.get(source.profile)
        if profile is None:
            raise SourceError(
                area, f"sources.{source.id}.profile", f"there is no {source.profile} (known: {', '.join(PROFILES)})"
            )
        if not source.device:
            raise SourceError(area, f"sources.{source.id}.device", f"the profile {source.profile} needs one")
        default = Source(id=source.id)
        own = {name for name, value in structs.asdict(source).items() if value != getattr(default, name)}
        source = structs.replace(profile, **{name: getattr(source, name) for name in own | {"id"}})
    source = _filled_in(area, source)
    _check(area, source)
    return source


def _quantity(area: str, source: Source) -> Source:
    """Return a node's quantity with its period: a node publishes each of its values once a second."""
    where = f"sources.{source.id}"
    if source != Source(
        id=source.id, quantity=source.quantity, number=source.number, period_s=source.period_s,
        penalty=source.penalty, debounce=source.debounce,
    ):  # fmt: skip
        problem = "a node's quantity has a `number`, and may have `period_s`, `penalty` and `debounce`: nothing else"
        raise SourceError(area, f"{where}.quantity", problem)
    _check_number(area, source)
    return source if source.period_s is not None else structs.replace(source, period_s=_VALUE_PERIOD_S)


def _check_number(area: str, source: Source) -> None:
    where, limits = f"sources.{source.id}.number", source.number
    if limits is None or (limits.above is None and limits.below is None):
        raise SourceError(area, where, "it needs `above` or `below`")
    clear_from = max(_or(limits.below, -math.inf) + limits.hysteresis, _or(limits.minimum, -math.inf))
    clear_to = min(_or(limits.above, math.inf) - limits.hysteresis, _or(limits.maximum, math.inf))
    if clear_from > clear_to:
        problem = (
            f"nothing would be clear: that would be at least {clear_from:g} and at most {clear_to:g}. Raise `above`, "
            "lower `below` or `hysteresis`, or widen `minimum` to `maximum`"
        )
        raise SourceError(area, where, problem)


def _or(limit: float | None, none: float) -> float:
    return none if limit is None else limit


def _check_meanings(area: str, source: Source) -> None:
    """Raise `SourceError` if a value means two things."""
    where = f"sources.{source.id}"
    pairs = [(where, "blocked", source.blocked, "clear", source.clear)] + [
        (f"{where}.availability", "online", each.online, "offline", each.offline) for each in source.availabilities
    ]
    for where, name, one, other_name, other in pairs:
        if both := [value for value in one if is_one_of(value, other)]:
            problem = f"{both[0]!r} means both {name} and {other_name}: take it out of one of them"
            raise SourceError(area, where, problem)


def _filled_in(area: str, source: Source) -> Source:
    """Return a source with its topics filled in; `{prefix}` is all before the kind of an ESPHome device's entity."""
    device, where = source.device, f"sources.{source.id}"

    def filled(topic: str) -> str:
        if "{prefix}" in topic:
            prefix = _ENTITY.sub("", device)
            if prefix in {"", device}:
                problem = f"{device!r} is no PREFIX/binary_sensor/NAME or PREFIX/sensor/NAME, as its MQTT log names it"
                raise SourceError(area, f"{where}.device", problem)
            topic = topic.replace("{prefix}", prefix)
        return topic.replace("{device}", device)

    if source.topic is None:
        raise SourceError(area, f"{where}.topic", "it has none: give a topic, or a profile")
    return structs.replace(
        source,
        topic=_checked(area, f"{where}.topic", filled(source.topic)),
        availability=[
            structs.replace(each, topic=_checked(area, f"{where}.availability.topic", filled(each.topic)))
            for each in source.availabilities
        ],
    )


def _checked(area: str, where: str, topic: str) -> str:
    """Return a topic to which a broker lets one subscribe, and at which one sensor speaks; else raises `SourceError`.

    Mosquitto closes the connection of whoever subscribes to one with a control character, again after each connect.
    """
    problem = ""
    if not topic:
        problem = "it is empty: name the sensor's topic"
    elif bad := next((each for each in topic if not _is_allowed(each)), None):
        problem = f"{topic!r} has the character U+{ord(bad):04X}, which brokers refuse: name the topic without it"
    elif topic.count("/") > _SLASHES:
        problem = f"it has {topic.count('/')} slashes, and brokers refuse more than {_SLASHES}: name the sensor's topic"
    elif topic.startswith("$"):
        problem = f"{topic!r} is the broker's own, or a shared subscription ($): name the sensor's topic"
    elif "+" in topic or "#" in topic:
        problem = (
            f"{topic!r} has a wildcard (+ or #), and one sensor could clear what another blocks: "
            "give each sensor a source of its own"
        )
    if problem:
        raise SourceError(area, where, problem)
    return topic


def _is_allowed(character: str) -> bool:
    """Whether a topic may contain a character: no control character and no noncharacter (MQTT 3.1.1, 1.5.3)."""
    code = ord(character)
    return (
        unicodedata.category(character) not in {"Cc", "Cs"} and code & 0xFFFE != 0xFFFE and not 0xFDD0 <= code <= 0xFDEF
    )


def _check(area: str, source: Source) -> None:
    where = f"sources.{source.id}"
    if source.number is None and not (source.blocked and source.clear):
        problem = "it says neither which values mean blocked and clear, nor the limits of a `number`"
        raise SourceError(area, where, problem)
    if source.number is not None:
        _check_number(area, source)
    _check_meanings(area, source)
    if source.period_s is None and not source.availabilities:
        problem = "it has no `period_s` and no `availability`: nobody would notice that it is dead"
        raise SourceError(area, where, problem)
