"""From readings to hazards: debounce each node, fuse the nodes of an area, and never call clear what nobody sees.

Pure: time comes as `now` (s, the receiver's monotonic clock) and `stamp` (s since the epoch, for people and traces).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from fog_contracts.channels import ROBOT_POSE
from fog_contracts.costs import LETHAL
from fog_contracts.messages import AreaDefinition, AreaHazard, Trace
from hazard_aggregator.debounce import DEFAULT_RULE, make_rule
from hazard_aggregator.plausibility import Classification, classify_reading

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from typing import Final

    from fog_contracts.messages import AreaState, NodeReading, RobotPose
    from fog_contracts.site import NodeSite
    from hazard_aggregator.debounce import Registry, Rule

LATE_TICK_S: Final = 0.5
"""A tick that comes so long (s) after the last one tells of a process that was held up."""
SEVERITY: Final = {"clear": 0, "unknown": 1, "doubtful": 2, "blocked": 3}
THESIS_NODE: Final = "thesis-area-{number}"
"""The name under which a node of the thesis, which has none, counts in its area."""


@dataclass
class _Node:
    """What is known of one node of one area."""

    id: str
    site: NodeSite | None
    rule: Rule
    heard: float | None = None
    settled: float = 0.0
    state: AreaState = "unknown"
    reason: str = "it has not been heard yet"
    boot: int = -1
    seq: int = -1
    online: bool | None = None
    ever_heard: bool = False
    silent: bool = True  # nothing has been settled since it was last lost
    explained_by: str | None = None
    row_state: AreaState | None = None
    row_began: float = 0.0
    received: int = 0
    ignored: int = 0

    def silence(self, now: float) -> float:
        """Return for how long (s) it has been silent; it counts from the first time that anybody asks."""
        if self.heard is None:
            self.heard = self.settled = now
        return now - self.heard

    def lose_trust(self, reason: str) -> None:
        self.state = "unknown"
        self.reason = reason
        self.silent = True
        self.explained_by = None
        self.row_state = None
        self.rule.reset()


@dataclass
class _Area:
    definition: AreaDefinition
    nodes: dict[str, _Node] = field(default_factory=dict)
    danger: bool = False  # whether the last settled state was blocked: then unknown costs as much
    settled: bool = False  # whether readings of this run have settled anything
    hazard: AreaHazard | None = None


@dataclass(frozen=True)
class NodeReport:
    """Health of a node, for people: `age` is seconds since its last reading, None when it was never heard."""

    id: str
    area: str
    state: AreaState
    reason: str
    online: bool | None
    age: float | None
    received: int
    ignored: int


class AreaFusion:
    """Holds every area's state; each input returns the hazards that changed.

    `restored` are the hazards that were stored last: a blocked area stays blocked until readings or silence say
    otherwise. All others start as unknown: nobody has looked since, and clear is only what readings of this run say.
    `registry` finds debounce rules by name, `default_rule` is the one of areas that name none; raises `DebounceError`
    for an area's choice that can't be used.
    """

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
        self._sites = {node.id: node for node in nodes}
        self._registry = registry
        self._default_rule = default_rule
        self._areas: dict[str, _Area] = {}
        self._tombstones: dict[str, AreaDefinition] = {}
        self._poses: dict[str, tuple[float, RobotPose]] = {}
        self._seqs: dict[str, int] = {}
        self._by_node: dict[str, list[tuple[_Area, _Node]]] = {}
        self._ticked: float | None = None
        self._waited = False
        for definition in definitions:
            self._define(definition)
        for hazard in restored:
            self._restore(hazard)

    # --- What it holds ----------------------------------------------------------------------------------------------

    def hazards(self) -> list[AreaHazard]:
        """Return the state of every area that has been evaluated once (`tick` evaluates all)."""
        return [area.hazard for area in self._areas.values() if area.hazard is not None]

    def definitions(self) -> list[AreaDefinition]:
        """Return all areas, removed ones (`removed`) too, so that they can be taken off the map."""
        return [*(area.definition for area in self._areas.values()), *self._tombstones.values()]

    def definition(self, area: str) -> AreaDefinition | None:
        """Return the definition of an area that is not removed."""
        found = self._areas.get(area)
        return found.definition if found is not None else None

    def node_reports(self, now: float) -> list[NodeReport]:
        """Return the health of every node of every area."""
        return [
            NodeReport(
                id=node.id,
                area=area.definition.id,
                state=node.state,
                reason=node.reason,
                online=node.online,
                age=node.silence(now) if node.ever_heard else None,
                received=node.received,
                ignored=node.ignored,
            )
            for area in self._areas.values()
            for node in area.nodes.values()
        ]

    # --- Inputs -----------------------------------------------------------------------------------------------------

    def on_reading(self, node: str, reading: NodeReading, now: float, stamp: float) -> list[AreaHazard]:
        """Take a reading; duplicates and ones that were overtaken (by boot and seq) are ignored."""
        changed: list[AreaHazard] = []
        for area, track in self._by_node.get(node, ()):
            if not _is_newer(track, reading, now, area.definition.unknown.silent_after_s):
                track.ignored += 1
                continue
            track.boot, track.seq = reading.boot, reading.seq
            if track.site is None:
                classification = Classification(
                    reading.state, f"the node says {reading.state} (the site gives it no place)"
                )
            else:
                classification = classify_reading(track.site, reading, self._fresh_poses(now))
            self._count(track, classification, now, stamp)
            changed += self._evaluate(area, stamp)
        return changed

    def on_thesis_state(self, number: int, state: str, now: float, stamp: float) -> list[AreaHazard]:
        """Take `blocked` or `clear` from a node of the thesis; anything else makes the reading implausible."""
        changed: list[AreaHazard] = []
        for area in self._areas.values():
            if area.definition.number != number:
                continue
            name = THESIS_NODE.format(number=number)
            track = area.nodes.get(name)
            if track is None:
                track = area.nodes[name] = _Node(name, None, self.new_rule(area.definition))
            said: AreaState = "blocked" if state == "blocked" else "clear" if state == "clear" else "unknown"
            reason = f"it says {said}" if said != "unknown" else "it says neither blocked nor clear"
            self._count(track, Classification(said, reason), now, stamp)
            changed += self._evaluate(area, stamp)
        return changed

    def on_availability(self, node: str, online: bool, now: float, stamp: float) -> list[AreaHazard]:  # noqa: FBT001  # as the topic says it
        """Take a node's word or last will; an offline node is not trusted until it is heard again."""
        changed: list[AreaHazard] = []
        for area, track in self._by_node.get(node, ()):
            track.online = online
            if not online and track.state != "unknown":
                track.lose_trust("it went offline")
                track.settled = now
                changed += self._evaluate(area, stamp)
        return changed

    def on_pose(self, robot: str, pose: RobotPose, now: float) -> list[AreaHazard]:
        """Take where a robot is; its next echoes may explain readings."""
        self._poses[robot] = (now, pose)
        return []

    def tick(self, now: float, stamp: float) -> list[AreaHazard]:
        """Notice silence and flapping; call ten times a second.

        After a gap between calls the process itself was held up: only the next call evaluates, so that what has arrived
        meanwhile counts first.
        """
        held_up = self._ticked is not None and now - self._ticked > LATE_TICK_S and not self._waited
        self._ticked, self._waited = now, held_up
        if held_up:
            return []
        changed: list[AreaHazard] = []
        for area in self._areas.values():
            limit = area.definition.unknown.silent_after_s
            for node in area.nodes.values():
                if node.silence(now) > limit:
                    reason = f"it has been silent for more than {limit:g} s"
                    if node.state != "unknown" or node.reason != reason:
                        node.lose_trust(reason)
                elif now - node.settled > limit and node.state != "unknown":
                    node.lose_trust("its readings contradict one another")
            changed += self._evaluate(area, stamp)
        self._poses = {robot: seen for robot, seen in self._poses.items() if now - seen[0] <= ROBOT_POSE.max_age_s}
        return changed

    def put_area(self, definition: AreaDefinition, stamp: float) -> list[AreaHazard]:
        """Add, change or (with `removed`) drop an area; its nodes keep what they have settled."""
        self._define(definition)
        area = self._areas.get(definition.id)
        return self._evaluate(area, stamp) if area else []

    def recall(self, hazards: Iterable[AreaHazard], stamp: float) -> list[AreaHazard]:
        """Take hazards that could not be read at the start: an area not settled since costs what it cost then."""
        changed: list[AreaHazard] = []
        for hazard in hazards:
            area = self._areas.get(hazard.area)
            if area is not None and not area.settled and _is_danger(hazard):
                area.danger = True
                changed += self._evaluate(area, stamp)
        return changed

    def new_rule(self, definition: AreaDefinition) -> Rule:
        """Return a fresh debounce rule for a node of an area; raises `DebounceError` for an unusable choice."""
        return make_rule(definition.id, definition.debounce, self._registry, self._default_rule)

    # --- Inside -----------------------------------------------------------------------------------------------------

    def _define(self, definition: AreaDefinition) -> None:
        self.new_rule(definition)  # an area without nodes must not hide a choice that can't be used
        old = self._areas.get(definition.id)
        if definition.removed:
            self._areas.pop(definition.id, None)
            self._tombstones[definition.id] = definition
        else:
            self._tombstones.pop(definition.id, None)
            area = _Area(definition)
            if old is not None:
                area.danger, area.settled, area.hazard = old.danger, old.settled, old.hazard
            keep_rules = old is not None and old.definition.debounce == definition.debounce
            kept = {name for name in (old.nodes if old else ()) if name not in self._sites}
            thesis = {THESIS_NODE.format(number=definition.number)} & kept
            for name in [*definition.nodes, *sorted(thesis - set(definition.nodes))]:
                node = old.nodes.get(name) if old is not None else None
                if node is None:
                    node = _Node(name, self._sites.get(name), self.new_rule(definition))
                elif not keep_rules:
                    node.rule = self.new_rule(definition)
                area.nodes[name] = node
            self._areas[definition.id] = area
        self._by_node = {}
        for area in self._areas.values():
            for node in area.nodes.values():
                self._by_node.setdefault(node.id, []).append((area, node))

    def _restore(self, hazard: AreaHazard) -> None:
        area = self._areas.get(hazard.area)
        if area is None:
            return
        area.danger = _is_danger(hazard)
        if hazard.state == "blocked":
            for node in area.nodes.values():
                node.state = hazard.state
                node.reason = "the area was blocked before the restart"

    def _fresh_poses(self, now: float) -> Iterator[tuple[str, RobotPose]]:
        for robot, (seen, pose) in self._poses.items():
            if now - seen <= ROBOT_POSE.max_age_s and pose.localized:
                yield robot, pose

    @staticmethod
    def _count(node: _Node, classification: Classification, now: float, stamp: float) -> None:
        """Let one reading count."""
        node.silence(now)
        node.received += 1
        node.heard = now
        node.ever_heard = True
        node.online = True
        if classification.explained_by is not None:
            # Counts neither way: the row stands still, and so does the clock that would call it undecided.
            node.explained_by = classification.explained_by
            node.settled = now
            return
        if classification.state != node.row_state:
            node.row_state = classification.state
            node.row_began = stamp
        settled = node.rule.feed(classification.state, now)
        if settled is None:
            return
        node.settled = now
        node.explained_by = None
        if settled != node.state or node.silent:
            # Later readings that say the same don't reword the cause: a hazard would change with every centimetre.
            node.state, node.reason, node.silent = settled, classification.reason, False

    def _evaluate(self, area: _Area, stamp: float) -> list[AreaHazard]:
        """Fuse the nodes; return the area's hazard when it changed."""
        state, deciding = _fuse(area)
        if state != "unknown":
            area.danger = state == "blocked"
            area.settled = area.settled or (deciding is not None and deciding.ever_heard)
        penalty = LETHAL if state == "blocked" or (state == "unknown" and area.danger) else 0
        if state == "unknown" and not area.danger:
            penalty = area.definition.unknown.penalty
        explained = next((node.explained_by for node in area.nodes.values() if node.explained_by), None)
        old = area.hazard
        same = old is not None and (old.state, old.penalty, old.explained_by) == (state, penalty, explained)
        if same and state != "unknown":
            return []
        cause = _cause(area, state, deciding)
        if same and old is not None and old.cause == cause:
            return []
        seq = self._seqs[area.definition.id] = self._seqs.get(area.definition.id, 0) + 1
        trace = None
        if state == "blocked" and (old is None or old.state != state) and deciding and deciding.row_state == state:
            trace = Trace(
                area=area.definition.id, epoch=self.epoch, seq=seq, first_reading=deciding.row_began, confirmed=stamp
            )
        area.hazard = AreaHazard(
            area=area.definition.id,
            state=state,
            severity=SEVERITY["doubtful" if state == "unknown" and area.danger else state],
            penalty=penalty,
            since=old.since if old is not None and old.state == state else stamp,
            seq=seq,
            epoch=self.epoch,
            cause=cause,
            nodes={node.id: node.state for node in area.nodes.values()},
            explained_by=explained,
            trace=trace,
        )
        return [area.hazard]


