"""Supervision of programs, as systemd does it: start, restart with backoff, end whole process groups."""

import asyncio
import contextlib
import os
import signal
import time
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Final, Literal, Self

from fog_supervisor import child

BACKOFF_MIN_S: Final = 0.2
BACKOFF_MAX_S: Final = 5.0
STABLE_S: Final = 10.0
"""A program that ran this long is restarted with the shortest delay."""
END_TIMEOUT_S: Final = 5.0
_LEFTOVERS_TIMEOUT_S: Final = 1.0
_POLL_S: Final = 0.05
_LOG_TAIL: Final = 15

EventKind = Literal["started", "exited", "stopped", "killed"]


@dataclass(frozen=True)
class Event:
    """A change of a program's state; `time_s` is in monotonic seconds."""

    program: str
    kind: EventKind
    detail: str
    time_s: float


class NotReadyError(RuntimeError):
    """A program was not ready in time; the message names it, what it waits for and the end of its log."""


async def always_ready() -> str | None:
    """Readiness check of a program without one."""
    return None


def _nothing() -> None:
    pass


@dataclass(frozen=True, kw_only=True)
class Program:
    """A program to run. `ready` returns what it still waits for, or None; `before` is called before each start.

    Programs with a higher `rank` are stopped first.
    """

    name: str
    arguments: tuple[str, ...]
    log: Path
    environment: Mapping[str, str] = field(default_factory=dict)
    ready: Callable[[], Awaitable[str | None]] = always_ready
    before: Callable[[], None] = _nothing
    rank: int = 0


class _Supervised:
    """A program with its process and the task that restarts it."""

    def __init__(self, program: Program) -> None:
        self.program = program
        self.wanted = False
        self.process: asyncio.subprocess.Process | None = None
        self.task: asyncio.Task[None] | None = None
        self.starts = 0
        self.last_exit = ""


async def launch(program: Program) -> asyncio.subprocess.Process:
    """Start a program in a session of its own; it ends with this process. Fognav's tests fork it instead."""
    with program.log.open("ab") as log:
        return await asyncio.create_subprocess_exec(
            *child.command(*program.arguments),
            stdin=asyncio.subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            env=dict(program.environment),
            start_new_session=True,
        )


def log_tail(path: Path, lines: int = _LOG_TAIL) -> str:
    """Return the last lines of a log file."""
    try:
        return "\n".join(path.read_text("utf-8", "replace").splitlines()[-lines:])
    except FileNotFoundError:
        return "(the log is empty)"


def _signal_name(number: int) -> str:
    """Return a signal's name; most real-time signals have none."""
    try:
        return signal.Signals(number).name
    except ValueError:
        return f"signal {number}"


def _signal_group(group: int, number: int) -> bool:
    """Send a signal to every process of a group; False when the group is empty."""
    try:
        os.killpg(group, number)
    except ProcessLookupError:
        return False
    return True


async def _end_leftovers(group: int) -> None:
    """End the processes that a group's leader left behind, as systemd does with a service's control group."""
    if not _signal_group(group, signal.SIGTERM):
        return
    deadline = time.monotonic() + _LEFTOVERS_TIMEOUT_S
    while time.monotonic() < deadline:
        if not _signal_group(group, 0):
            return
        await asyncio.sleep(_POLL_S)
    _signal_group(group, signal.SIGKILL)


