"""Areas: their nodes and sources, whose states are fused to one, and the hazard that each change of it is. Pure.

An operator's override counts instead of the nodes; what these give without it goes on underneath.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final, NamedTuple

from msgspec import structs

from fog_contracts.costs import LETHAL
from fog_contracts.messages import (
    PASSABLE_PENALTY,
    SEVERITY,
    AreaHazard,
    Author,
    Count,
    Finite,
    HazardOverride,
    Id,
    Message,
    OverrideReason,
    OverrideState,
    Seconds,
    Stamp,
    TimeToLive,
    Trace,
)
from hazard_aggregator.area_size import AreaError
from hazard_aggregator.debounce import make_rule
from hazard_aggregator.free_parts import free_sonars, outlines
from hazard_aggregator.node_state import FlapDetector, NodeState, SourceState
from hazard_aggregator.source_values import SourceError, SourceReader, resolve

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Mapping

    from fog_contracts.geometry import Point
    from fog_contracts.messages import AreaDefinition, AreaState, FusionPolicy, Source
    from fog_contracts.site import NodeSite
    from hazard_aggregator.debounce import Registry, Rule
    from hazard_aggregator.free_parts import Cones, FreeSonars

LONGEST_S: Final[Mapping[OverrideState, float]] = {"blocked": 30 * 86_400.0, "clear": 900.0}
"""How long (s) an override may last: one that declares an area clear counts against what nodes measure."""


class AreaOverride(Message, frozen=True, kw_only=True):
    """An operator's stored override of an area: it holds until `deadline` (s) of the clock of the boot `boot`."""

    area: Id
    state: OverrideState
    author: Author
    reason: OverrideReason
    ttl_s: TimeToLive
    set_at: Stamp
    boot: str
    deadline: Finite
    version: Count


class Rest(Message, frozen=True, kw_only=True):
    """The time (s) that was left of this version of an override when it was last stored.

    `deadline` (s) is the same as a time of the clock of the boot `boot`, so that a restart within it prolongs nothing.
    """

    version: Count
    rest_s: Seconds
    boot: str = ""
    deadline: Finite = 0.0


_ROUNDING: Final = 1e-9
"""Sums of weights that should be equal differ by less."""


def fuse(states: Mapping[str, AreaState], policy: FusionPolicy) -> AreaState:
    """Return the state that nodes and sources give together.

    It is blocked when those that are reach the policy's threshold, and clear when those that are unknown could not make
    it so; without any it is unknown.
    """
    if not states:
        return "unknown"
    blocked = sum(_weight(name, policy) for name, state in states.items() if state == "blocked")
    unknown = sum(_weight(name, policy) for name, state in states.items() if state == "unknown")
    threshold = _threshold(states, policy)
    if blocked >= threshold - _ROUNDING:
        return "blocked"
    return "unknown" if blocked + unknown >= threshold - _ROUNDING else "clear"


def check_fusion(definition: AreaDefinition, thesis_node: str | None) -> None:
    """Raise `AreaError` for a policy by which the area could never be blocked.

    `thesis_node` is the id of the node that may report by the area's number, alone where nothing else watches it.
    """
    policy = definition.fusion
    if definition.penalty is not None and policy.rule != "any":
        problem = "each node or source makes an area with a penalty costly, whatever the others say: use `any`"
        raise AreaError(definition.id, "fusion.rule", problem)
    members = [*definition.nodes, *(source.id for source in definition.sources if source.penalty is None)]
    if not members and thesis_node is not None:
        members = [thesis_node]
    if policy.rule in ("any", "all") or not members:
        return
    reachable = sum(_weight(name, policy) for name in members)
    if policy.at_least > reachable:
        problem = f"{policy.at_least:g} is more than all nodes and sources have together ({reachable:g}): lower it"
        raise AreaError(definition.id, "fusion.at_least", problem)


def _threshold(members: Iterable[str], policy: FusionPolicy) -> float:
    if policy.rule == "any":
        return 1.0
    return float(len(list(members))) if policy.rule == "all" else policy.at_least


def _weight(name: str, policy: FusionPolicy) -> float:
    return policy.weights.get(name, 1.0) if policy.rule == "weighted" else 1.0


class _Measured(NamedTuple):
    """What the nodes of an area give together."""

    state: AreaState
    penalty: int
    severity: int
    cause: str
    deciding: NodeState | None


