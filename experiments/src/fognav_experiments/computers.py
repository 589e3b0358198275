"""What a computer in lockstep has around it: clocks that may be wrong, and a Wi-Fi that delays and loses. Pure."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING, TypeVar

from fog_contracts.handlers import Moment

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from fog_contracts.handlers import Handler, Publication, QueryHandler

    Arrival = Callable[[Moment], Sequence[Publication]]
    R = TypeVar("R")


class _Drift:
    """By how much a clock is ahead."""

    def __init__(self) -> None:
        self._rate = self._gained = self._since = 0.0

    def ahead(self, now: float) -> float:
        return self._gained + self._rate * (now - self._since)

    def change(self, now: float, jump_s: float, rate: float) -> None:
        self._gained, self._since, self._rate = self.ahead(now) + jump_s, now, rate


class ComputerClock:
    """A computer's two clocks: call it with the true time, to get what they show.

    The wall clock may jump and be slewed. What counts intervals runs as its crystal does, a little too fast or slow.
    """

    def __init__(self) -> None:
        self._crystal = _Drift()
        self._wall = _Drift()
        self._true = True
        """Whether neither was ever changed."""

    def __call__(self, at: Moment) -> Moment:
        """Return what its clocks show."""
        if self._true:
            return at
        counted, shown = self._crystal.ahead(at.now), self._wall.ahead(at.now)
        return Moment(at.now + counted, at.stamp + shown, at.synchronized, at.clock)

    def ahead(self, now: float) -> float:
        """Return by how much (s) the wall clock is ahead at the true time `now`."""
        return self._wall.ahead(now)

    def change(self, now: float, *, jump_s: float = 0.0, rate: float = 0.0, crystal: float = 0.0) -> None:
        """Set the wall clock forward; from now on it gains `rate` seconds a second, the other clock `crystal`."""
        self._true = False
        self._wall.change(now, jump_s, rate)
        self._crystal.change(now, 0.0, crystal)

    def heard(self, handler: Handler) -> Handler:
        """Return a handler that is given what the clocks show, for one of messages."""
        return lambda ids, message, at: handler(ids, message, self(at))

    def asked(self, handler: QueryHandler) -> QueryHandler:
        """Return a handler that is given what the clocks show, for one of queries."""
        return lambda ids, request, at: handler(ids, request, self(at))


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
