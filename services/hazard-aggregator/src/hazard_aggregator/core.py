"""The aggregator's decisions: area states from readings, when a hazard may be announced, and what is republished.

Pure: every input comes with its `Moment`, and everything to be published is returned. `fusion` turns readings into
states. `Outbox` withholds a relief until it is stored: the process writes `to_store()` and then calls `mark_stored`.
"""

from __future__ import annotations

import math
from collections import deque
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from msgspec import structs

from fog_contracts import channels as ch
from fog_contracts.handlers import Publication, RefusedMessageError, within_reach
from fog_contracts.messages import AggregatorHeartbeat, hazards_digest, is_relief
from hazard_aggregator.overrides import Overrides
from hazard_aggregator.publications import definition_publication, deletions, hazard_publications, node_publication

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping, Sequence
    from collections.abc import Set as AbstractSet

    from fog_contracts.channels import Channel
    from fog_contracts.geometry import Point
    from fog_contracts.handlers import Handler, Ids, Moment, QueryHandler
    from fog_contracts.messages import AreaDefinition, AreaHazard, NodeReading, NodeValue, Reported, RobotPose
    from hazard_aggregator.alerts import NodeReport
    from hazard_aggregator.areas import AreaOverride
    from hazard_aggregator.fusion import AreaFusion
    from hazard_aggregator.overrides import StoredOverrides
    from hazard_aggregator.readings import Rejection

_MAX_FOREIGN: Final = 100
"""Messages of others between two calls of `pop`; further ones are not counted."""

ForeignKind = Literal["area", "hazard", "heartbeat"]


class ForeignMessage(NamedTuple):
    """A message of another sender on our topics: about an area that we don't list, or above our epoch."""

    kind: ForeignKind
    epoch: int
    area: str


class ForeignMessages:
    """Collects them; `epoch` is the highest one of another sender that receivers follow, 0 before the first."""

    def __init__(self) -> None:
        self.epoch = 0
        self._found: list[ForeignMessage] = []

    def add(self, kind: ForeignKind, epoch: int, area: str) -> None:
        """Record a message that another sender published."""
        self.epoch = max(self.epoch, within_reach(epoch, self.epoch))
        if len(self._found) < _MAX_FOREIGN:
            self._found.append(ForeignMessage(kind, epoch, area))

    def pop(self) -> list[ForeignMessage]:
        """Return the messages since the last call."""
        found, self._found = self._found, []
        return found


_HAZARDS: Final = 64
"""Hazards remembered per area: more than one area changes while a message is under way."""
_HEARTBEATS: Final = 3000
"""Heartbeats remembered: those of ten minutes."""


class OwnMessages:
    """The latest hazards and heartbeats that were published."""

    def __init__(self) -> None:
        self._hazards: dict[str, deque[tuple[int, int, str, int]]] = {}
        self._heartbeats: deque[tuple[int, float]] = deque(maxlen=_HEARTBEATS)

    def add(self, hazard: AreaHazard) -> None:
        """Remember a hazard that is published now."""
        if not self.contains(hazard):
            self._hazards.setdefault(hazard.area, deque(maxlen=_HAZARDS)).append(_content(hazard))

    def contains(self, hazard: AreaHazard) -> bool:
        """Whether this hazard was published here."""
        return _content(hazard) in self._hazards.get(hazard.area, ())

    def add_heartbeat(self, heartbeat: AggregatorHeartbeat) -> None:
        """Remember a heartbeat that is published now."""
        self._heartbeats.append((heartbeat.epoch, heartbeat.uptime))

    def contains_heartbeat(self, heartbeat: AggregatorHeartbeat) -> bool:
        """Whether this heartbeat was published here."""
        # The newest one is the most likely.
        return (heartbeat.epoch, heartbeat.uptime) in reversed(self._heartbeats)


