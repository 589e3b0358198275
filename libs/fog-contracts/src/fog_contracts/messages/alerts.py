"""What people should look at (MQTT, JSON)."""

from typing import Annotated, Literal

from msgspec import Meta

from fog_contracts.messages.basics import Author, Count, Id, Message, Stamp

AlertKind = Literal["area-unknown", "area-blocked", "node-unknown"]


class Alert(Message, frozen=True, kw_only=True):
    """A condition of an area, or of a node or source in it, that has lasted for as long as the area's policy allows.

    It lasts since `since` and was raised at `raised`, or acknowledged by an operator at `acknowledged_at`. `reason` is
    the newest one.
    """

    id: Annotated[str, Meta(max_length=100)]
    kind: AlertKind
    area: Id
    node: Id | None = None
    reason: Annotated[str, Meta(max_length=200)]
    since: Stamp
    raised: Stamp
    acknowledged_by: Author | None = None
    acknowledged_at: Stamp | None = None


class AlertList(Message, frozen=True, kw_only=True):
    """The present alerts, those that nobody has acknowledged first: the first of very many only.

    `total` counts all of them, `unseen` those that nobody has acknowledged.
    """

    epoch: Count
    total: Count
    unseen: Count
    alerts: list[Alert]