class WatchedArea:
    """An area that is not removed; an unobserved one is never clear."""

    def __init__(self, definition: AreaDefinition, nodes: dict[str, NodeState]) -> None:
        self.definition = definition
        self.nodes = nodes
        self.hazard: AreaHazard | None = None
        self._last_known_blocked = False  # then unknown costs as much as blocked
        self._known_before = False  # the same, before the area became blocked
        self._blocked_by: set[str] = set()  # nodes that were blocked when they last knew anything
        self._measured: AreaState = "unknown"
        self._confirmed = False  # whether readings of this run have confirmed a state
        self._restored: AreaHazard | None = None
        self._states: set[AreaState] = set()  # all that it had in this run
        self._free: FreeSonars = frozenset()

    def redefine(self, definition: AreaDefinition, nodes: dict[str, NodeState]) -> None:
        """Change the definition and the nodes; the state is that of the nodes."""
        self.definition = definition
        self.nodes = nodes

    def restore_at_start(self, hazard: AreaHazard) -> None:
        """Begin with the hazard of an earlier run: a blocked area stays blocked until readings or silence change it."""
        self._restored = hazard
        self._last_known_blocked = is_impassable(hazard)
        if measured_state(hazard) == "blocked":
            for node in self.nodes.values():
                node.restore_blocked()

    def restore_late(self, hazard: AreaHazard) -> None:
        """Apply the hazard of an earlier run, which was unreadable at the start.

        Only a danger counts, and not against what readings of this run have confirmed; but an area that has not changed
        since then has its state since then.
        """
        if self._restored is None or (hazard.epoch, hazard.seq) > (self._restored.epoch, self._restored.seq):
            self._restored = hazard
        if not self._confirmed and is_impassable(hazard):
            self._last_known_blocked = True

    def was_blocked_by(self, node: str) -> bool:
        """Whether a node was blocked when it last knew anything."""
        return node in self._blocked_by

    def take_back(self, node: str) -> None:
        """Handle that what a node saw was no hazard: if it alone saw one, the area is as impassable as before that."""
        self._blocked_by.discard(node)
        if not self._blocked_by:
            self._last_known_blocked = self._known_before

    def set_epoch(self, epoch: int) -> None:
        """Give the current hazard another epoch."""
        if self.hazard is not None:
            self.hazard = structs.replace(self.hazard, epoch=epoch)

    def evaluate(
        self, epoch: int, seq: int, stamp: float, override: AreaOverride | None = None, cones: Cones | None = None
    ) -> AreaHazard | None:
        """Fuse the nodes, unless an operator's override counts; return the area's hazard, with this epoch and `seq`.

        None when it did not change. `cones` are what each sonar sees.
        """
        measured = self._measure()
        old = self.hazard
        stays_blocked = old is not None and old.state == measured.state == "blocked" and old.override is None
        may_pass = stays_blocked and override is None
        self._free = free_sonars(self.definition, self.nodes, self._free, cones or {}) if may_pass else frozenset()
        free = outlines(self._free, cones or {})
        state, penalty, severity, cause, deciding = self._overridden(measured, override)
        explained = next((node.explained_by for node in self.nodes.values() if node.explained_by), None)
        told = None if override is None else _told(override, measured)
        since = self._since(state, stamp)
        if old is not None and (old.state, old.penalty, old.explained_by, old.since, old.override, old.free) == (
            state, penalty, explained, since, told, free,
        ) and (state != "unknown" or old.cause == cause):  # fmt: skip
            return None
        trace = None
        if state == "blocked" and (old is None or old.state != state) and deciding and deciding.run_state == state:
            trace = Trace(
                area=self.definition.id, epoch=epoch, seq=seq, first_reading=deciding.run_began, confirmed=stamp
            )
        self._states.add(state)
        self.hazard = AreaHazard(
            area=self.definition.id,
            state=state,
            severity=severity,
            penalty=penalty,
            since=since,
            seq=seq,
            epoch=epoch,
            cause=cause,
            nodes={node.id: node.state for node in self.nodes.values()},
            explained_by=explained,
            override=told,
            trace=trace,
            code="" if deciding is None else deciding.reason.code,
            decided_by=None if deciding is None else deciding.id,
            free=free,
        )
        return self.hazard

    def _measure(self) -> _Measured:
        """Return the state of the nodes, and remember whether the area was blocked when it was last known."""
        state, deciding = self._fuse()
        caution = self._caution() if state == "clear" else None
        if state == "blocked" and self._measured != "blocked":
            self._known_before = self._last_known_blocked
        self._measured = state
        self._blocked_by = {
            name
            for name, node in self.nodes.items()
            if node.state == "blocked" or (node.state == "unknown" and name in self._blocked_by)
        }
        if state != "unknown":
            self._last_known_blocked = state == "blocked"
            self._confirmed = self._confirmed or (deciding is not None and deciding.ever_received)
        if caution is not None and caution.state == "blocked":
            cause = self._cause("unknown", caution)
            return _Measured("unknown", caution.penalty or 0, SEVERITY["unknown"], cause, caution)
        if caution is not None:
            state, deciding = "unknown", caution
        penalty = LETHAL if state == "blocked" or (state == "unknown" and self._last_known_blocked) else 0
        if state == "unknown" and not self._last_known_blocked:
            penalty = self.definition.unknown.penalty
        severity = SEVERITY["unknown_after_blocked" if state == "unknown" and self._last_known_blocked else state]
        return _Measured(state, penalty, severity, self._cause(state, deciding), deciding)

    def _overridden(self, measured: _Measured, override: AreaOverride | None) -> _Measured:
        """Return what counts: what the nodes measure, or the operator's override.

        An area that an operator declared clear is unknown and passable: nobody measures that it is clear.
        """
        if override is None:
            return measured
        if override.state == "blocked":
            cause = f"{override.author} blocked the area: {override.reason}"
            return _Measured("blocked", LETHAL, SEVERITY["blocked"], cause, None)
        penalty = min(PASSABLE_PENALTY, self.definition.unknown.penalty)
        contradicted = "" if measured.state == "clear" else ", which its nodes do not"
        cause = f"{override.author} declared the area clear{contradicted}: {override.reason}"
        return _Measured("unknown", penalty, SEVERITY["unknown"], cause, None)

    def _since(self, state: AreaState, stamp: float) -> float:
        """Return since when the area has had this state, across a restart too.

        An area that was blocked before the restart is unknown until readings say so again, if the hazard of the earlier
        run arrives late.
        """
        before = self.hazard
        since = before.since if before is not None and before.state == state else stamp
        restored = self._restored
        unchanged = self._states <= ({state} if state != "blocked" else {"unknown", "blocked"})
        return min(since, restored.since) if restored is not None and restored.state == state and unchanged else since

    def _fuse(self) -> tuple[AreaState, NodeState | None]:
        """Return the state of nodes and sources that can make the area impassable, and one that decided it.

        Without any such one, the area is clear for all that is known.
        """
        blocking = {name: node for name, node in self.nodes.items() if node.penalty is None}
        if not blocking:
            return ("clear", next(iter(self.nodes.values()))) if self.nodes else ("unknown", None)
        state = fuse({name: node.state for name, node in blocking.items()}, self.definition.fusion)
        deciding = next((node for node in blocking.values() if node.state == state), None)
        return state, deciding or next(iter(blocking.values()))

    def _caution(self) -> NodeState | None:
        """Return the source that makes a clear area costly, by its highest penalty, or else one that is unknown."""
        cautions = [node for node in self.nodes.values() if node.penalty is not None]
        blocked = [node for node in cautions if node.state == "blocked"]
        if blocked:
            return max(blocked, key=lambda node: node.penalty or 0)
        return next((node for node in cautions if node.state == "unknown"), None)

    def _cause(self, state: AreaState, deciding: NodeState | None) -> str:
        """Return a sentence on why the area is in its state."""
        if deciding is None:
            return "no node watches this area"
        kind = "source" if isinstance(deciding, SourceState) else "node"
        sentence = f"{kind} {deciding.id}: {deciding.reason}"
        if state == "clear" and len(self.nodes) > 1 and all(node.state == "clear" for node in self.nodes.values()):
            sentence = f"all {len(self.nodes)} nodes agree; {sentence}"
        if state == "unknown":
            sentence += "; it was blocked before and stays impassable" if self._last_known_blocked else ""
        return sentence[:500]


def measured_state(hazard: AreaHazard) -> AreaState:
    """Return the state that the nodes of an area gave, whatever an operator said."""
    return hazard.state if hazard.override is None else hazard.override.measured


def is_impassable(hazard: AreaHazard) -> bool:
    """Whether the area of a hazard is impassable by what its nodes measured."""
    penalty = hazard.penalty if hazard.override is None else hazard.override.measured_penalty
    state = measured_state(hazard)
    return state == "blocked" or (state == "unknown" and penalty >= LETHAL)


def _told(override: AreaOverride, measured: _Measured) -> HazardOverride:
    """Return what the area's hazard says of an override."""
    return HazardOverride(
        state=override.state,
        author=override.author,
        reason=override.reason,
        set_at=override.set_at,
        ttl_s=override.ttl_s,
        measured=measured.state,
        measured_penalty=measured.penalty,
    )


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
