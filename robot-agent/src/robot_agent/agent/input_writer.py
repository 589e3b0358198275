"""Writes the agent's input log on a thread of its own: a slow or full disk costs entries, never the robot's time."""

from __future__ import annotations

import threading
import time
from contextlib import contextmanager, suppress
from queue import SimpleQueue
from typing import TYPE_CHECKING, Final, Self

from prometheus_client import Counter

from fog_runtime import logs
from fog_runtime.record import Recorder
from robot_agent.agent.core import AgentCore
from robot_agent.agent.input_log import TOPIC_OF_ENTRY, EntriesLost, LoggedAgent

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from robot_agent.agent.input_log import Entry
    from robot_agent.config import AgentConfig

_WAITING_MOST: Final = 20_000
"""Entries that may wait for the disk: about a minute's."""
_CLOSE_S: Final = 5.0

LOST = Counter("fognav_input_log_lost_total", "Inputs and outputs of the agent that its input log could not take")

_log = logs.get("input_log")


class InputWriter:
    """Takes entries on the loop's thread, and writes them on another; a context manager."""

    def __init__(self, path: Path, *, waiting_most: int = _WAITING_MOST) -> None:
        """Begin a new log at `path`; one of an earlier run is kept as `NAME.previous.SUFFIX`. Raises `OSError`."""
        if path.is_file():
            path.replace(path.with_suffix(f".previous{path.suffix}"))
        self._path = path
        self._recorder: Recorder | None = Recorder(path)
        self._waiting_most = waiting_most
        self._queue: SimpleQueue[tuple[Entry, int] | None] = SimpleQueue()
        self._missing = 0
        self._thread = threading.Thread(target=self._run, name="input log", daemon=True)
        self._thread.start()
        _log.info("input_log", path=str(path))

    def write(self, entry: Entry) -> None:
        """Have an entry written; never blocks. What finds the queue full is counted and lost."""
        now_ns = time.time_ns()
        if self._queue.qsize() >= self._waiting_most:
            if self._missing == 0:
                _log.error("input_log_too_slow", path=str(self._path), remedy="write it to a faster disk")
            self._missing += 1
            LOST.inc()
            return
        if self._missing:
            self._queue.put((EntriesLost(count=self._missing), now_ns))
            self._missing = 0
        self._queue.put((entry, now_ns))

    def close(self) -> None:
        """Write what waits, and end the file."""
        self._queue.put(None)
        self._thread.join(_CLOSE_S)
        if self._thread.is_alive():
            _log.error("input_log_unfinished", path=str(self._path), waiting=self._queue.qsize())

    def _run(self) -> None:
        while (item := self._queue.get()) is not None:
            entry, at_ns = item
            if self._recorder is None:
                LOST.inc()
                continue
            try:
                self._recorder.write_entry(TOPIC_OF_ENTRY[type(entry)], entry, at_ns)
            except OSError as error:
                LOST.inc()
                self._give_up(error)
        if self._recorder is not None:
            try:
                self._recorder.close()
            except OSError as error:
                self._report(error)

    def _give_up(self, error: OSError) -> None:
        """Write nothing more: what follows a hole can't be replayed."""
        self._report(error)
        recorder, self._recorder = self._recorder, None
        if recorder is not None:
            with suppress(OSError):  # the same again: it has been reported
                recorder.close()

    def _report(self, error: OSError) -> None:
        reason = error.strerror or str(error)
        _log.error("input_log_ended", path=str(self._path), reason=reason, remedy="make room, and restart the agent")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextmanager
def open_core(config: AgentConfig, seed: int, input_log: Path | None) -> Iterator[AgentCore]:
    """Yield the agent's core, one that logs its inputs to a file if there is one; the file ends with the context.

    A log that can't be begun is reported, and the robot does without.
    """
    writer = None
    if input_log is not None:
        try:
            writer = InputWriter(input_log)
        except OSError as error:
            _log.error("input_log_not_begun", path=str(input_log), reason=error.strerror or str(error))
    if writer is None:
        yield AgentCore(config, seed)
        return
    with writer:
        yield LoggedAgent(config, seed, writer.write)
