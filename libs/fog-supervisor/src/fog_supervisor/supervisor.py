"""Keeps programs running as systemd or a container engine would: starts, restarts with backoff, ends all of a group."""

import asyncio
import contextlib
import os
import signal
import sys
import time
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Final, Literal, Self

_CHILD: Final = Path(__file__).with_name("child.py")
BACKOFF_MIN_S: Final = 0.2
BACKOFF_MAX_S: Final = 5.0
STABLE_S: Final = 10.0
"""A program that ran this long starts again with the shortest delay."""
END_TIMEOUT_S: Final = 5.0
_SWEEP_TIMEOUT_S: Final = 1.0
_POLL_S: Final = 0.05
_LOG_TAIL: Final = 15

What = Literal["started", "died", "stopped", "killed"]


@dataclass(frozen=True)
class Event:
    """Something that happened to a program; `at` is in monotonic seconds."""

    program: str
    what: What
    detail: str
    at: float


class NotReadyError(RuntimeError):
    """A program did not get ready in time; the message names it, what it misses and the end of its log."""


async def always_ready() -> str | None:
    """Readiness of a program that has none."""
    return None


def _nothing() -> None:
    pass


@dataclass(frozen=True, kw_only=True)
class Program:
    """What to run. `ready` says what is still missing, or None; `before` runs before each start.

    Programs of a higher `rank` are ended first.
    """

    name: str
    arguments: tuple[str, ...]
    log: Path
    environment: Mapping[str, str] = field(default_factory=dict)
    ready: Callable[[], Awaitable[str | None]] = always_ready
    before: Callable[[], None] = _nothing
    rank: int = 0


class _Kept:
    """A program with its life."""

    def __init__(self, program: Program) -> None:
        self.program = program
        self.wanted = False
        self.process: asyncio.subprocess.Process | None = None
        self.task: asyncio.Task[None] | None = None
        self.starts = 0
        self.why = ""


def log_tail(path: Path, lines: int = _LOG_TAIL) -> str:
    """Return the last lines of a log, for messages."""
    try:
        return "\n".join(path.read_text("utf-8", "replace").splitlines()[-lines:])
    except FileNotFoundError:
        return "(it logged nothing)"


def _signal_group(group: int, number: int) -> bool:
    """Send a signal to every process of a group; False when it has none left."""
    try:
        os.killpg(group, number)
    except ProcessLookupError:
        return False
    return True


async def _end_leftovers(group: int) -> None:
    """End what the leader of a group left behind, as systemd does with a service's control group."""
    if not _signal_group(group, signal.SIGTERM):
        return
    deadline = time.monotonic() + _SWEEP_TIMEOUT_S
    while time.monotonic() < deadline:
        if not _signal_group(group, 0):
            return
        await asyncio.sleep(_POLL_S)
    _signal_group(group, signal.SIGKILL)


