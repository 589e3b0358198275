"""Fuses the states of an area's nodes and sources by its policy: blocked when enough of them are. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

from hazard_aggregator.area_size import AreaError

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from fog_contracts.messages import AreaDefinition, AreaState, FusionPolicy

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
