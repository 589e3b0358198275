"""Passes messages to the sources that they concern. Pure."""

from __future__ import annotations

from itertools import chain
from typing import TYPE_CHECKING, Final, NamedTuple

from fog_contracts.messages import NodeCode, Reason
from hazard_aggregator.node_state import SourceState
from hazard_aggregator.readings import Classification
from hazard_aggregator.source_values import is_online

if TYPE_CHECKING:
    from collections.abc import Iterable
    from collections.abc import Set as AbstractSet

    from fog_contracts.messages import Availability, NodeValue
    from hazard_aggregator.areas import WatchedArea

_WRAP: Final = 2**32


class Applied(NamedTuple):
    """A source that a message has reached, and whether it could be understood."""

    area: WatchedArea
    source: SourceState
    understood: bool


class _Listener(NamedTuple):
    """A source that a message concerns; with an `availability` it says whether the source's sensor is connected."""

    area: WatchedArea
    source: SourceState
    availability: Availability | None = None


class Sources:
    """The sources of all areas by their topics; build a new one when an area changes."""

    def __init__(self, areas: Iterable[WatchedArea] = ()) -> None:
        self._by_topic: dict[str, list[_Listener]] = {}
        self._members: list[SourceState] = []
        self._quantities: dict[str, list[tuple[WatchedArea, SourceState]]] = {}
        for area in areas:
            for member in area.nodes.values():
                if isinstance(member, SourceState) and member.source is not None:
                    self._members.append(member)
                    if (quantity := member.source.quantity) is not None:
                        self._quantities.setdefault(quantity.node, []).append((area, member))
                    self._add(member.source.topic, _Listener(area, member))
                    for availability in member.source.availabilities:
                        self._add(availability.topic, _Listener(area, member, availability))

    @property
    def topics(self) -> AbstractSet[str]:
        """The topics to subscribe to."""
        return self._by_topic.keys()

    def apply(self, topic: str, payload: bytes | None, now: float, stamp: float, *, retained: bool) -> list[Applied]:
        """Apply a message (None: one that is too long) to the sources that it concerns, and return them.

        A `retained` one has an unknown age: it counts only for a source that publishes on change, and once its sensor
        is known to be connected. One from before an outage never counts.
        """
        return [
            Applied(area, source, _apply_availability(source, availability, payload, now, stamp, retained=retained))
            if availability
            else Applied(area, source, _apply_value(source, payload, now, stamp, retained=retained))
            for area, source, availability in self._by_topic.get(topic, ())
        ]

    def apply_value(self, node: str, value: NodeValue, now: float, stamp: float) -> list[Applied]:
        """Apply what a node measured to the sources of its kind, unless they have it, or a newer one, already."""
        applied = []
        for area, source in self._quantities.get(node, ()):
            quantity = None if source.source is None else source.source.quantity
            if quantity is None or quantity.kind != value.kind:
                continue
            if source.value_at is not None and not _is_newer(value, *source.value_at):
                source.ignored += 1
                continue
            source.value_at = value.boot, value.seq
            if source.reader is not None:
                understood = _apply(source, source.reader.classify_value(value.value), now, stamp)
                applied.append(Applied(area, source, understood))
        return applied

    def on_node_offline(self, node: str) -> list[WatchedArea]:
        """Forget what a node measured that is no longer connected; return the areas of that."""
        for _, source in self._quantities.get(node, ()):
            source.invalidate(Reason(NodeCode.OFFLINE, "it went offline"))
            source.online = False
        return [area for area, _ in self._quantities.get(node, ())]

    def on_connection_lost(self) -> set[str]:
        """Forget what sources said that publish on change only; return the ids of their areas.

        Their changes are lost while there is no connection, and a message that the broker kept comes again.
        """
        areas = set()
        for area, source, _ in chain.from_iterable(self._by_topic.values()):
            if source.publishes_on_change:
                source.forget()
                sentence = "the connection to the broker was lost, and it tells only changes"
                source.invalidate(Reason(NodeCode.CONNECTION_LOST, sentence))
                areas.add(area.definition.id)
        return areas

    def pop_new_topics(self) -> set[str]:
        """Return the topics of sources that are new since the last call: a subscription delivers what is retained."""
        topics: set[str | None] = set()
        for member in self._members:
            if member.new and member.source is not None:
                member.new = False
                topics |= {member.source.topic, *(each.topic for each in member.source.availabilities)}
        return {topic for topic in topics if topic is not None}

    def _add(self, topic: str | None, listener: _Listener) -> None:
        if topic is not None:
            self._by_topic.setdefault(topic, []).append(listener)


def _is_newer(value: NodeValue, boot: int, seq: int) -> bool:
    """Whether a value came after that one; the count of a node has 32 bits and wraps."""
    return value.boot != boot or 0 < (value.seq - seq) % _WRAP < _WRAP // 2


def _apply_value(source: SourceState, payload: bytes | None, now: float, stamp: float, *, retained: bool) -> bool:
    if not retained:
        source.pending = None
        return _read(source, payload, now, stamp)
    if source.publishes_on_change:
        if source.online or payload is None:
            return _read(source, payload, now, stamp)
        source.pending = payload if source.online is None else None
    return True


def _apply_availability(
    source: SourceState, availability: Availability, payload: bytes | None, now: float, stamp: float, *, retained: bool
) -> bool:
    """Apply what says whether a source's sensor is connected; return whether it was understood."""
    was_online, online = source.online, is_online(availability, payload)
    # It may be online already, and say so again before it repeats what it knows, for somebody who has just started.
    if availability.recalls and online and not retained:
        source.recalled |= source.state == "unknown" or not source.said.get(availability.topic)
    source.say(availability.topic, online=online is True)
    if not online:
        source.pending = None
        reason = "it went offline" if online is False else f"{availability.topic} says neither online nor offline"
        if source.state != "unknown" or was_online:
            code = NodeCode.OFFLINE if online is False else NodeCode.NOT_UNDERSTOOD
            source.invalidate(Reason(code, reason))
    elif source.online and not was_online:
        pending, source.pending = source.pending, None
        if pending is not None and not source.recalled:
            return _read(source, pending, now, stamp)
    return online is not None


def _read(source: SourceState, payload: bytes | None, now: float, stamp: float) -> bool:
    """Apply a value; one that is not understood makes the source unknown at once. Return whether it was.

    What clears counts only while nothing makes it doubtful: a sensor that nobody watches would keep an area clear.
    """
    if source.reader is None:
        return False
    classification, doubt = source.reader.classify(payload), source.doubt
    source.recalled = False
    if classification.state != "clear" or doubt is None:
        return _apply(source, classification, now, stamp)
    recalls = source.online is False and any(each.recalls for each in source.availabilities)
    if not source.online and not recalls and source.publishes_on_change:
        source.pending = payload
    _apply(source, Classification("unknown", doubt), now, stamp)
    return True


def _apply(source: SourceState, classification: Classification, now: float, stamp: float) -> bool:
    if classification.state == "unknown":
        source.receive(now)
        if source.flaps.update("unknown", now):  # it is understood and not, in turn
            source.flap()
        # Further ones leave the reason: the hazard would change with each of them.
        elif not source.misread:
            source.invalidate(classification.reason)
            source.misread = True
        return False
    source.misread = False
    source.apply(classification, now, stamp)
    return True
