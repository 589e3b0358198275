"""Turns readings into hazards: debounces each node, fuses the nodes of an area; an unobserved area is never clear.

Pure: time comes as `now` (s, the receiver's monotonic clock) and `stamp` (s since the epoch, for people and traces).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from msgspec import structs

from fog_contracts.channels import BLOCKED, CLEAR, ROBOT_POSE
from fog_contracts.costs import LETHAL
from fog_contracts.messages import SEVERITY, AreaDefinition, AreaHazard, Trace
from hazard_aggregator.debounce import DEFAULT_RULE, make_rule
from hazard_aggregator.plausibility import Classification, classify_reading

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from typing import Final

    from fog_contracts.messages import AreaState, NodeReading, RobotPose
    from fog_contracts.site import NodeSite
    from hazard_aggregator.debounce import Registry, Rule

LATE_TICK_S: Final = 0.5
"""A longer gap (s) between two ticks means that the process itself was stalled."""
THESIS_NODE: Final = "thesis-area-{number}"
"""The id of a thesis node, which has none of its own, within its area."""


@dataclass
class _NodeState:
    """The state of one node of one area."""

    id: str
    site: NodeSite | None
    rule: Rule
    last_reading: float | None = None
    last_confirmed: float = 0.0
    state: AreaState = "unknown"
    reason: str = "no reading received yet"
    boot: int = -1
    seq: int = -1
    online: bool | None = None
    ever_received: bool = False
    unconfirmed: bool = True  # no state was confirmed since the last invalidation
    explained_by: str | None = None
    run_state: AreaState | None = None
    run_began: float = 0.0
    received: int = 0
    ignored: int = 0

    def silent_for(self, now: float) -> float:
        """Return the time (s) since the last reading; without one, since the first call."""
        if self.last_reading is None:
            self.last_reading = self.last_confirmed = now
        return now - self.last_reading

    def invalidate(self, reason: str) -> None:
        """Set the state to unknown until readings confirm another one."""
        self.state = "unknown"
        self.reason = reason
        self.unconfirmed = True
        self.explained_by = None
        self.run_state = None
        self.rule.reset()


@dataclass
class _Area:
    definition: AreaDefinition
    nodes: dict[str, _NodeState] = field(default_factory=dict)
    last_known_blocked: bool = False  # then unknown costs as much as blocked
    confirmed: bool = False  # whether readings of this run have confirmed a state
    hazard: AreaHazard | None = None


@dataclass(frozen=True)
class NodeReport:
    """Health of a node, for people: `age` is the time (s) since its last reading, None before the first one."""

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

    `restored` are the hazards that were stored last: a blocked area stays blocked until readings or silence change it.
    All others start as unknown, because only readings of this run can show that an area is clear. `registry` finds
    debounce rules by name, `default_rule` is the one of areas that name none; raises `DebounceError` for an area whose
    debounce settings are invalid.
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
        self.nodes = {node.id: node for node in nodes}
        self._registry = registry
        self._default_rule = default_rule
        self._areas: dict[str, _Area] = {}
        self._tombstones: dict[str, AreaDefinition] = {}
        self._poses: dict[str, tuple[float, RobotPose]] = {}
        self._seqs: dict[str, int] = {}
        self._by_node: dict[str, list[tuple[_Area, _NodeState]]] = {}
        self._last_tick: float | None = None
        self._last_tick_skipped = False
        for definition in definitions:
            self._define(definition)
        for hazard in restored:
            self._restore_at_start(hazard)

    # --- State ------------------------------------------------------------------------------------------------------

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
                age=node.silent_for(now) if node.ever_received else None,
                received=node.received,
                ignored=node.ignored,
            )
            for area in self._areas.values()
            for node in area.nodes.values()
        ]

    # --- Inputs -----------------------------------------------------------------------------------------------------

    def on_reading(self, node_id: str, reading: NodeReading, now: float, stamp: float) -> list[AreaHazard]:
        """Apply a reading; duplicate and outdated ones (by boot and seq) are ignored."""
        changed: list[AreaHazard] = []
        for area, node in self._by_node.get(node_id, ()):
            if not _is_newer(node, reading, now, area.definition.unknown.silent_after_s):
                node.ignored += 1
                continue
            node.boot, node.seq = reading.boot, reading.seq
            if node.site is None:
                classification = Classification(
                    reading.state, f"the node reports {reading.state} (the site does not define it)"
                )
            else:
                classification = classify_reading(node.site, reading, self._fresh_poses(now))
            self._apply(node, classification, now, stamp)
            changed += self._evaluate(area, stamp)
        return changed

    def on_thesis_state(self, number: int, state: str, now: float, stamp: float) -> list[AreaHazard]:
        """Apply `blocked` or `clear` from a thesis node; any other text counts as an implausible reading."""
        changed: list[AreaHazard] = []
        for area in self._areas.values():
            if area.definition.number != number:
                continue
            name = THESIS_NODE.format(number=number)
            node = area.nodes.get(name)
            if node is None:
                node = area.nodes[name] = _NodeState(name, None, self.new_rule(area.definition))
            reported: AreaState = BLOCKED if state == BLOCKED else CLEAR if state == CLEAR else "unknown"
            reason = f"it reports {reported}" if reported != "unknown" else f"it reports neither {BLOCKED} nor {CLEAR}"
            self._apply(node, Classification(reported, reason), now, stamp)
            changed += self._evaluate(area, stamp)
        return changed

    def on_availability(self, node_id: str, online: bool, now: float, stamp: float) -> list[AreaHazard]:  # noqa: FBT001  # the topic's payload
        """Apply a node's availability message or last will; an offline node is unknown until its next readings."""
        changed: list[AreaHazard] = []
        for area, node in self._by_node.get(node_id, ()):
            node.online = online
            if not online and node.state != "unknown":
                node.invalidate("it went offline")
                node.last_confirmed = now
                changed += self._evaluate(area, stamp)
        return changed

    def on_pose(self, robot: str, pose: RobotPose, now: float) -> list[AreaHazard]:
        """Record a robot's pose, which may explain later readings."""
        self._poses[robot] = (now, pose)
        return []

    def tick(self, now: float, stamp: float) -> list[AreaHazard]:
        """Detect silent and flapping nodes; call ten times a second.

        A gap between calls means that the process itself was stalled. Then only the next call evaluates, so that the
        messages that arrived meanwhile are handled first.
        """
        stalled = self._last_tick is not None and now - self._last_tick > LATE_TICK_S and not self._last_tick_skipped
        self._last_tick, self._last_tick_skipped = now, stalled
        if stalled:
            return []
        changed: list[AreaHazard] = []
        for area in self._areas.values():
            limit = area.definition.unknown.silent_after_s
            for node in area.nodes.values():
                if node.silent_for(now) > limit:
                    reason = f"it has been silent for more than {limit:g} s"
                    if node.state != "unknown" or node.reason != reason:
                        node.invalidate(reason)
                elif now - node.last_confirmed > limit and node.state != "unknown":
                    node.invalidate("its readings contradict one another")
            changed += self._evaluate(area, stamp)
        self._poses = {robot: entry for robot, entry in self._poses.items() if now - entry[0] <= ROBOT_POSE.max_age_s}
        return changed

    def put_area(self, definition: AreaDefinition, stamp: float) -> list[AreaHazard]:
        """Add, change or (with `removed`) remove an area; its nodes keep their confirmed states."""
        self._define(definition)
        area = self._areas.get(definition.id)
        return self._evaluate(area, stamp) if area else []

    def restore(self, hazards: Iterable[AreaHazard], stamp: float) -> list[AreaHazard]:
        """Apply hazards that were unreadable at the start; areas that readings have confirmed since keep theirs."""
        changed: list[AreaHazard] = []
        for hazard in hazards:
            area = self._areas.get(hazard.area)
            if area is not None and not area.confirmed and _is_impassable(hazard):
                area.last_known_blocked = True
                changed += self._evaluate(area, stamp)
        return changed

    def set_epoch(self, epoch: int) -> None:
        """Give all hazards, those to come too, another epoch."""
        self.epoch = epoch
        for area in self._areas.values():
            if area.hazard is not None:
                area.hazard = structs.replace(area.hazard, epoch=epoch)

    def new_rule(self, definition: AreaDefinition) -> Rule:
        """Return a fresh debounce rule for a node of an area; raises `DebounceError` for invalid settings."""
        return make_rule(definition.id, definition.debounce, self._registry, self._default_rule)

    # --- Inside -----------------------------------------------------------------------------------------------------

    def _define(self, definition: AreaDefinition) -> None:
        self.new_rule(definition)  # an area without nodes must not hide invalid debounce settings
        old = self._areas.get(definition.id)
        if definition.removed:
            self._areas.pop(definition.id, None)
            self._tombstones[definition.id] = definition
        else:
            self._tombstones.pop(definition.id, None)
            area = _Area(definition)
            if old is not None:
                area.last_known_blocked, area.confirmed = old.last_known_blocked, old.confirmed
                area.hazard = old.hazard
            keep_rules = old is not None and old.definition.debounce == definition.debounce
            undefined = {name for name in (old.nodes if old else ()) if name not in self.nodes}
            thesis = {THESIS_NODE.format(number=definition.number)} & undefined
            for name in [*definition.nodes, *sorted(thesis - set(definition.nodes))]:
                node = old.nodes.get(name) if old is not None else None
                if node is None:
                    node = _NodeState(name, self.nodes.get(name), self.new_rule(definition))
                elif not keep_rules:
                    node.rule = self.new_rule(definition)
                area.nodes[name] = node
            self._areas[definition.id] = area
        self._by_node = {}
        for area in self._areas.values():
            for node in area.nodes.values():
                self._by_node.setdefault(node.id, []).append((area, node))

    def _restore_at_start(self, hazard: AreaHazard) -> None:
        area = self._areas.get(hazard.area)
        if area is None:
            return
        area.last_known_blocked = _is_impassable(hazard)
        if hazard.state == "blocked":
            for node in area.nodes.values():
                node.state = hazard.state
                node.reason = "the area was blocked before the restart"

    def _fresh_poses(self, now: float) -> Iterator[tuple[str, RobotPose]]:
        for robot, (received, pose) in self._poses.items():
            if now - received <= ROBOT_POSE.max_age_s and pose.localized:
                yield robot, pose

    @staticmethod
    def _apply(node: _NodeState, classification: Classification, now: float, stamp: float) -> None:
        """Apply one classified reading to its node."""
        node.silent_for(now)
        node.received += 1
        node.last_reading = now
        node.ever_received = True
        node.online = True
        if classification.explained_by is not None:
            # Counts neither way: the debounce rule does not see it, and the timer that detects flapping restarts.
            node.explained_by = classification.explained_by
            node.last_confirmed = now
            return
        if classification.state != node.run_state:
            node.run_state = classification.state
            node.run_began = stamp
        confirmed = node.rule.update(classification.state, now)
        if confirmed is None:
            return
        node.last_confirmed = now
        node.explained_by = None
        if confirmed != node.state or node.unconfirmed:
            # Later readings of the same state leave the reason: the hazard would change with every centimetre.
            node.state, node.reason, node.unconfirmed = confirmed, classification.reason, False

    def _evaluate(self, area: _Area, stamp: float) -> list[AreaHazard]:
        """Fuse the nodes; return the area's hazard when it changed."""
        state, deciding = _fuse(area)
        if state != "unknown":
            area.last_known_blocked = state == "blocked"
            area.confirmed = area.confirmed or (deciding is not None and deciding.ever_received)
        penalty = LETHAL if state == "blocked" or (state == "unknown" and area.last_known_blocked) else 0
        if state == "unknown" and not area.last_known_blocked:
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
        if state == "blocked" and (old is None or old.state != state) and deciding and deciding.run_state == state:
            trace = Trace(
                area=area.definition.id, epoch=self.epoch, seq=seq, first_reading=deciding.run_began, confirmed=stamp
            )
        area.hazard = AreaHazard(
            area=area.definition.id,
            state=state,
            severity=SEVERITY["unknown_after_blocked" if state == "unknown" and area.last_known_blocked else state],
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


def _is_impassable(hazard: AreaHazard) -> bool:
    """Whether a hazard makes its area impassable."""
    return hazard.state == "blocked" or (hazard.state == "unknown" and hazard.penalty >= LETHAL)


def _is_newer(node: _NodeState, reading: NodeReading, now: float, silent_after: float) -> bool:
    """Whether a reading is newer than all before; a lower boot id counts once the node has been silent."""
    if reading.boot != node.boot:
        return reading.boot > node.boot or node.silent_for(now) > silent_after
    return reading.seq > node.seq


def _fuse(area: _Area) -> tuple[AreaState, _NodeState | None]:
    """Return the area's state and the node that decided it: blocked needs one node, clear needs all of them."""
    nodes = list(area.nodes.values())
    for state in ("blocked", "unknown"):
        for node in nodes:
            if node.state == state:
                return state, node
    return ("clear", nodes[0]) if nodes else ("unknown", None)


def _cause(area: _Area, state: AreaState, deciding: _NodeState | None) -> str:
    """Return a sentence on why the area is in its state."""
    if deciding is None:
        return "no node watches this area"
    sentence = f"node {deciding.id}: {deciding.reason}"
    if state == "clear" and len(area.nodes) > 1:
        sentence = f"all {len(area.nodes)} nodes agree; {sentence}"
    if state == "unknown":
        sentence += "; it was blocked before and stays impassable" if area.last_known_blocked else ""
    return sentence[:500]