class Supervisor:
    """Runs programs, each in a process group of its own; leaving the context ends them all.

    `on_event` is called on the loop's thread.
    """

    def __init__(self, on_event: Callable[[Event], None]) -> None:
        self._on_event = on_event
        self._kept: dict[str, _Kept] = {}

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    def add(self, program: Program) -> None:
        """Make a program known; it does not run yet."""
        if program.name in self._kept:
            raise ValueError(f"there is a program {program.name} already")
        self._kept[program.name] = _Kept(program)

    @property
    def names(self) -> list[str]:
        """The programs, in the order in which they were added."""
        return list(self._kept)

    def pid(self, name: str) -> int | None:
        """Process id of the running program, or None."""
        process = self._of(name).process
        return process.pid if process is not None else None

    def starts(self, name: str) -> int:
        """How often the program was started."""
        return self._of(name).starts

    def start(self, name: str) -> None:
        """Run the program from now on, and again whenever it ends; nothing happens when it runs already."""
        kept = self._of(name)
        if kept.task is None or kept.task.done():
            kept.wanted = True
            kept.task = asyncio.create_task(self._keep(kept), name=f"keep {name}")

    async def stop(self, name: str) -> None:
        """End the program with SIGTERM, then with SIGKILL; it stays stopped."""
        kept = self._of(name)
        kept.wanted = False
        if kept.task is None:
            return
        if kept.process is None:
            # It waits for its next start.
            kept.task.cancel()
        else:
            _signal_group(kept.process.pid, signal.SIGTERM)
            # A stopped process (SIGSTOP) would never see the signal.
            _signal_group(kept.process.pid, signal.SIGCONT)
            await asyncio.wait({kept.task}, timeout=END_TIMEOUT_S)
            if not kept.task.done() and kept.process is not None:
                _signal_group(kept.process.pid, signal.SIGKILL)
        with contextlib.suppress(asyncio.CancelledError):
            await kept.task
        kept.task = None

    def kill(self, name: str, number: signal.Signals = signal.SIGKILL) -> int:
        """Send a signal to the program itself (not to its children) and return its pid; if it dies it is restarted."""
        kept = self._of(name)
        if kept.process is None:
            raise ProcessLookupError(f"{name} does not run")
        os.kill(kept.process.pid, number)
        self._say(kept, "killed", f"sent {number.name} to pid {kept.process.pid}")
        return kept.process.pid

    async def restart(self, name: str) -> None:
        """Stop the program and start it again."""
        await self.stop(name)
        self.start(name)

    async def missing(self, names: Iterable[str]) -> dict[str, str]:
        """Return what each of the programs still misses; those that are ready are left out."""
        found = {}
        for name in names:
            kept = self._of(name)
            why = "it does not run" if kept.process is None else await kept.program.ready()
            if why is not None:
                found[name] = why
        return found

    async def wait_ready(self, names: Iterable[str], timeout_s: float) -> None:
        """Wait until the programs are ready; raises `NotReadyError` when the time (real seconds) is over."""
        left = list(names)
        deadline = time.monotonic() + timeout_s
        while True:
            found = await self.missing(left)
            if not found:
                return
            left = list(found)
            if time.monotonic() > deadline:
                raise NotReadyError("\n".join(self._complaint(name, why) for name, why in found.items()))
            await asyncio.sleep(_POLL_S)

    async def close(self) -> None:
        """End every program, those of a higher rank first."""
        for rank in sorted({kept.program.rank for kept in self._kept.values()}, reverse=True):
            same = [name for name, kept in self._kept.items() if kept.program.rank == rank]
            await asyncio.gather(*(self.stop(name) for name in same))

    async def _keep(self, kept: _Kept) -> None:
        delay = BACKOFF_MIN_S
        while True:
            begun = time.monotonic()
            process = await self._spawn(kept)
            code = await process.wait()
            kept.process = None
            await _end_leftovers(process.pid)
            how = f"exit code {code}" if code >= 0 else f"ended by {signal.Signals(-code).name}"
            if not kept.wanted:
                self._say(kept, "stopped", how)
                return
            kept.why = how
            delay = BACKOFF_MIN_S if time.monotonic() - begun >= STABLE_S else min(delay, BACKOFF_MAX_S)
            self._say(kept, "died", f"{how}; starting again in {delay:.1f} s")
            await asyncio.sleep(delay)
            delay *= 2

    async def _spawn(self, kept: _Kept) -> asyncio.subprocess.Process:
        program = kept.program
        program.before()
        with program.log.open("ab") as log:
            process = await asyncio.create_subprocess_exec(
                sys.executable,
                "-I",
                "-S",
                str(_CHILD),
                str(os.getpid()),
                *program.arguments,
                stdin=asyncio.subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                env=dict(program.environment),
                start_new_session=True,
            )
        kept.process = process
        kept.starts += 1
        self._say(kept, "started", f"pid {process.pid}")
        return process

    def _of(self, name: str) -> _Kept:
        try:
            return self._kept[name]
        except KeyError:
            raise KeyError(f"there is no program {name!r}; there are {', '.join(self._kept)}") from None

    def _say(self, kept: _Kept, what: What, detail: str) -> None:
        self._on_event(Event(kept.program.name, what, detail, time.monotonic()))

    def _complaint(self, name: str, why: str) -> str:
        kept = self._of(name)
        ended = f" (it was started {kept.starts} times; last: {kept.why})" if kept.starts > 1 else ""
        return f"{name} is not ready: {why}{ended}. The end of {kept.program.log}:\n{log_tail(kept.program.log)}"
