"""What wakes the guardian: a time limit, and the descriptors that it watches."""

from __future__ import annotations

import select
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import socket
    from collections.abc import Callable


class Wakeups:
    """The descriptors that are watched, each with the handler of its events."""

    def __init__(self) -> None:
        self._poll = select.poll()
        self._handlers: dict[int, Callable[[], None]] = {}

    def watch(self, descriptor: int, handler: Callable[[], None], *, input_too: bool = True) -> None:
        """Call `handler` for each input, from now on; without `input_too` only when the other end has closed."""
        self._handlers[descriptor] = handler
        self._poll.register(descriptor, select.POLLIN if input_too else 0)

    def forget(self, descriptor: int) -> None:
        """Watch a descriptor no longer."""
        self._poll.unregister(descriptor)
        del self._handlers[descriptor]

    def wait(self, real_s: float) -> None:
        """Wait for an event, `real_s` real seconds at most, and handle it."""
        for descriptor, _ in self._poll.poll(1000.0 * real_s):
            if (handler := self._handlers.get(descriptor)) is not None:  # None: closed by the handler before
                handler()


class Commands:
    """Tells whether the agent has sent something, without an exception for each time that it has not."""

    def __init__(self, agent: socket.socket) -> None:
        self._poll = select.poll()
        self._poll.register(agent, select.POLLIN)

    def pending(self) -> bool:
        """Return whether a read of the socket would not block: a packet, or the end of the link."""
        return bool(self._poll.poll(0))
