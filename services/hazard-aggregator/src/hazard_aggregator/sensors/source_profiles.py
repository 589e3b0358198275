"""Ready-made profiles of common sensors: topics, and what their values mean. Pure.

Each is written from the documentation of its project: Zigbee2MQTT (MQTT topics and messages), ESPHome (MQTT client
component), Tasmota (MQTT, HC-SR04), Shelly (Gen1: MQTT of the door/window sensors; Gen2 and later: status of an input),
Home Assistant (MQTT statestream).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from msgspec import structs

from fog_contracts.messages import Availability, Source
from hazard_aggregator.area_size import AreaError

if TYPE_CHECKING:
    from collections.abc import Mapping

_Z2M: Final = Availability(topic="zigbee2mqtt/{device}/availability", pointer="/state")
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
    # In cm; Tasmota publishes at its TelePeriod, which is 300 s unless it is set: 10 s is the least.
    "tasmota-distance": Source(
        id="profile", topic="tele/{device}/SENSOR", pointer="/SR04/Distance", period_s=10.0, availability=_TASMOTA,
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
"""What a source of each profile does not say itself; `{device}` is its `device`, `{prefix}` the first level of that."""


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
    source = _filled_in(source)
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
    if source.number is None or (source.number.above is None and source.number.below is None):
        raise SourceError(area, f"sources.{source.id}.number", "it needs `above` or `below`")


def _filled_in(source: Source) -> Source:
    device = source.device
    names = {"{device}": device, "{prefix}": device.split("/", maxsplit=1)[0]}

    def filled(topic: str) -> str:
        for placeholder, name in names.items():
            topic = topic.replace(placeholder, name)
        return topic

    if source.topic is not None:
        source = structs.replace(source, topic=filled(source.topic))
    if source.availability is not None:
        topic = filled(source.availability.topic)
        source = structs.replace(source, availability=structs.replace(source.availability, topic=topic))
    return source


def _check(area: str, source: Source) -> None:
    where = f"sources.{source.id}"
    if source.topic is None:
        raise SourceError(area, f"{where}.topic", "it has none: give a topic, or a profile")
    topics = [source.topic, *([source.availability.topic] if source.availability is not None else ())]
    for topic in topics:
        levels = topic.split("/")
        if any(("+" in level and level != "+") or ("#" in level and level != "#") for level in levels) or (
            "#" in levels[:-1]
        ):
            raise SourceError(area, f"{where}.topic", f"{topic!r}: + and # stand for whole levels, # for the last ones")
    if source.number is None and not (source.blocked and source.clear):
        problem = "it says neither which values mean blocked and clear, nor the limits of a `number`"
        raise SourceError(area, where, problem)
    if source.number is not None:
        _check_number(area, source)
    if source.period_s is None and source.availability is None:
        problem = "it has no `period_s` and no `availability`: nobody would notice that it is dead"
        raise SourceError(area, where, problem)
