"""Health of the nodes and sources of areas, for people. Pure; time is an argument."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Iterable

    from fog_contracts.messages import AreaState
    from hazard_aggregator.areas.watched_area import WatchedArea


@dataclass(frozen=True)
class NodeReport:
    """Health of a node; `age` is the time (s) since its last reading, None before the first one.

    `penalty` is the area's cost while this node or source alone is blocked; None: the area is impassable then.
    `flapping`: it is unknown because it changed too often.
    """

    id: str
    area: str
    state: AreaState
    reason: str
    online: bool | None
    age: float | None
    received: int
    ignored: int
    penalty: int | None = None
    flapping: bool = False


def node_reports(areas: Iterable[WatchedArea], now: float) -> list[NodeReport]:
    """Return the health of every node of these areas at `now` (s, the receiver's clock)."""
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
            penalty=node.penalty,
            flapping=node.state == "unknown" and node.flaps.flapping,
        )
        for area in areas
        for node in area.nodes.values()
    ]
