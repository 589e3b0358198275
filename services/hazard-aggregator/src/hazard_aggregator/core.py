"""The aggregator's decisions: area states from readings, when a hazard may be announced, and what is republished.

Pure: every input comes with its `Moment`, and everything to be published is returned. `fusion` turns readings into
states. `outbox` withholds a relief until it is stored: the process writes `to_store()` and then calls `mark_stored`.
"""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING

import msgspec

from fog_contracts import channels as ch
from fog_contracts.handlers import Publication, RefusedMessageError
from fog_contracts.messages import NodeConfig
from hazard_aggregator.outbox import Outbox

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from fog_contracts.channels import Channel
    from fog_contracts.handlers import Handler, Ids, Moment, QueryHandler
    from fog_contracts.messages import AreaDefinition, AreaHazard, NodeReading, RobotPose
    from fog_contracts.site import NodeSite
    from hazard_aggregator.fusion import AreaFusion, NodeReport


class Aggregator:
    """The aggregator's core: what `fusion` decides, published in the order that `Outbox` allows."""

    def __init__(self, fusion: AreaFusion) -> None:
        self.epoch = fusion.epoch
        self.nodes = fusion.nodes
        self._fusion = fusion
        self._outbox = Outbox()

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

    def node_reports(self, now: float) -> list[NodeReport]:
        """Return the health of every node of every area."""
        return self._fusion.node_reports(now)

    def check(self, definition: AreaDefinition) -> None:
        """Raise `DebounceError` when an area's debounce rule or its options are invalid."""
        self._fusion.new_rule(definition)

    # --- Inputs -----------------------------------------------------------------------------------------------------

    def handlers(self) -> Mapping[Channel, Handler]:
        """Return the handler of every channel that the aggregator subscribes to."""
        return {
            ch.NODE_READING: self._on_reading,
            ch.NODE_AVAILABILITY: self._on_availability,
            ch.THESIS_AREA: self._on_thesis_state,
            ch.AREA_HAZARD: self._on_own_hazard,
            ch.ROBOT_POSE: self._on_pose,
        }

    def query_handlers(self) -> Mapping[Channel, QueryHandler]:
        """Return the handler of every query: the aggregator answers none."""
        return {}

    def tick(self, at: Moment) -> list[Publication]:
        """Detect silent and flapping nodes; call ten times a second."""
        return self._announce(self._fusion.tick(at.now, at.stamp))

    def mark_stored(self, hazards: Iterable[AreaHazard]) -> list[Publication]:
        """Record that these hazards of `to_store` are stored; return the reliefs among them, announced now."""
        return self._hazard_publications(self._outbox.mark_stored(hazards))

    def put_area(self, definition: AreaDefinition, at: Moment) -> list[Publication]:
        """Add, change or (with `removed`) remove an area that is stored; its nodes keep their confirmed states."""
        changed = self._fusion.put_area(definition, at.stamp)
        if definition.removed:
            self._outbox.forget(definition.id)
        return [_definition_publication(definition), *self._announce(changed)]

    def restore(
        self, definitions: Iterable[AreaDefinition], hazards: Iterable[AreaHazard], at: Moment
    ) -> list[Publication]:
        """Restore areas and hazards that were unreadable at the start of this run; republish everything."""
        for definition in definitions:
            self._outbox.offer(self._fusion.put_area(definition, at.stamp))
        self._outbox.offer(self._fusion.restore(hazards, at.stamp))
        return self.republish_all()

    def republish_all(self) -> list[Publication]:
        """Return all retained messages, for a broker that has (re)connected and may have lost its own copies."""
        configs = [Publication(ch.NODE_CONFIG, node_config(node), {"node": node.id}) for node in self.nodes.values()]
        definitions = [_definition_publication(definition) for definition in self.definitions()]
        return [*definitions, *self._hazard_publications(self._outbox.announced()), *configs]

    # --- Inside -----------------------------------------------------------------------------------------------------

    def _on_reading(self, ids: Ids, reading: NodeReading, at: Moment) -> list[Publication]:
        return self._announce(self._fusion.on_reading(ids["node"], reading, at.now, at.stamp))

    def _on_availability(self, ids: Ids, text: str, at: Moment) -> list[Publication]:
        if text not in ch.NODE_AVAILABILITY.values:
            choices = " or ".join(f"`{value}`" for value in ch.NODE_AVAILABILITY.values)
            raise RefusedMessageError(f"availability is {choices}, not {text!r}")
        return self._announce(self._fusion.on_availability(ids["node"], text == ch.ONLINE, at.now, at.stamp))

    def _on_thesis_state(self, ids: Ids, text: str, at: Moment) -> list[Publication]:
        return self._announce(self._fusion.on_thesis_state(int(ids["number"]), text.strip(), at.now, at.stamp))

    def _on_own_hazard(self, _ids: Ids, hazard: AreaHazard, at: Moment) -> list[Publication]:
        """Restore a hazard that an earlier run left retained on the broker: it survives a restart without Redis."""
        if hazard.epoch >= self.epoch:
            return []
        return self._announce(self._fusion.restore([hazard], at.stamp))

    def _on_pose(self, ids: Ids, pose: RobotPose, at: Moment) -> Sequence[Publication]:
        return self._announce(self._fusion.on_pose(ids["robot"], pose, at.now))

    def _announce(self, changed: Iterable[AreaHazard]) -> list[Publication]:
        return self._hazard_publications(self._outbox.offer(changed))

    def _hazard_publications(self, hazards: Iterable[AreaHazard]) -> list[Publication]:
        """Return the publications of hazards, each with its line for the thesis's robots."""
        publications: list[Publication] = []
        for hazard in hazards:
            publications.append(Publication(ch.AREA_HAZARD, hazard, {"area": hazard.area}))
            if (definition := self._fusion.definition(hazard.area)) is not None:
                node = self.nodes.get(definition.nodes[0]) if definition.nodes else None
                if line := wsn_line(definition, hazard, node):
                    publications.append(Publication(ch.THESIS_WSN, line))
        return publications


def _definition_publication(definition: AreaDefinition) -> Publication:
    return Publication(ch.AREA_DEFINITION, definition, {"area": definition.id})


def node_config(node: NodeSite) -> NodeConfig:
    """Return the configuration of a node; its version is a checksum of its content."""
    config = NodeConfig(
        version=0,
        range_limit_m=[sonar.range_limit for sonar in node.sonars],
        no_echo_is_clear=[sonar.no_echo_is_clear for sonar in node.sonars],
    )
    return msgspec.structs.replace(config, version=zlib.crc32(msgspec.json.encode(config)))


def wsn_line(definition: AreaDefinition, hazard: AreaHazard, node: NodeSite | None = None) -> str | None:
    """Return the line for the thesis's robots: `n,x,y`, or `n,-999,-999` when clear; None for an area without number.

    (x, y) is the node's position (m, frame `map`), or the mean of the area's corners when it has no node. Those robots
    have no third state: an unknown area is sent as blocked (Mendes 2022, section 3.4).
    """
    if definition.number is None:
        return None
    if hazard.state == "clear":
        return f"{definition.number},-999,-999"
    if node is not None:
        x, y = node.x, node.y
    else:
        x = sum(point[0] for point in definition.polygon) / len(definition.polygon)
        y = sum(point[1] for point in definition.polygon) / len(definition.polygon)
    return f"{definition.number},{x:.3f},{y:.3f}"
