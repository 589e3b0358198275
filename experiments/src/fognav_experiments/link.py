"""A robot's Wi-Fi in lockstep: messages that arrive at once, late, in one direction only, or not at all. Pure."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from fog_contracts.handlers import Moment, Publication

    Arrival = Callable[[Moment], Sequence[Publication]]
    R = TypeVar("R")


class Link:
    """The messages between the fog and one robot, in their order.

    `hears`, `is_heard`: whether messages reach the robot, and the robot's the fog; what is under way when that ends is
    lost. `delay_s`: how long each takes.
    """

    def __init__(self) -> None:
        self.hears = self.is_heard = True
        self.delay_s = 0.0
        self._under_way: deque[tuple[float, bool, Arrival]] = deque()

    @property
    def whole(self) -> bool:
        """Whether a query is answered: it needs both directions."""
        return self.hears and self.is_heard

    def down(self, arrive: Arrival, at: Moment) -> Sequence[Publication]:
        """Send a message to the robot; return what its handler publishes, if it arrives at once."""
        return self._pass(arrive, at, down=True) if self.hears else ()

    def up(self, publications: Sequence[Publication], at: Moment) -> Sequence[Publication]:
        """Send what the robot publishes; return what arrives at once."""
        return self._pass(lambda _when: publications, at, down=False) if self.is_heard and publications else ()

    def ask(self, answer: Callable[[Moment], R], receive: Callable[[R, Moment], None], at: Moment) -> None:
        """Send a query of the robot's: `answer` is called once it arrives, and `receive` once its reply does.

        Either may be lost; then `receive` is not called.
        """

        def reply(when: Moment) -> Sequence[Publication]:
            answered = answer(when)

            def arrive(then: Moment) -> Sequence[Publication]:
                receive(answered, then)
                return ()

            return self.down(arrive, when)

        if self.is_heard:
            self._pass(reply, at, down=False)

    def due(self, at: Moment) -> Sequence[Publication]:
        """Let what was under way long enough arrive; return what is published then. Call it every 10 ms."""
        published: list[Publication] = []
        while self._under_way and self._under_way[0][0] <= at.now:
            _, down, arrive = self._under_way.popleft()
            if self.hears if down else self.is_heard:
                published += arrive(at)
        return published

    def _pass(self, arrive: Arrival, at: Moment, *, down: bool) -> Sequence[Publication]:
        if self.delay_s <= 0.0 and not self._under_way:
            return arrive(at)
        # Nothing overtakes what is under way, as on a TCP connection.
        last = self._under_way[-1][0] if self._under_way else at.now
        self._under_way.append((max(at.now + self.delay_s, last), down, arrive))
        return ()
