"""Fencing: receivers refuse messages of an epoch below the highest that they received from that service. Pure.

A service has one leader at a time, whose epoch is larger than that of every leader before it
(`fog_runtime.leases.lease`). A leader that was replaced without knowing it, because it was stopped or cut off, still
sends its own epoch.
"""

from __future__ import annotations

from functools import wraps
from typing import TYPE_CHECKING, Final

from fog_contracts.handlers import RefusedMessageError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from fog_contracts.channels import Channel
    from fog_contracts.handlers import Handler, Ids, Moment, Publication


HEARD_LIMIT: Final = 2**52
"""No clock (ms) gives an epoch as high as this one. Higher ones count as this when they are heard of, so that whoever
forges one leaves room for a leader above it ..."""
HIGHEST_EPOCH: Final = HEARD_LIMIT + 2**32
"""... and messages with an epoch above this are refused: not so many leaders can have followed one another."""


class Fence:
    """The highest epoch received of each service, by its role."""

    def __init__(self) -> None:
        self._highest: dict[str, int] = {}

    @property
    def epochs(self) -> dict[str, int]:
        """The highest epoch received of each service."""
        return dict(self._highest)

    def raise_to(self, service: str, epoch: int) -> None:
        """Refuse messages of the service below an epoch that came another way, as the reply to a query."""
        self._highest[service] = max(epoch, self._highest.get(service, 0))

    def require_current(self, service: str, epoch: int) -> None:
        """Raise `RefusedMessageError` for an epoch below the highest one of its service, or one that none can have."""
        if epoch > HIGHEST_EPOCH:
            raise RefusedMessageError(f"its epoch {epoch} is above {HIGHEST_EPOCH}: no {service} can have it")
        if epoch < (highest := self._highest.get(service, 0)):
            raise RefusedMessageError(f"its epoch {epoch} is below {highest}: another {service} has taken over")

    def guarded(self, handlers: Mapping[Channel, Handler]) -> dict[Channel, Handler]:
        """Return the handlers, refusing messages of lower epochs on the channels that carry one (`Channel.epoch`)."""
        return {
            channel: self._guarded(channel, handler) if channel.epoch else handler
            for channel, handler in handlers.items()
        }

    def _guarded(self, channel: Channel, handler: Handler) -> Handler:
        @wraps(handler)
        def handle(ids: Ids, message: object, at: Moment) -> Sequence[Publication]:
            service, epoch = channel.publishers[0], getattr(message, channel.epoch)
            self.require_current(service, epoch)
            self.raise_to(service, epoch)
            return handler(ids, message, at)

        return handle


def epoch_in(channel: Channel, message: object, service: str) -> int:
    """Return the highest epoch of a service that a message shows: its own one, or one that its sender received."""
    own = getattr(message, channel.epoch) if channel.epoch and service in channel.publishers else 0
    seen: Mapping[str, int] = getattr(message, "epochs", {})
    return max(own, seen.get(service, 0))