class Supervisor:
    """Runs programs, each in its own process group; leaving the context stops them all.

    `on_event` is called on the loop's thread.
    """

    def __init__(self, on_event: Callable[[Event], None]) -> None:
        self._on_event = on_event
        self._programs: dict[str, _Supervised] = {}

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    def add(self, program: Program) -> None:
        """Add a program without starting it."""
        if program.name in self._programs:
            raise ValueError(f"there is already a program {program.name!r}")
        self._programs[program.name] = _Supervised(program)

    @property
    def names(self) -> list[str]:
        """The programs, in the order in which they were added."""
        return list(self._programs)

    def pid(self, name: str) -> int | None:
        """Process id of the running program, or None."""
        process = self._get(name).process
        return process.pid if process is not None else None

    def starts(self, name: str) -> int:
        """How often the program was started."""
        return self._get(name).starts

    def start(self, name: str) -> None:
        """Start the program and restart it whenever it exits; does nothing while it runs."""
        supervised = self._get(name)
        if supervised.task is None or supervised.task.done():
            supervised.wanted = True
            supervised.task = asyncio.create_task(self._supervise(supervised), name=f"supervise {name}")

    async def stop(self, name: str) -> None:
        """Stop the program with SIGTERM, after a timeout with SIGKILL; it is not restarted."""
        supervised = self._get(name)
        supervised.wanted = False
        if supervised.task is None:
            return
        if supervised.process is None:
            # It waits for its restart.
            supervised.task.cancel()
        else:
            _signal_group(supervised.process.pid, signal.SIGTERM)
            # A process that SIGSTOP has paused would never handle the signal.
            _signal_group(supervised.process.pid, signal.SIGCONT)
            await asyncio.wait({supervised.task}, timeout=END_TIMEOUT_S)
            if not supervised.task.done() and supervised.process is not None:
                _signal_group(supervised.process.pid, signal.SIGKILL)
        with contextlib.suppress(asyncio.CancelledError):
            await supervised.task
        supervised.task = None

    def kill(self, name: str, number: signal.Signals = signal.SIGKILL) -> int:
        """Send a signal to the program (not to its children) and return its pid; it is restarted if it exits."""
        supervised = self._get(name)
        if supervised.process is None:
            raise ProcessLookupError(f"{name} is not running")
        os.kill(supervised.process.pid, number)
        self._emit(supervised, "killed", f"sent {number.name} to pid {supervised.process.pid}")
        return supervised.process.pid

    async def restart(self, name: str) -> None:
        """Stop the program and start it again."""
        await self.stop(name)
        self.start(name)

    async def missing(self, names: Iterable[str]) -> dict[str, str]:
        """Return what each of the programs waits for, without those that are ready."""
        found = {}
        for name in names:
            supervised = self._get(name)
            reason = "it is not running" if supervised.process is None else await supervised.program.ready()
            if reason is not None:
                found[name] = reason
        return found

    async def wait_ready(self, names: Iterable[str], timeout_s: float) -> None:
        """Wait until the programs are ready; raises `NotReadyError` after `timeout_s` real seconds."""
        remaining = list(names)
        deadline = time.monotonic() + timeout_s
        while True:
            not_ready = await self.missing(remaining)
            if not not_ready:
                return
            remaining = list(not_ready)
            if time.monotonic() > deadline:
                raise NotReadyError("\n".join(self._not_ready_text(name, reason) for name, reason in not_ready.items()))
            await asyncio.sleep(_POLL_S)

    async def close(self) -> None:
        """Stop every program, those with a higher rank first."""
        for rank in sorted({supervised.program.rank for supervised in self._programs.values()}, reverse=True):
            names = [name for name, supervised in self._programs.items() if supervised.program.rank == rank]
            await asyncio.gather(*(self.stop(name) for name in names))

    async def _supervise(self, supervised: _Supervised) -> None:
        delay = BACKOFF_MIN_S
        while True:
            started = time.monotonic()
            try:
                process = await self._spawn(supervised)
            except OSError as error:  # no file descriptors left, no log folder: it may pass, as a crash may
                exit_text = f"could not be started: {error}"
            else:
                code = await process.wait()
                supervised.process = None
                await _end_leftovers(process.pid)
                exit_text = f"exit code {code}" if code >= 0 else f"ended by {_signal_name(-code)}"
            if not supervised.wanted:
                self._emit(supervised, "stopped", exit_text)
                return
            supervised.last_exit = exit_text
            delay = BACKOFF_MIN_S if time.monotonic() - started >= STABLE_S else min(delay, BACKOFF_MAX_S)
            self._emit(supervised, "exited", f"{exit_text}; restarting in {delay:.1f} s")
            await asyncio.sleep(delay)
            delay *= 2

    async def _spawn(self, supervised: _Supervised) -> asyncio.subprocess.Process:
        program = supervised.program
        program.before()
        process = await launch(program)
        supervised.process = process
        supervised.starts += 1
        self._emit(supervised, "started", f"pid {process.pid}")
        return process

    def _get(self, name: str) -> _Supervised:
        try:
            return self._programs[name]
        except KeyError:
            raise KeyError(f"there is no program {name!r}; use one of: {', '.join(self._programs)}") from None

    def _emit(self, supervised: _Supervised, kind: EventKind, detail: str) -> None:
        self._on_event(Event(supervised.program.name, kind, detail, time.monotonic()))

    def _not_ready_text(self, name: str, reason: str) -> str:
        supervised = self._get(name)
        restarts = (
            f" (started {supervised.starts} times; last exit: {supervised.last_exit})" if supervised.starts != 1 else ""
        )
        log = supervised.program.log
        return f"{name} is not ready: {reason}{restarts}. The end of {log}:\n{log_tail(log)}"
