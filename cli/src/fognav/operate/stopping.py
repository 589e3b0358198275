"""An operator's stop of a robot: by each way to it, again and again, until one of them is through."""

import asyncio
import contextlib
import http.client
import threading
import time
from collections.abc import Callable
from queue import Empty, SimpleQueue
from typing import Final

import msgspec

from fog_runtime import logs
from fognav.operate import rest_commands
from fognav.operate.fog import Fog, RefusedError
from fognav.operate.outcome import Outcome
from fognav.output import FailedError, WrongUseError

TELL_S: Final = 0.7
"""After this time an operator is told that the robot has not been reached yet: within a second, with its delays."""
GIVE_UP_S: Final = 60.0
RETRY_S: Final = 0.2
_HEAD_START_S: Final = 0.3
"""How long the direct way is tried alone: the planner is asked sooner only where that fails."""
_CLOSE_S: Final = 1.0
"""How long a session may take to close once the robot has been stopped by the other way."""
_LATER: Final = {http.client.REQUEST_TIMEOUT, http.client.TOO_EARLY, http.client.TOO_MANY_REQUESTS}
"""Refusals of now, not of the request."""

_Attempt = Callable[[], Outcome]


class _Replied(msgspec.Struct, frozen=True):
    """The robot has replied; only its mode is still waited for."""


def stop(fog: Fog, chosen: str | None, tell: Callable[[str], None]) -> Outcome:
    """Stop a robot (the chosen one, or the only one), directly or through the planner; neither needs key or token.

    While both ways fail they are tried again for `GIVE_UP_S`, and `tell` is given the reasons within a second.
    Raises `FailedError` then, or at once when the robot can't be reached directly and the planner refuses such a
    request for good; `WrongUseError` where there is a choice of robots.
    """
    logs.configure("fognav", "error", "text")
    return _Stop(fog, chosen, tell).run()


class _Stop:
    def __init__(self, fog: Fog, chosen: str | None, tell: Callable[[str], None]) -> None:
        self._fog = fog
        self._chosen = chosen
        self._tell = tell
        self._results: SimpleQueue[tuple[str, Outcome | _Replied | FailedError | WrongUseError]] = SimpleQueue()
        self._over = threading.Event()
        self._direct_failed = threading.Event()
        self._running: tuple[asyncio.AbstractEventLoop, asyncio.Task[Outcome]] | None = None

    def run(self) -> Outcome:
        # Threads that a hanging server holds must not hold the command: they end with it.
        direct = threading.Thread(target=self._keep_trying, args=("direct", self._direct), daemon=True)
        planner = threading.Thread(target=self._keep_trying, args=("planner", self._by_planner), daemon=True)
        direct.start()
        planner.start()
        try:
            return self._first()
        finally:
            self._over.set()
            if self._running is not None:
                loop, task = self._running
                with contextlib.suppress(RuntimeError):  # the loop has ended meanwhile
                    loop.call_soon_threadsafe(task.cancel)
            direct.join(_CLOSE_S)

    def _first(self) -> Outcome:
        """Return the first outcome of a way."""
        begun = time.monotonic()
        failures: dict[str, FailedError] = {}
        told = False
        while True:
            passed = time.monotonic() - begun
            try:
                way, result = self._results.get(timeout=max(0.0, (GIVE_UP_S if told else TELL_S) - passed))
            except Empty:
                if told:
                    raise FailedError(f"{self._name} is not known to have stopped: {_reasons(failures)}") from None
                told = True
                self._tell(
                    f"{self._name} is not known to have stopped yet: {_reasons(failures)}. Trying again for "
                    f"{GIVE_UP_S:.0f} s; Ctrl-C ends it"
                )
                continue
            if isinstance(result, Outcome):
                return result
            if isinstance(result, WrongUseError):
                raise result
            if isinstance(result, _Replied):
                told = True
                continue
            failures[way] = result
            if len(failures) > 1 and _for_good(failures["planner"]):
                raise FailedError(_reasons(failures))

    @property
    def _name(self) -> str:
        return "the robot" if self._chosen is None else f"robot {self._chosen}"

    def _keep_trying(self, way: str, attempt: _Attempt) -> None:
        if way == "planner":
            self._direct_failed.wait(_HEAD_START_S)
        while not self._over.is_set():
            try:
                outcome = attempt()
            except WrongUseError as error:
                self._results.put((way, error))
                return
            except asyncio.CancelledError:
                return
            except FailedError as error:
                self._results.put((way, error))
                if way == "direct":
                    self._direct_failed.set()
                elif _for_good(error):
                    return
            else:
                self._results.put((way, outcome))
                return
            self._over.wait(RETRY_S)

    def _by_planner(self) -> Outcome:
        return rest_commands.stop(self._fog, self._fog.robot(self._chosen))

    def _direct(self) -> Outcome:
        return asyncio.run(self._send(self._fog.robot(self._chosen)))

    async def _send(self, robot: str) -> Outcome:
        from fognav.operate.robots import connect  # noqa: PLC0415  # zenoh: keeps the other commands fast

        task = asyncio.current_task()
        assert task is not None
        self._running = asyncio.get_running_loop(), task
        try:
            async with connect(self._fog, robot) as connected:
                return await connected.stop(on_reply=self._replied)
        finally:
            self._running = None

    def _replied(self) -> None:
        self._results.put(("direct", _Replied()))


def _for_good(error: FailedError) -> bool:
    return isinstance(error, RefusedError) and 400 <= error.status < 500 and error.status not in _LATER


def _reasons(failures: dict[str, FailedError]) -> str:
    return "; ".join(str(failures[way]) for way in ("direct", "planner") if way in failures) or "nothing has answered"
