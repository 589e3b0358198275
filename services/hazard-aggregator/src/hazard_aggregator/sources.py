"""Passes messages to the sources that they concern, whatever wildcards these have in their topics. Pure."""

from __future__ import annotations

import math
import re
from itertools import chain
from typing import TYPE_CHECKING, NamedTuple

from hazard_aggregator.node_state import SourceState
from hazard_aggregator.source_reader import is_online

if TYPE_CHECKING:
    from collections.abc import Iterable

    from hazard_aggregator.watched_area import WatchedArea


class Applied(NamedTuple):
    """A source that a message has reached, and whether it could be understood."""

    area: WatchedArea
    source: SourceState
    understood: bool


class _Listener(NamedTuple):
    """A source that a message concerns; `availability`: the message says whether its sensor is connected."""

    area: WatchedArea
    source: SourceState
    availability: bool


class Sources:
    """The sources of all areas by their topics; build a new one when an area changes."""

    def __init__(self, areas: Iterable[WatchedArea] = ()) -> None:
        self._exact: dict[str, list[_Listener]] = {}
        self._wildcards: list[tuple[re.Pattern[str], _Listener]] = []
        self.topics: set[str] = set()
        self._members: list[SourceState] = []
        for area in areas:
            for member in area.nodes.values():
                if isinstance(member, SourceState) and member.source is not None:
                    self._members.append(member)
                    self._add(member.source.topic, _Listener(area, member, availability=False))
                    if member.source.availability is not None:
                        self._add(member.source.availability.topic, _Listener(area, member, availability=True))

    def apply(self, topic: str, payload: bytes | None, now: float, stamp: float, *, retained: bool) -> list[Applied]:
        """Apply a message (None: one that is too long) to the sources that it concerns, and return them.

        A `retained` one has an unknown age: it counts only for a source that publishes on change, and once its sensor
        is known to be connected.
        """
        found = [*self._exact.get(topic, ()), *(one for pattern, one in self._wildcards if pattern.fullmatch(topic))]
        return [
            Applied(area, source, _apply_availability(source, payload, now, stamp))
            if availability
            else Applied(area, source, _apply_value(area, source, payload, now, stamp, retained=retained))
            for area, source, availability in found
        ]

    def on_connection_lost(self) -> set[str]:
        """Forget what sources said that publish on change only; return the ids of their areas.

        Their changes are lost while there is no connection, and a message that the broker kept comes again.
        """
        areas = set()
        for area, source, _ in [*chain.from_iterable(self._exact.values()), *(one for _, one in self._wildcards)]:
            if source.silent_after(area.definition.unknown) == math.inf:
                source.pending = None
                if source.source is not None and source.source.availability is not None:
                    source.online = None
                source.invalidate("the connection to the broker was lost, and it tells only changes")
                areas.add(area.definition.id)
        return areas

    def pop_new_topics(self) -> set[str]:
        """Return the topics of sources that are new since the last call: a subscription delivers what is retained."""
        topics: set[str | None] = set()
        for member in self._members:
            if member.new and member.source is not None:
                member.new = False
                availability = member.source.availability
                topics |= {member.source.topic, None if availability is None else availability.topic}
        return {topic for topic in topics if topic is not None}

    def _add(self, topic: str | None, listener: _Listener) -> None:
        if topic is None:
            return
        self.topics.add(topic)
        if "+" in topic or "#" in topic:
            self._wildcards.append((_pattern(topic), listener))
        else:
            self._exact.setdefault(topic, []).append(listener)


def _pattern(topic: str) -> re.Pattern[str]:
    """Return the topics that a subscription matches: + is one level, # any further ones, also none."""
    levels = [{"+": "[^/]*", "#": ".*"}.get(level, re.escape(level)) for level in topic.split("/")]
    return re.compile("/".join(levels).replace("/.*", "(/.*)?"))


def _apply_value(
    area: WatchedArea, source: SourceState, payload: bytes | None, now: float, stamp: float, *, retained: bool
) -> bool:
    if not retained:
        source.pending = None
        return _read(source, payload, now, stamp)
    if source.silent_after(area.definition.unknown) == math.inf:
        if source.online or payload is None:
            return _read(source, payload, now, stamp)
        source.pending = payload
    return True


def _apply_availability(source: SourceState, payload: bytes | None, now: float, stamp: float) -> bool:
    availability = None if source.source is None else source.source.availability
    online = None if availability is None else is_online(availability, payload)
    if online is None:
        return False
    pending, source.pending = source.pending, None
    source.online = online
    if not online:
        source.invalidate("it went offline")
    elif pending is not None:
        return _read(source, pending, now, stamp)
    return True


def _read(source: SourceState, payload: bytes | None, now: float, stamp: float) -> bool:
    """Apply a value; one that is not understood makes the source unknown at once. Return whether it was.

    Further ones leave the reason: the hazard would change with each of them.
    """
    if source.reader is None:
        return False
    classification = source.reader.classify(payload)
    if classification.state == "unknown":
        source.receive(now)
        if not source.misread:
            source.invalidate(classification.reason)
            source.misread = True
        return False
    source.misread = False
    source.apply(classification, now, stamp)
    return True
