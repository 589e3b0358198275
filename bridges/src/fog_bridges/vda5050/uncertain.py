"""Requests to the floor of which nobody knows what has become: who cancels must not be told that all is over. Pure.

A request that got no answer may still be on its way, or wait in a service or a store that hangs. A mission's has a key
by which the floor can be asked: the same request again, under a condition that no robot meets, returns the mission if
there ever was one, and else is refused and begins none.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from fog_bridges.floor import Answer, Request
    from fog_bridges.vda5050.incoming import Node

UNCERTAIN: Final = ("", "service_silent", "store_uncertain", "command_lost")
"""Problems of requests that may have been carried out."""
NOT_BEGUN: Final = ("mission_changed", "goal_refused", "out_of_service", "key_reused")
"""Problems that a mission's request has only if none was begun by its key so far."""
NOBODYS: Final = '"none"'
"""The tag of no mission."""
LATE_S: Final = 60.0
"""After so long without an answer it is told that nobody knows; the console waits for a service for 30 s."""
UNSEEN_S: Final = 5.0
"""How long what became of a mission may be told late."""
RESENT_S: Final = 120.0
"""A packet is sent again after so long at the latest (Linux's TCP)."""


class Uncertain:
    """A mission that may have begun, or may still begin. Times are s of a monotonic clock."""

    def __init__(self, request: Request, node: Node, asked_at: float) -> None:
        """`request` was first sent at `asked_at`, for `node`."""
        self.request = request
        self.node: Node | None = node
        """For what it is wanted: None when it was refused since, and is not sent again."""
        self.mission = ""
        """Its id, once it shows; empty before."""
        self.is_over = False
        """Whether there is none, and none will begin."""
        self._asked_at = asked_at
        self._denied_at: float | None = None

    @property
    def question(self) -> Request:
        """The request that returns the mission if it has begun, and begins none."""
        key = (self.request.headers or {})["Idempotency-Key"]
        return self.request._replace(headers={"If-Match": NOBODYS, "Idempotency-Key": key})

    @property
    def is_denied(self) -> bool:
        """Whether the floor has said that it had not begun."""
        return self._denied_at is not None

    def replaces(self, end: Request) -> bool:
        """Whether it can only begin in the place of the mission that a request ends."""
        condition = (self.request.headers or {}).get("If-Match")
        return condition is not None and condition == (end.headers or {}).get("If-Match")

    def on_refusal(self, answer: Answer, sent_at: float, now: float) -> None:
        """Take in why the floor refused the request again, or the question, sent at `sent_at`.

        It is over once the floor says so after as long again as nobody knew: a packet that a network has lost is sent
        again after twice the time, and may come after the question.
        """
        if answer.problem not in NOT_BEGUN:
            return
        self.node = None
        if self._denied_at is None:
            self._denied_at = now
        unknown = self._denied_at - self._asked_at
        self.is_over = sent_at - self._denied_at >= min(max(UNSEEN_S, unknown), RESENT_S)

    def doubt(self, now: float) -> str:
        """Return why nobody knows whether it is over; empty before that has taken long."""
        if now - self._asked_at < LATE_S:
            return ""
        return "the floor does not say whether the robot's mission has begun: it is ended as soon as it shows"
