"""One area: fuses its nodes to one state, and turns each change of it into a hazard. Pure; time is an argument.

An operator's override counts instead of the nodes; what these give without it goes on underneath.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from msgspec import structs

from fog_contracts.costs import LETHAL
from fog_contracts.messages import SEVERITY, AreaHazard, HazardOverride, Trace
from hazard_aggregator.areas.voting import fuse
from hazard_aggregator.sensors.node_state import SourceState

if TYPE_CHECKING:
    from fog_contracts.messages import AreaDefinition, AreaState
    from hazard_aggregator.areas.area_override import AreaOverride
    from hazard_aggregator.sensors.node_state import NodeState


PASSABLE_PENALTY: Final = 200
"""The highest cost of an area that an operator declared clear: robots prefer other ways, but can pass."""


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

    def take_back(self, node: str) -> None:
        """Handle that what a node saw was no hazard: if it alone saw one, the area is as impassable as before that."""
        self._blocked_by.discard(node)
        if not self._blocked_by:
            self._last_known_blocked = self._known_before

    def set_epoch(self, epoch: int) -> None:
        """Give the current hazard another epoch."""
        if self.hazard is not None:
            self.hazard = structs.replace(self.hazard, epoch=epoch)

    def evaluate(self, epoch: int, seq: int, stamp: float, override: AreaOverride | None = None) -> AreaHazard | None:
        """Fuse the nodes, unless an operator's word counts; return the area's hazard, with this epoch and `seq`.

        None when it did not change.
        """
        measured = self._measure()
        state, penalty, severity, cause, deciding = self._overridden(measured, override)
        explained = next((node.explained_by for node in self.nodes.values() if node.explained_by), None)
        told = None if override is None else _told(override, measured)
        since = self._since(state, stamp)
        old = self.hazard
        if old is not None and (old.state, old.penalty, old.explained_by, old.since, old.override) == (
            state, penalty, explained, since, told,
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
        """Return what counts: what the nodes measure, or the operator's word.

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
