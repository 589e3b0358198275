"""Ready-made profiles of common sensors: topics, and what their values mean. Pure.

Each is written from the documentation of its project: Zigbee2MQTT (MQTT topics and messages), ESPHome (MQTT client
component), Tasmota (MQTT, HC-SR04), Shelly (Gen1: MQTT of the door/window sensors; Gen2 and later: status of an input),
Home Assistant (MQTT statestream).
"""

from __future__ import annotations

import math
import re
import unicodedata
from typing import TYPE_CHECKING, Final

from msgspec import structs

from fog_contracts.messages import Availability, Source
from hazard_aggregator.area_size import AreaError
from hazard_aggregator.sensors.source_reader import is_one_of

if TYPE_CHECKING:
    from collections.abc import Mapping

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
