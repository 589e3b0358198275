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
"""No clock (ms) gives an epoch as high as this one: above it, epochs rise in steps of at most `MOST_AHEAD`."""
MOST_AHEAD: Final = 2**20
"""How far one message may raise the highest known epoch above `HEARD_LIMIT`. So many leaders don't follow one another
unheard, and it takes billions of forged messages to leave no room for a leader above them."""


def within_reach(epoch: int, known: int) -> int:
    """Return how far an epoch that is heard of may raise the highest known one: it may be forged.

    Receivers and leaders limit what they hear alike. So a leader can always get an epoch that its receivers accept,
    and one whose own epoch lies above `HEARD_LIMIT` still gives way to a higher one.
    """
    return min(epoch, max(known, HEARD_LIMIT) + MOST_AHEAD)


class Fence:
    """The highest epoch received of each service, by its role."""

    def __init__(self) -> None:
        self._highest: dict[str, int] = {}

    @property
    def epochs(self) -> dict[str, int]:
        """The highest epoch received of each service."""
        return dict(self._highest)

    def raise_to(self, service: str, epoch: int) -> None:
        """Refuse messages of the service below an epoch that came another way, as far as it is `within_reach`."""
        highest = self._highest.get(service, 0)
        self._highest[service] = max(within_reach(epoch, highest), highest)

    def reaches(self, service: str, epoch: int) -> bool:
        """Return whether the service can have the epoch, by the highest one that is known of it."""
        return epoch <= within_reach(epoch, self._highest.get(service, 0))

    def require_current(self, service: str, epoch: int) -> None:
        """Raise `RefusedMessageError` for an epoch below the highest one of its service, or far above all possible."""
        if not self.reaches(service, epoch):
            raise RefusedMessageError(f"its epoch {epoch} is far above all before: no {service} can have it yet")
        if epoch < (highest := self._highest.get(service, 0)):
            raise RefusedMessageError(f"its epoch {epoch} is below {highest}: another {service} has taken over")

    def accept(self, service: str, epoch: int) -> None:
        """Raise the highest epoch of the service to that of a message; raises as `require_current`.

        A refused epoch raises it, too, but only by a step: a receiver that has just started, and has heard of none,
        gets up to a leader that had to follow forged ones.
        """
        try:
            self.require_current(service, epoch)
        finally:
            self.raise_to(service, epoch)

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
            self.accept(service, epoch)
            return handler(ids, message, at)

        return handle


def epoch_in(channel: Channel, message: object, service: str) -> int:
    """Return the highest epoch of a service that a message shows: its own one, or one that its sender received."""
    own = getattr(message, channel.epoch) if channel.epoch and service in channel.publishers else 0
    seen: Mapping[str, int] = getattr(message, "epochs", {})
    return max(own, seen.get(service, 0))
