"""One area: fuses its nodes to one state, and turns each change of it into a hazard. Pure; time is an argument."""

from __future__ import annotations

from typing import TYPE_CHECKING

from msgspec import structs

from fog_contracts.costs import LETHAL
from fog_contracts.messages import SEVERITY, AreaHazard, Trace

if TYPE_CHECKING:
    from fog_contracts.messages import AreaDefinition, AreaState
    from hazard_aggregator.node_state import NodeState


class WatchedArea:
    """An area that is not removed; an unobserved one is never clear."""

    def __init__(self, definition: AreaDefinition, nodes: dict[str, NodeState]) -> None:
        self.definition = definition
        self.nodes = nodes
        self.hazard: AreaHazard | None = None
        self._last_known_blocked = False  # then unknown costs as much as blocked
        self._confirmed = False  # whether readings of this run have confirmed a state
        self._restored: AreaHazard | None = None

    def redefine(self, definition: AreaDefinition, nodes: dict[str, NodeState]) -> None:
        """Change the definition and the nodes; the state is that of the nodes."""
        self.definition = definition
        self.nodes = nodes

    def restore_at_start(self, hazard: AreaHazard) -> None:
        """Begin with the hazard of an earlier run: a blocked area stays blocked until readings or silence change it."""
        self._restored = hazard
        self._last_known_blocked = is_impassable(hazard)
        if hazard.state == "blocked":
            for node in self.nodes.values():
                node.restore_blocked()

    def restore_late(self, hazard: AreaHazard) -> bool:
        """Apply the hazard of an earlier run, which was unreadable at the start; return whether that may change ours.

        Only a danger counts, and not against what readings of this run have confirmed.
        """
        if self._restored is None or (hazard.epoch, hazard.seq) > (self._restored.epoch, self._restored.seq):
            self._restored = hazard
        if self._confirmed or not is_impassable(hazard):
            return False
        self._last_known_blocked = True
        return True

    def set_epoch(self, epoch: int) -> None:
        """Give the current hazard another epoch."""
        if self.hazard is not None:
            self.hazard = structs.replace(self.hazard, epoch=epoch)

    def evaluate(self, epoch: int, seq: int, stamp: float) -> AreaHazard | None:
        """Fuse the nodes; return the area's hazard, with this epoch and `seq`, when it changed."""
        state, deciding = self._fuse()
        if state != "unknown":
            self._last_known_blocked = state == "blocked"
            self._confirmed = self._confirmed or (deciding is not None and deciding.ever_received)
        penalty = LETHAL if state == "blocked" or (state == "unknown" and self._last_known_blocked) else 0
        if state == "unknown" and not self._last_known_blocked:
            penalty = self.definition.unknown.penalty
        explained = next((node.explained_by for node in self.nodes.values() if node.explained_by), None)
        old = self.hazard
        same = old is not None and (old.state, old.penalty, old.explained_by) == (state, penalty, explained)
        if same and state != "unknown":
            return None
        cause = self._cause(state, deciding)
        if same and old is not None and old.cause == cause:
            return None
        trace = None
        if state == "blocked" and (old is None or old.state != state) and deciding and deciding.run_state == state:
            trace = Trace(
                area=self.definition.id, epoch=epoch, seq=seq, first_reading=deciding.run_began, confirmed=stamp
            )
        self.hazard = AreaHazard(
            area=self.definition.id,
            state=state,
            severity=SEVERITY["unknown_after_blocked" if state == "unknown" and self._last_known_blocked else state],
            penalty=penalty,
            since=self._since(state, stamp),
            seq=seq,
            epoch=epoch,
            cause=cause,
            nodes={node.id: node.state for node in self.nodes.values()},
            explained_by=explained,
            trace=trace,
        )
        return self.hazard

    def _since(self, state: AreaState, stamp: float) -> float:
        """Return since when the area has had this state, across a restart too."""
        before = self.hazard or self._restored
        return before.since if before is not None and before.state == state else stamp

    def _fuse(self) -> tuple[AreaState, NodeState | None]:
        """Return the area's state and the node that decided it: blocked needs one node, clear needs all of them."""
        nodes = list(self.nodes.values())
        for state in ("blocked", "unknown"):
            for node in nodes:
                if node.state == state:
                    return state, node
        return ("clear", nodes[0]) if nodes else ("unknown", None)

    def _cause(self, state: AreaState, deciding: NodeState | None) -> str:
        """Return a sentence on why the area is in its state."""
        if deciding is None:
            return "no node watches this area"
        sentence = f"node {deciding.id}: {deciding.reason}"
        if state == "clear" and len(self.nodes) > 1:
            sentence = f"all {len(self.nodes)} nodes agree; {sentence}"
        if state == "unknown":
            sentence += "; it was blocked before and stays impassable" if self._last_known_blocked else ""
        return sentence[:500]


def is_impassable(hazard: AreaHazard) -> bool:
    """Whether a hazard makes its area impassable."""
    return hazard.state == "blocked" or (hazard.state == "unknown" and hazard.penalty >= LETHAL)
