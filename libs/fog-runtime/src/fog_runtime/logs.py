"""Structured logs: one event per line on standard error, as JSON or as text for people.

An event's name is a noun and what happened to it: `message_refused`, `broker_connected`; details are its fields.
"""

import json
import logging
import sys
import threading
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from typing import Final, Literal

Format = Literal["json", "text"]
Level = Literal["debug", "info", "warning", "error"]

_FIELDS: Final = "fognav_fields"


class Log:
    """A named logger whose lines are an event's name and its fields: `log.info("listening", port=8080)`."""

    def __init__(self, name: str) -> None:
        self._logger = logging.getLogger(name)

    def debug(self, event: str, **fields: object) -> None:
        """Log a detail for developers."""
        self._emit(logging.DEBUG, event, fields)

    def info(self, event: str, **fields: object) -> None:
        """Log an event of normal operation."""
        self._emit(logging.INFO, event, fields)

    def warning(self, event: str, **fields: object) -> None:
        """Log an event that needs attention."""
        self._emit(logging.WARNING, event, fields)

    def error(self, event: str, *, error: BaseException | None = None, **fields: object) -> None:
        """Log a failure; `error` adds the exception with its traceback."""
        self._emit(logging.ERROR, event, fields, error)

    def _emit(self, level: int, event: str, fields: Mapping[str, object], error: BaseException | None = None) -> None:
        if self._logger.isEnabledFor(level):
            # "%s", because an event with a percent sign would be taken for a format.
            self._logger.log(level, "%s", event, extra={_FIELDS: dict(fields)}, exc_info=error)


class _Formatter(logging.Formatter):
    def __init__(self, process: str) -> None:
        super().__init__()
        self._process = process

    def record(self, record: logging.LogRecord) -> dict[str, object]:
        """Return the fields of a line."""
        fields: dict[str, object] = {
            "ts": datetime.fromtimestamp(record.created, UTC).isoformat(timespec="milliseconds"),
            "level": record.levelname.lower(),
            "process": self._process,
            "logger": record.name,
            "event": record.getMessage(),
        }
        extra = getattr(record, _FIELDS, {})
        fields.update({(f"{name}_" if name in fields else name): value for name, value in extra.items()})
        if record.exc_info and record.exc_info[1] is not None:
            fields["error"] = f"{type(record.exc_info[1]).__name__}: {record.exc_info[1]}"
            fields["traceback"] = self.formatException(record.exc_info)
        return fields


class _JsonFormatter(_Formatter):
    def format(self, record: logging.LogRecord) -> str:
        return json.dumps(self.record(record), default=str, ensure_ascii=False)


class _TextFormatter(_Formatter):
    def format(self, record: logging.LogRecord) -> str:
        fields = self.record(record)
        trace = fields.pop("traceback", None)
        head = f"{str(fields.pop('ts'))[11:23]} {fields.pop('level')!s:7} {fields.pop('process')}"
        logger, event = fields.pop("logger"), fields.pop("event")
        rest = " ".join(f"{name}={value}" for name, value in fields.items())
        line = f"{head} {logger}: {event} {rest}".rstrip()
        return f"{line}\n{trace}" if trace else line


def configure(process: str, level: Level = "info", fmt: Format = "json") -> None:
    """Send all logs of this process, including those of libraries, to standard error; call once, at the start."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_JsonFormatter(process) if fmt == "json" else _TextFormatter(process))
    root = logging.getLogger()
    root.handlers[:] = [handler]
    root.setLevel(level.upper())
    # Libraries log normal operation at info level; only their warnings and errors belong into our events.
    for name in ("mqtt", "uvicorn", "asyncio", "httpx", "httpcore"):
        logging.getLogger(name).setLevel(max(logging.WARNING, root.level))


def get(name: str) -> Log:
    """Return the logger of a module or part."""
    return Log(name)


class RateLimited:
    """Logs the first of equal events at once, then at most one per `period` seconds with the number suppressed.

    Distinguishes at most `max_keys` keys, so that a sender of ever new ones can't exhaust the memory.
    """

    def __init__(self, log: Log, period: float = 10.0, max_keys: int = 1000) -> None:
        self._log = log
        self._period = period
        self._max_keys = max_keys
        self._state: dict[str, tuple[float, int]] = {}
        self._lock = threading.Lock()

    def warning(self, event: str, key: str, now: float, /, **fields: object) -> None:
        """Log `event` unless the same `key` was logged less than a period before `now` (s); from any thread."""
        self._limit(self._log.warning, event, key, now, fields)

    def info(self, event: str, key: str, now: float, /, **fields: object) -> None:
        """Log an event of normal operation, which others can cause at any rate, as `warning` does."""
        self._limit(self._log.info, event, key, now, fields)

    def _limit(self, log: Callable[..., None], event: str, key: str, now: float, fields: dict[str, object]) -> None:
        with self._lock:
            if key not in self._state and len(self._state) >= self._max_keys:
                key = "(others)"
            logged_at, suppressed = self._state.get(key, (None, 0))
            if logged_at is not None and now - logged_at < self._period:
                self._state[key] = (logged_at, suppressed + 1)
                return
            self._state[key] = (now, 0)
        if suppressed:
            fields["suppressed"] = suppressed
        log(event, **fields)
