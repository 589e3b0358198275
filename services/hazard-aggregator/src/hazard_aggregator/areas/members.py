"""Makes the nodes and sources of an area from its definition; those that it had before keep their states. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from msgspec import structs

from hazard_aggregator.area_size import AreaError
from hazard_aggregator.areas.voting import check_fusion
from hazard_aggregator.debounce import make_rule
from hazard_aggregator.sensors.flapping import FlapDetector
from hazard_aggregator.sensors.node_state import NodeState, SourceState
from hazard_aggregator.sensors.source_profiles import SourceError, resolve
from hazard_aggregator.sensors.source_reader import SourceReader

if TYPE_CHECKING:
    from collections.abc import Collection, Mapping

    from fog_contracts.geometry import Point
    from fog_contracts.messages import AreaDefinition, Source
    from fog_contracts.site import NodeSite
    from hazard_aggregator.areas.watched_area import WatchedArea
    from hazard_aggregator.debounce import Registry, Rule

THESIS_NODE: Final = "thesis-area-{number}"
"""The id of a thesis node, which has none of its own, within its area."""
_NO_CONES: Final[Mapping[str, list[Point]]] = {}
_EACH_MESSAGE: Final[Mapping[str, Any]] = {"rule": "consecutive", "to_blocked": 1, "to_clear": 1}
"""A source's messages are its sensor's own decisions."""


class Members:
    """Makes nodes, sources and their debounce rules; `registry` finds rules by name, nodes use the `default_rule`.

    `cones` are the outlines of what the sonars of each node see (`fog_contracts.cones`), for areas that are one.
    """

    def __init__(
        self,
        sites: Mapping[str, NodeSite],
        registry: Registry,
        default_rule: str,
        cones: Mapping[str, list[Point]] = _NO_CONES,
    ) -> None:
        self._sites = sites
        self._cones = cones
        self._registry = registry
        self._default_rule = default_rule

    def checked(self, definition: AreaDefinition) -> AreaDefinition:
        """Return an area as it counts: one that is the cone of a node has the polygon of that node's cone now.

        Raises `AreaError` when its node, debounce, sources or fusion are invalid.
        """
        self._check(definition)
        if definition.cone_of is None or definition.removed:
            return definition
        polygon = self.cone(definition.id, definition.cone_of, definition.nodes)
        return structs.replace(definition, polygon=polygon)

    def cone(self, area: str, node: str, nodes: Collection[str]) -> list[Point]:
        """Return what the sonars of a node see as the polygon of an area with these nodes; raises `AreaError`."""
        remedy = "name one of the area's nodes, or give the area a polygon"
        if node not in self._sites:
            problem = f"the site has no node {node}: {remedy}"
        elif node not in nodes:
            problem = f"node {node} is none of the area's nodes: {remedy}"
        elif node not in self._cones:
            problem = f"node {node} stands in a wall of the map, or looks at one: move or turn it, or {remedy}"
        else:
            return self._cones[node]
        raise AreaError(area, "cone_of", problem)

    def _check(self, definition: AreaDefinition) -> None:
        self.new_rule(definition)
        names = [*definition.nodes, *(source.id for source in definition.sources)]
        for source in definition.sources:
            if names.count(source.id) > 1:
                problem = "another node or source of the area has this id"
                raise SourceError(definition.id, f"sources.{source.id}", problem)
            if source.id in self._sites:
                problem = "a node of the site has this id, and its readings would count as the source's: choose another"
                raise SourceError(definition.id, f"sources.{source.id}", problem)
            self._new_source(definition, source)
            if source.quantity is not None and source.quantity.node not in self._sites:
                problem = f"the site has no node {source.quantity.node}: add it to site.toml first"
                raise SourceError(definition.id, f"sources.{source.id}.quantity.node", problem)
        number = definition.number
        check_fusion(definition, None if number is None else THESIS_NODE.format(number=number))

    def new_rule(self, definition: AreaDefinition) -> Rule:
        """Return a fresh debounce rule for a node of an area; raises `DebounceError` for invalid settings."""
        return make_rule(definition.id, definition.debounce, self._registry, self._default_rule)

    def thesis_node(self, definition: AreaDefinition) -> NodeState:
        """Return the node of an area that reports by the area's number only."""
        name = THESIS_NODE.format(number=definition.number)
        return NodeState(name, None, self.new_rule(definition), area_penalty=definition.penalty)

    def of_area(self, definition: AreaDefinition, old: WatchedArea | None) -> dict[str, NodeState]:
        """Return the nodes and sources of an area; those of its `old` definition keep their states."""
        known = old.nodes if old is not None else {}
        keep_rules = old is not None and old.definition.debounce == definition.debounce
        thesis = THESIS_NODE.format(number=definition.number)
        names = list(dict.fromkeys([*definition.nodes, *({thesis} & known.keys() - self._sites.keys())]))
        members: dict[str, NodeState] = {}
        for name in names:
            node = known.get(name)
            if node is None or isinstance(node, SourceState):
                node = NodeState(name, self._sites.get(name), self.new_rule(definition))
            elif not keep_rules:
                node.rule = self.new_rule(definition)
            members[name] = node
        for source in definition.sources:
            new, before = self._new_source(definition, source), known.get(source.id)
            unchanged = isinstance(before, SourceState) and before.source == new.source
            members[source.id] = before if unchanged and before is not None else new
        for member in members.values():
            member.flaps.max_changes = definition.unknown.max_changes
            member.area_penalty = definition.penalty
        return members

    def _new_source(self, definition: AreaDefinition, source: Source) -> SourceState:
        resolved = resolve(definition.id, source)
        rule = make_rule(definition.id, resolved.debounce or _EACH_MESSAGE, self._registry, self._default_rule)
        flaps = FlapDetector(definition.unknown.max_changes)
        return SourceState(source.id, None, rule, flaps=flaps, source=resolved, reader=SourceReader(resolved))