def _content(hazard: AreaHazard) -> tuple[int, int, str, int]:
    return hazard.epoch, hazard.seq, hazard.state, hazard.penalty


class Outbox:
    """Per area the newest hazard, whether it is stored, and the last announced one.

    A relief is a change that allows robots more than before. A slow or dead store must not delay a danger, and a crash
    must not undo an announced relief: a `clear` that was announced but not stored would leave robots in an area that
    the restarted aggregator announces as blocked.
    """

    def __init__(self) -> None:
        self._announced: dict[str, AreaHazard] = {}
        self._unstored: dict[str, AreaHazard] = {}

    def offer(self, hazards: Iterable[AreaHazard]) -> list[AreaHazard]:
        """Add changed hazards, all of which must be stored; return those to announce at once."""
        to_announce: list[AreaHazard] = []
        for hazard in hazards:
            self._unstored[hazard.area] = hazard
            if not is_relief(hazard, self._announced.get(hazard.area)):
                self._announced[hazard.area] = hazard
                to_announce.append(hazard)
        return to_announce

    def unstored(self) -> list[AreaHazard]:
        """Return the hazards that must be stored, the newest of each area."""
        return list(self._unstored.values())

    def mark_stored(self, hazards: Iterable[AreaHazard]) -> list[AreaHazard]:
        """Record that these hazards are stored; return those to announce now, unless a newer one replaced them."""
        to_announce: list[AreaHazard] = []
        for hazard in hazards:
            if self._unstored.get(hazard.area) is not hazard:
                continue
            del self._unstored[hazard.area]
            if self._announced.get(hazard.area) is not hazard:
                self._announced[hazard.area] = hazard
                to_announce.append(hazard)
        return to_announce

    def announced(self) -> list[AreaHazard]:
        """Return the last announced hazard of every area, to republish after a reconnect."""
        return list(self._announced.values())

    def withheld(self) -> list[str]:
        """Return the areas whose newest hazard is announced only once it is stored."""
        return sorted(area for area, hazard in self._unstored.items() if self._announced.get(area) is not hazard)

    def set_epoch(self, epoch: int) -> None:
        """Give all hazards another epoch; those that are not stored yet must be stored with it."""
        for area, hazard in self._announced.items():
            renamed = self._announced[area] = structs.replace(hazard, epoch=epoch)
            if self._unstored.get(area) is hazard:
                self._unstored[area] = renamed
        for area, hazard in self._unstored.items():
            if hazard.epoch != epoch:
                self._unstored[area] = structs.replace(hazard, epoch=epoch)

    def forget(self, area: str) -> None:
        """Discard a removed area's hazards."""
        self._announced.pop(area, None)
        self._unstored.pop(area, None)


_HALF_TICK_S: Final = 0.05
REPUBLISH_PAUSE_S: Final = 0.5
"""Between two answers to requests for everything, each of which is hundreds of messages; the map asks once a second."""


