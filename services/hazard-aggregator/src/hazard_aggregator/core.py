"""What the aggregator decides: area states from readings, what may be announced when, and what is published again.

Pure: every input comes with its `Moment`, and everything that is to be published is returned. Readings become states
in `fusion`; a relief is withheld until it is stored (`outbox`): the process writes `to_store()` and reports `stored`.
"""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING

import msgspec

from fog_contracts import channels as ch
from fog_contracts.handlers import Publication, RefusedMessageError
from fog_contracts.messages import NodeConfig
from hazard_aggregator.debounce import DEFAULT_RULE
from hazard_aggregator.fusion import AreaFusion
from hazard_aggregator.outbox import Outbox

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence

    from fog_contracts.channels import Channel
    from fog_contracts.handlers import Handler, Ids, Moment
    from fog_contracts.messages import AreaDefinition, AreaHazard, NodeReading, RobotPose
    from fog_contracts.site import NodeSite
    from hazard_aggregator.debounce import Registry
    from hazard_aggregator.fusion import NodeReport


class Aggregator:
    """The aggregator's core; arguments as `AreaFusion` takes them."""

    def __init__(
        self,
        definitions: Iterable[AreaDefinition],
        nodes: Iterable[NodeSite],
        epoch: int,
        restored: Iterable[AreaHazard] = (),
        *,
        registry: Registry,
        default_rule: str = DEFAULT_RULE,
    ) -> None:
        self.epoch = epoch
        self.nodes = {node.id: node for node in nodes}
        self._fusion = AreaFusion(
            definitions, self.nodes.values(), epoch, restored, registry=registry, default_rule=default_rule
        )
        self._outbox = Outbox()

    # --- What it holds ----------------------------------------------------------------------------------------------

    def definitions(self) -> list[AreaDefinition]:
        """Return all areas, removed ones (`removed`) too, so that they can be taken off the map."""
        return self._fusion.definitions()

    def announced(self) -> dict[str, AreaHazard]:
        """Return the hazard of every area that was announced last."""
        return {hazard.area: hazard for hazard in self._outbox.announced()}

    def withheld(self) -> list[str]:
        """Return the areas whose relief waits for the store."""
        return self._outbox.withheld()

    def to_store(self) -> list[AreaHazard]:
        """Return the hazards that have to be stored, the newest of each area."""
        return self._outbox.unstored()

    def thesis_numbers(self) -> list[int]:
        """Return the numbers under which nodes of the thesis may report."""
        return sorted({d.number for d in self.definitions() if d.number is not None and not d.removed})

    def node_reports(self, now: float) -> list[NodeReport]:
        """Return the health of every node of every area."""
        return self._fusion.node_reports(now)

    def check(self, definition: AreaDefinition) -> None:
        """Raise `DebounceError` when an area's debounce rule or its options can't be used."""
        self._fusion.new_rule(definition)

    # --- Inputs -----------------------------------------------------------------------------------------------------

    def handlers(self) -> Mapping[Channel, Handler]:
        """Return the handler of every channel that the aggregator listens to."""
        return {
            ch.NODE_READING: self._on_reading,
            ch.NODE_AVAILABILITY: self._on_availability,
            ch.THESIS_AREA: self._on_thesis_state,
            ch.AREA_HAZARD: self._on_own_hazard,
            ch.ROBOT_POSE: self._on_pose,
        }

    def tick(self, at: Moment) -> list[Publication]:
        """Notice silence and flapping; call ten times a second."""
        return self._announce(self._fusion.tick(at.now, at.stamp))

    def stored(self, hazards: Iterable[AreaHazard]) -> list[Publication]:
        """Take that these of `to_store` are stored: reliefs among them may be announced now."""
        return self._hazards(self._outbox.stored(hazards))

    def put_area(self, definition: AreaDefinition, at: Moment) -> list[Publication]:
        """Add, change or (with `removed`) drop an area that is stored; its nodes keep what they have settled."""
        changed = self._fusion.put_area(definition, at.stamp)
        if definition.removed:
            self._outbox.forget(definition.id)
        return [_published_definition(definition), *self._announce(changed)]

    def restore(
        self, definitions: Iterable[AreaDefinition], hazards: Iterable[AreaHazard], at: Moment
    ) -> list[Publication]:
        """Take what was stored before this run and could not be read at its start; publish everything again."""
        for definition in definitions:
            self._outbox.offer(self._fusion.put_area(definition, at.stamp))
        self._outbox.offer(self._fusion.recall(hazards, at.stamp))
        return self.republish_all()

    def republish_all(self) -> list[Publication]:
        """Return what a broker that was (re)connected must hear: retained messages are a convenience, no record."""
        configs = [Publication(ch.NODE_CONFIG, node_config(node), {"node": node.id}) for node in self.nodes.values()]
        definitions = [_published_definition(definition) for definition in self.definitions()]
        return [*definitions, *self._hazards(self._outbox.announced()), *configs]

    # --- Inside -----------------------------------------------------------------------------------------------------

    def _on_reading(self, ids: Ids, reading: NodeReading, at: Moment) -> list[Publication]:
        return self._announce(self._fusion.on_reading(ids["node"], reading, at.now, at.stamp))

    def _on_availability(self, ids: Ids, text: str, at: Moment) -> list[Publication]:
        if text not in ("online", "offline"):
            raise RefusedMessageError(f"availability is `online` or `offline`, not {text!r}")
        return self._announce(self._fusion.on_availability(ids["node"], text == "online", at.now, at.stamp))

    def _on_thesis_state(self, ids: Ids, text: str, at: Moment) -> list[Publication]:
        return self._announce(self._fusion.on_thesis_state(int(ids["number"]), text.strip(), at.now, at.stamp))

    def _on_own_hazard(self, _ids: Ids, hazard: AreaHazard, at: Moment) -> list[Publication]:
        """Take what an earlier run of the aggregator left with the broker: it outlives a restart without Redis."""
        if hazard.epoch >= self.epoch:
            return []
        return self._announce(self._fusion.recall([hazard], at.stamp))

    def _on_pose(self, ids: Ids, pose: RobotPose, at: Moment) -> Sequence[Publication]:
        return self._announce(self._fusion.on_pose(ids["robot"], pose, at.now))

    def _announce(self, changed: Iterable[AreaHazard]) -> list[Publication]:
        return self._hazards(self._outbox.offer(changed))

    def _hazards(self, hazards: Iterable[AreaHazard]) -> list[Publication]:
        """Return hazards as they are published, each with its line for the thesis's robots."""
        publications: list[Publication] = []
        for hazard in hazards:
            publications.append(Publication(ch.AREA_HAZARD, hazard, {"area": hazard.area}))
            if (definition := self._fusion.definition(hazard.area)) is not None:
                node = self.nodes.get(definition.nodes[0]) if definition.nodes else None
                if line := wsn_line(definition, hazard, node):
                    publications.append(Publication(ch.THESIS_WSN, line))
        return publications


def _published_definition(definition: AreaDefinition) -> Publication:
    return Publication(ch.AREA_DEFINITION, definition, {"area": definition.id})


def node_config(node: NodeSite) -> NodeConfig:
    """Return what a node is told about its place; the version tells one content from another."""
    config = NodeConfig(
        version=0,
        range_limit_m=[sonar.range_limit for sonar in node.sonars],
        no_echo_is_clear=[sonar.no_echo_is_clear for sonar in node.sonars],
    )
    return msgspec.structs.replace(config, version=zlib.crc32(msgspec.json.encode(config)))


def wsn_line(definition: AreaDefinition, hazard: AreaHazard, node: NodeSite | None = None) -> str | None:
    """Return the line for the thesis's robots: `n,x,y`, or `n,-999,-999` when clear; None for an area without number.

    (x, y) is the node's place (m, frame `map`), or the middle of the area's corners without one. Those robots know no
    third state: an unknown area is served as blocked (Mendes 2022, section 3.4).
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
