"""Turns what the fog says into events: the state of everything as a compacted log. Pure."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from fog_contracts.channels import Channel
    from fog_contracts.handlers import Handler, Moment, Publication


class ConsoleCore:
    """What is known of the site."""

    def handlers(self) -> Mapping[Channel, Handler]:
        """Return the handler of every channel that the console-service subscribes to."""
        return {}

    def tick(self, at: Moment) -> Sequence[Publication]:  # noqa: ARG002  # as every core's
        """Advance to `at`; nothing is ever published."""
        return ()