def _is_danger(hazard: AreaHazard) -> bool:
    """Whether a hazard makes its area impassable."""
    return hazard.state == "blocked" or (hazard.state == "unknown" and hazard.penalty >= LETHAL)


def _is_newer(node: _Node, reading: NodeReading, now: float, silent_after: float) -> bool:
    """Whether a reading is later than all before; a lower boot counts once the later one has fallen silent."""
    if reading.boot != node.boot:
        return reading.boot > node.boot or node.silence(now) > silent_after
    return reading.seq > node.seq


def _fuse(area: _Area) -> tuple[AreaState, _Node | None]:
    """Return the area's state and the node that decided it: one blocked node is enough, clear takes all of them."""
    nodes = list(area.nodes.values())
    for state in ("blocked", "unknown"):
        for node in nodes:
            if node.state == state:
                return state, node
    return ("clear", nodes[0]) if nodes else ("unknown", None)


def _cause(area: _Area, state: AreaState, deciding: _Node | None) -> str:
    """Say in words why the area is in its state."""
    if deciding is None:
        return "no node watches this area"
    words = f"node {deciding.id}: {deciding.reason}"
    if state == "clear" and len(area.nodes) > 1:
        words = f"all {len(area.nodes)} nodes agree; {words}"
    if state == "unknown":
        words += "; it was blocked before and stays impassable" if area.danger else ""
    return words[:500]