class Aggregator:
    """The aggregator's core: what `fusion` decides, published in the order that `Outbox` allows.

    `complete`: whether `fusion` has all areas and stored hazards; else `restore` adds what the store holds.
    """

    def __init__(self, fusion: AreaFusion, *, complete: bool = True) -> None:
        self.epoch = fusion.epoch
        self.nodes = fusion.nodes
        self.overrides = Overrides(fusion)
        self._fusion = fusion
        self._outbox = Outbox()
        self._own = OwnMessages()
        self._complete = complete
        self._unlisted: set[str] = set()
        self._foreign = ForeignMessages()
        self._heartbeat_at = -math.inf
        self._republished_at = -math.inf

    # --- State ------------------------------------------------------------------------------------------------------

    def definitions(self) -> list[AreaDefinition]:
        """Return all areas, removed ones (`removed`) too, so that they can be taken off the map."""
        return self._fusion.definitions()

    def announced(self) -> dict[str, AreaHazard]:
        """Return the last announced hazard of every area."""
        return {hazard.area: hazard for hazard in self._outbox.announced()}

    def withheld(self) -> list[str]:
        """Return the areas whose newest hazard is a relief that is not stored yet."""
        return self._outbox.withheld()

    def to_store(self) -> list[AreaHazard]:
        """Return the hazards that must be stored, the newest of each area."""
        return self._outbox.unstored()

    def thesis_numbers(self) -> list[int]:
        """Return the area numbers under which the thesis's nodes may report."""
        return sorted({d.number for d in self.definitions() if d.number is not None and not d.removed})

    def source_topics(self) -> AbstractSet[str]:
        """Return the topics of all areas' sources."""
        return self._fusion.source_topics()

    def pop_new_source_topics(self) -> set[str]:
        """Return the topics of sources that are new or have changed: the broker has to deliver what it retains."""
        return self._fusion.pop_new_source_topics()

    def node_reports(self, now: float) -> list[NodeReport]:
        """Return the health of every node of every area."""
        return self._fusion.node_reports(now)

    def checked(self, definition: AreaDefinition) -> AreaDefinition:
        """Return an area as it counts, with the polygon of its node's cone if it is one; raises `AreaError`."""
        return self._fusion.checked(definition)

    def cone(self, area: str, node: str, nodes: Collection[str]) -> list[Point]:
        """Return what the sonars of a node see as the polygon of an area with these nodes; raises `AreaError`."""
        return self._fusion.cone(area, node, nodes)

    def pop_foreign(self) -> list[ForeignMessage]:
        """Return the messages of others on this aggregator's topics since the last call, for logs and metrics."""
        return self._foreign.pop()

    def pop_rejections(self) -> list[tuple[str, Rejection]]:
        """Return nodes whose readings did not count since the last call, each with the reason, for metrics."""
        return self._fusion.pop_rejections()

    @property
    def outranked_by(self) -> int | None:
        """The highest epoch that another sender uses on our topics, unless ours is above it.

        The map believes that sender, or no one: this aggregator needs an epoch above it (`set_epoch`).
        """
        return self._foreign.epoch if self._foreign.epoch >= self.epoch else None

    # --- Inputs -----------------------------------------------------------------------------------------------------

    def handlers(self) -> Mapping[Channel, Handler]:
        """Return the handler of every channel that the aggregator subscribes to."""
        return {
            ch.NODE_READING: self._on_reading,
            ch.NODE_VALUE: self._on_value,
            ch.NODE_AVAILABILITY: self._on_availability,
            ch.THESIS_AREA: self._on_thesis_state,
            ch.AREA_HAZARD: self._on_hazard,
            ch.AGGREGATOR_HEARTBEAT: self._on_heartbeat,
            ch.AGGREGATOR_REQUEST: self._on_request,
            ch.ROBOT_POSE: self._on_pose,
            ch.REPORTED: self._on_reported,
        }

    def query_handlers(self) -> Mapping[Channel, QueryHandler]:
        """Return the handler of every query: the aggregator answers none."""
        return {}

    def on_source(self, topic: str, payload: bytes | None, at: Moment, *, retained: bool) -> list[Publication]:
        """Handle a message (None: one that is too long) on one of the `source_topics`, which are the sensors' own."""
        return self._announce(self._fusion.on_source(topic, payload, at.now, at.stamp, retained=retained))

    def on_connection_lost(self, at: Moment) -> list[Publication]:
        """Handle the loss of the connection to the broker: what changed meanwhile may never be told."""
        return self._announce(self._fusion.on_connection_lost(at.stamp))

    def tick(self, at: Moment) -> list[Publication]:
        """End overrides, detect silent and flapping nodes, publish the heartbeat if it is due; call it at 10 Hz."""
        publications = self._announce([*self.overrides.tick(at), *self._fusion.tick(at.now, at.stamp)])
        if at.now - self._heartbeat_at > ch.AGGREGATOR_HEARTBEAT.period_s - _HALF_TICK_S:
            self._heartbeat_at = at.now
            publications.append(Publication(ch.AGGREGATOR_HEARTBEAT, self._heartbeat(at)))
        return publications

    def set_epoch(self, epoch: int) -> list[Publication]:
        """Continue with a higher epoch; return everything, published again with it."""
        if epoch <= self.epoch:
            raise ValueError(f"the epoch only grows: {epoch} is not above {self.epoch}")
        self.epoch = epoch
        self._fusion.set_epoch(epoch)
        self._outbox.set_epoch(epoch)
        return self.republish_all()

    def mark_stored(self, hazards: Iterable[AreaHazard]) -> list[Publication]:
        """Record that these hazards of `to_store` are stored; return the reliefs among them, announced now."""
        return self._hazard_publications(self._outbox.mark_stored(hazards))

    def put_area(self, definition: AreaDefinition, at: Moment) -> list[Publication]:
        """Add, change or (with `removed`) remove an area that is stored; its nodes keep their confirmed states."""
        changed = self._fusion.put_area(definition, at.stamp)
        if definition.removed:
            self._outbox.forget(definition.id)
            ended = self._announce(self.overrides.tick(at))
            return [definition_publication(definition, self.epoch), *deletions(definition.id), *ended]
        return [definition_publication(definition, self.epoch), *self._announce(changed)]

    def put_override(self, override: AreaOverride, at: Moment) -> list[Publication]:
        """Put an operator's override, which is stored, into force."""
        return self._announce(self.overrides.put(override, at))

    def remove_override(self, area: str, at: Moment) -> list[Publication]:
        """End an override, which is not stored any more: the area's nodes count again."""
        return self._announce(self.overrides.remove(area, at))

    def load_overrides(self, stored: StoredOverrides, at: Moment) -> list[Publication]:
        """Put the stored overrides into force, and end all others."""
        return self._announce(self.overrides.replace_all(stored, at))

    def restore(
        self, definitions: Iterable[AreaDefinition], hazards: Iterable[AreaHazard], at: Moment
    ) -> list[Publication]:
        """Restore areas and hazards that were unreadable at the start of this run; republish everything.

        Now all areas are known: retained messages of others are deleted from the broker.
        """
        for definition in definitions:
            self._outbox.offer(self._fusion.put_area(definition, at.stamp))
            if definition.removed:  # while another aggregator led
                self._outbox.forget(definition.id)
        self._outbox.offer(self._fusion.restore(hazards, at.stamp))
        self._complete = True
        unlisted, self._unlisted = self._unlisted - set(self._listed()), set()
        return [*self.republish_all(), *(deletion for area in sorted(unlisted) for deletion in deletions(area))]

    def republish_all(self) -> list[Publication]:
        """Return all retained messages, for a broker that has (re)connected and may have lost its own copies."""
        configs = [node_publication(node) for node in self.nodes.values()]
        definitions = [
            publication
            for definition in self.definitions()
            for publication in (
                deletions(definition.id) if definition.removed else [definition_publication(definition, self.epoch)]
            )
        ]
        return [*definitions, *self._hazard_publications(self._outbox.announced()), *configs]

    # --- Inside -----------------------------------------------------------------------------------------------------

    def _on_reading(self, ids: Ids, reading: NodeReading, at: Moment) -> list[Publication]:
        return self._announce(self._fusion.on_reading(ids["node"], reading, at.now, at.stamp))

    def _on_value(self, ids: Ids, value: NodeValue, at: Moment) -> list[Publication]:
        return self._announce(self._fusion.on_value(ids["node"], value, at.now, at.stamp))

    def _on_availability(self, ids: Ids, text: str, at: Moment) -> list[Publication]:
        if text not in ch.NODE_AVAILABILITY.values:
            choices = " or ".join(f"`{value}`" for value in ch.NODE_AVAILABILITY.values)
            raise RefusedMessageError(f"availability is {choices}, not {text!r}")
        return self._announce(self._fusion.on_availability(ids["node"], text == ch.ONLINE, at.now, at.stamp))

    def _on_thesis_state(self, ids: Ids, text: str, at: Moment) -> list[Publication]:
        return self._announce(self._fusion.on_thesis_state(int(ids["number"]), text.strip(), at.now, at.stamp))

    def _on_hazard(self, ids: Ids, hazard: AreaHazard, at: Moment) -> list[Publication]:
        """Hear what the broker distributes as our message: it must be ours.

        A hazard that an earlier run left retained is restored, so that a danger survives a restart without Redis. Our
        own message is published again over every other one; a higher epoch needs a new one of ours (`outranked_by`).
        """
        if hazard.area != ids["area"]:
            raise RefusedMessageError(f"it is about another area, {hazard.area}")
        if self._own.contains(hazard):
            return []
        if hazard.area not in self._listed():
            self._foreign.add("area", hazard.epoch, hazard.area)
            if self._complete:
                return deletions(hazard.area)
            self._unlisted.add(hazard.area)
            return []
        changed = self._announce([*self.overrides.follow(hazard, at), *self._fusion.restore([hazard], at.stamp)])
        if hazard.epoch >= self.epoch:
            self._foreign.add("hazard", hazard.epoch, hazard.area)
            return changed
        announced = self.announced().get(hazard.area)
        return changed or self._hazard_publications([announced] if announced else [])

    def _on_heartbeat(self, _ids: Ids, heartbeat: AggregatorHeartbeat, _at: Moment) -> list[Publication]:
        if heartbeat.epoch >= self.epoch and not self._own.contains_heartbeat(heartbeat):
            self._foreign.add("heartbeat", heartbeat.epoch, "")
        return []

    def _on_request(self, _ids: Ids, text: str, at: Moment) -> list[Publication]:
        if text != ch.REPUBLISH:
            raise RefusedMessageError(f"the request is `{ch.REPUBLISH}`, not {text!r}")
        if at.now - self._republished_at < REPUBLISH_PAUSE_S:
            return []  # whoever still lacks something asks again
        self._republished_at = at.now
        return self.republish_all()

    def _on_pose(self, ids: Ids, pose: RobotPose, at: Moment) -> Sequence[Publication]:
        return self._announce(self._fusion.on_pose(ids["robot"], pose, at.now))

    def _on_reported(self, ids: Ids, thing: Reported, at: Moment) -> Sequence[Publication]:
        return self._announce(self._fusion.on_reported(ids["thing"], thing, at.now))

    def _listed(self) -> list[str]:
        return [definition.id for definition in self.definitions() if not definition.removed]

    def _heartbeat(self, at: Moment) -> AggregatorHeartbeat:
        announced = self.announced()
        areas = {area: announced[area].seq if area in announced else 0 for area in self._listed()}
        heartbeat = AggregatorHeartbeat(
            epoch=self.epoch,
            areas=areas,
            complete=self._complete,
            digest=hazards_digest(announced[area] for area, seq in areas.items() if seq > 0),
            uptime=at.now,
            stamp=at.stamp,
        )
        self._own.add_heartbeat(heartbeat)
        return heartbeat

    def _announce(self, changed: Iterable[AreaHazard]) -> list[Publication]:
        return self._hazard_publications(self._outbox.offer(changed))

    def _hazard_publications(self, hazards: Iterable[AreaHazard]) -> list[Publication]:
        """Return the publications of hazards, each with its line for the thesis's robots."""
        publications: list[Publication] = []
        for hazard in hazards:
            self._own.add(hazard)
            definition = self._fusion.definition(hazard.area)
            node = self.nodes.get(definition.nodes[0]) if definition is not None and definition.nodes else None
            publications += hazard_publications(hazard, definition, node)
        return publications
