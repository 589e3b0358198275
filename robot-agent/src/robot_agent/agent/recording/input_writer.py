"""Writes the agent's input log on its own thread: a slow or full disk loses entries, but never delays the robot."""

from __future__ import annotations

import threading
import time
from contextlib import contextmanager, suppress
from queue import SimpleQueue
from typing import TYPE_CHECKING, Final, Self

from prometheus_client import Counter

from fog_runtime import logs
from robot_agent import registry
from robot_agent.agent.core import AgentCore
from robot_agent.agent.recording.input_log import TOPIC_OF_ENTRY, EntriesLost, LoggedAgent

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from fog_runtime.record import Recorder
    from robot_agent.agent.recording.input_log import Entry
    from robot_agent.config import AgentConfig

_QUEUE_LIMIT: Final = 20_000
"""Entries that may wait for the disk: about those of a minute."""
_CLOSE_S: Final = 5.0

LOST = Counter(
    "fognav_input_log_lost_entries_total", "Inputs and outputs of the agent that were not written to its input log"
)

_log = logs.get("input_log")


class InputWriter:
    """Queues entries on the loop's thread and writes them on its own; a context manager."""

    def __init__(self, path: Path, *, queue_limit: int = _QUEUE_LIMIT) -> None:
        """Begin a new log at `path`; one of an earlier run is kept as `NAME.previous.SUFFIX`. Raises `OSError`."""
        from fog_runtime.record import Recorder  # noqa: PLC0415  # most robots keep no log, and start without its library

        if path.is_file():
            path.replace(path.with_suffix(f".previous{path.suffix}"))
        self._path = path
        self._recorder: Recorder | None = Recorder(path)
        self._waiting_most = queue_limit
        self._queue: SimpleQueue[tuple[Entry, int] | None] = SimpleQueue()
        self._missing = 0
        self._thread = threading.Thread(target=self._run, name="input log", daemon=True)
        self._thread.start()
        _log.info("input_log_opened", path=str(path))

    def write(self, entry: Entry) -> None:
        """Queue an entry for writing; never blocks. With a full queue the entry is lost and counted."""
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
        """Write the queued entries, and close the file."""
        self._queue.put(None)
        self._thread.join(_CLOSE_S)
        if self._thread.is_alive():
            _log.error("input_log_unfinished", path=str(self._path), queued=self._queue.qsize())

    def _run(self) -> None:
        while (item := self._queue.get()) is not None:
            entry, log_time_ns = item
            if self._recorder is None:
                LOST.inc()
                continue
            try:
                self._recorder.write_entry(TOPIC_OF_ENTRY[type(entry)], entry, log_time_ns)
            except Exception as error:  # noqa: BLE001  # no entry may end the thread in silence
                LOST.inc()
                self._give_up(error)
        if self._recorder is not None:
            try:
                self._recorder.close()
            except OSError as error:
                self._report(error)

    def _give_up(self, error: Exception) -> None:
        """Write nothing more: entries after a gap can't be replayed."""
        self._report(error)
        recorder, self._recorder = self._recorder, None
        if recorder is not None:
            with suppress(OSError):  # the same error again, already reported
                recorder.close()

    def _report(self, error: Exception) -> None:
        no_room = isinstance(error, OSError)
        reason = (error.strerror if isinstance(error, OSError) else None) or f"{type(error).__name__}: {error}"
        remedy = "make room, and restart the agent" if no_room else "report this bug: the entry can't be written"
        _log.error("input_log_ended", path=str(self._path), reason=reason, remedy=remedy)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@contextmanager
def open_core(config: AgentConfig, seed: int, input_log: Path | None) -> Iterator[AgentCore]:
    """Yield the agent's core, which logs its inputs if a file is given; the file is closed with the context.

    If the file can't be opened, that is logged and the robot runs without an input log.
    """
    writer = None
    if input_log is not None:
        try:
            writer = InputWriter(input_log)
        except OSError as error:
            _log.error("input_log_not_opened", path=str(input_log), reason=error.strerror or str(error))
    if writer is None:
        yield AgentCore(config, seed, registry.profile)
        return
    with writer:
        yield LoggedAgent(config, seed, writer.write, registry.profile)
