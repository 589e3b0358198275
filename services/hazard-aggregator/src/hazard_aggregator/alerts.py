"""The health of nodes and sources, and what an operator must be told: what is unknown or blocked for long. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal, NamedTuple

from msgspec import structs

from fog_contracts.messages import Alert, AlertList, Message

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping

    from fog_contracts.handlers import Moment
    from fog_contracts.messages import AlertKind, AreaDefinition, AreaHazard, AreaState, Reason
    from hazard_aggregator.areas import WatchedArea


@dataclass(frozen=True)
class NodeReport:
    """Health of a node; `age` is the time (s) since its last reading, None before the first one.

    `penalty` is the area's cost while this node or source alone is blocked; None: the area is impassable then.
    `flapping`: it is unknown because it changed too often.
    """

    id: str
    area: str
    state: AreaState
    reason: Reason
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


LISTED: Final = 40
"""Alerts of one message: with the longest reasons they still fit into its channel."""
_REASON_MAX: Final = 200


class AlertError(Exception):
    """There is no alert of this id."""


class AlertEvent(NamedTuple):
    """An alert that was raised, ended or acknowledged, when (s since the epoch), and by whom if it was a person."""

    action: Literal["raise", "end", "acknowledge"]
    alert: Alert
    at: float
    who: str = "hazard-aggregator"


class StoredAlerts(Message, frozen=True, kw_only=True):
    """The alerts that were active when they were stored."""

    alerts: list[Alert]


class _Condition(NamedTuple):
    """What is so now, and after how long (s) it is an alert."""

    kind: AlertKind
    area: str
    node: str | None
    reason: str
    after_s: float
    code: str = ""


class Alerts:
    """The active alerts. One ends with its condition; the next one of its kind needs the whole time again."""

    def __init__(self) -> None:
        self._began: dict[str, tuple[float, float]] = {}
        self._active: dict[str, Alert] = {}

    def active(self) -> list[Alert]:
        """Return all active alerts, oldest first."""
        return sorted(self._active.values(), key=lambda alert: alert.raised)

    def message(self, epoch: int) -> AlertList:
        """Return the message that an aggregator with this epoch publishes: those that nobody has seen come first."""
        alerts = self.active()
        unseen = [alert for alert in alerts if alert.acknowledged_by is None]
        listed = [*unseen, *(alert for alert in alerts if alert.acknowledged_by is not None)][:LISTED]
        return AlertList(epoch=epoch, total=len(alerts), unseen=len(unseen), alerts=listed)

    def restore(self, alerts: Iterable[Alert]) -> None:
        """Go on with the alerts of an earlier run; those whose condition is over end with the next update."""
        for alert in alerts:
            self._active[alert.id] = alert

    def update(
        self,
        definitions: Iterable[AreaDefinition],
        hazards: Mapping[str, AreaHazard],
        reports: Iterable[NodeReport],
        at: Moment,
    ) -> list[AlertEvent]:
        """Return the alerts that begin and end now, by the policies of the areas; call about once a second."""
        known = {definition.id: definition for definition in definitions if not definition.removed}
        present = {_id(condition): condition for condition in _conditions(known, hazards, list(reports))}
        self._began = {name: self._began.get(name, (at.now, at.stamp)) for name in present}
        ended = [AlertEvent("end", self._active.pop(name), at.stamp) for name in self._active.keys() - present.keys()]
        return [*ended, *self._raise(present, at)]

    def acknowledgement(self, name: str, who: str, stamp: float) -> AlertEvent:
        """Return that an operator has seen an alert (s since the epoch), to be stored; raises `AlertError`."""
        alert = self._active.get(name)
        if alert is None:
            raise AlertError(f"there is no alert {name}: it may have ended")
        return AlertEvent("acknowledge", structs.replace(alert, acknowledged_by=who, acknowledged_at=stamp), stamp, who)

    def accept(self, acknowledged: Alert) -> None:
        """Put an acknowledgement into force, now that it is stored; its alert may have ended meanwhile."""
        now = self._active.get(acknowledged.id)
        if now is not None and now.raised == acknowledged.raised:
            self._active[acknowledged.id] = acknowledged

    def _raise(self, present: Mapping[str, _Condition], at: Moment) -> Iterator[AlertEvent]:
        for name, condition in present.items():
            active, (began, stamp) = self._active.get(name), self._began[name]
            if active is not None:
                reason = condition.reason[:_REASON_MAX]
                self._active[name] = structs.replace(active, reason=reason, code=condition.code)
            elif at.now - began >= condition.after_s:
                alert = self._active[name] = Alert(
                    id=name,
                    kind=condition.kind,
                    area=condition.area,
                    node=condition.node,
                    reason=condition.reason[:_REASON_MAX],
                    since=stamp,
                    raised=at.stamp,
                    code=condition.code,
                )
                yield AlertEvent("raise", alert, at.stamp)


def _id(condition: _Condition) -> str:
    parts = (condition.kind, condition.area, condition.node)
    return ".".join(part for part in parts if part is not None)


def _conditions(
    definitions: Mapping[str, AreaDefinition], hazards: Mapping[str, AreaHazard], reports: list[NodeReport]
) -> Iterator[_Condition]:
    costly = {report.area for report in reports if report.state == "blocked" and report.penalty is not None}
    for area, definition in definitions.items():
        policy, hazard = definition.alerts, hazards.get(area)
        # An operator who overrides an area knows of it.
        if hazard is None or hazard.override is not None or hazard.state == "clear":
            continue
        if hazard.state == "blocked":
            if policy.blocked_after_s > 0:
                yield _Condition("area-blocked", area, None, hazard.cause, policy.blocked_after_s)
        elif area not in costly and policy.unknown_after_s > 0:
            yield _Condition("area-unknown", area, None, hazard.cause, policy.unknown_after_s)
    for report in reports:
        after_s = definitions[report.area].alerts.node_after_s if report.area in definitions else 0
        if report.state == "unknown" and after_s > 0:
            yield _Condition("node-unknown", report.area, report.id, report.reason, after_s, report.reason.code)
