"""A compacted log of events: of each thing its last state, in the order of the last changes. Pure.

A reader has read up to a revision. It gets each entry with a higher one, in order; an entry that changes before that
is got once, as it is then. So the first state, what follows, what a slow reader gets, and what a reader gets that comes
back are the same. What is removed stays, as such, for a while. A reader that was away for longer, or has read
another run's log, must drop what it has.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, NamedTuple

if TYPE_CHECKING:
    from collections.abc import Iterator

KEEP_REMOVED_S: Final = 300.0
"""For how long (s) it is known that something was removed."""
_POSITION: Final = re.compile(r"([0-9a-z]{1,32})\.([0-9]{1,18})")

Key = tuple[str, str]
"""The event's name, and the id of what it is about."""


@dataclass(frozen=True, slots=True)
class Entry:
    """The state of one thing: its `data` (JSON), and as it is sent (`frame`); `removed_at`: since when it is gone."""

    key: Key
    revision: int
    data: bytes
    frame: bytes
    removed_at: float | None


class Batch(NamedTuple):
    """Entries as they are sent, and the revision up to which a reader has read with them."""

    frames: bytes
    position: int


def frame(event: str, data: bytes, position: str = "") -> bytes:
    """Return an event as it is sent (Server-sent events, WHATWG HTML 9.2); `data` is JSON in one line."""
    head = f"id: {position}\nevent: {event}\n" if position else f"event: {event}\n"
    return head.encode() + b"data: " + data + b"\n\n"


class CompactedLog:
    """The last state of each thing; times are in s of one clock."""

    def __init__(self, run: str) -> None:
        """Start an empty log; `run` (0-9, a-z) is another one at each start of the process."""
        self.run = run
        self.revision = 0
        """Of the last change."""
        self._entries: dict[Key, Entry] = {}
        """In the order of their revisions."""
        self._removed: dict[Key, None] = {}
        self.begun = 0
        """How often the log began anew."""
        self._pruned = 0
        """The highest revision of an entry that was forgotten after its removal."""

    def put(self, event: str, thing: str, data: bytes) -> bool:
        """Set a thing's state; return whether it has changed."""
        known = self._entries.get((event, thing))
        if known is not None and known.data == data:
            return False
        self._write((event, thing), data, None)
        return True

    def remove(self, event: str, thing: str, data: bytes, now: float) -> bool:
        """Set what says that a thing is gone; return whether it was there."""
        known = self._entries.get((event, thing))
        if known is None or known.removed_at is not None:
            return False
        self._write((event, thing), data, now)
        return True

    def forget(self, event: str, thing: str) -> None:
        """Leave a thing out from now on without telling anybody: it is history, which readers may keep."""
        self._entries.pop((event, thing), None)
        self._removed.pop((event, thing), None)

    def begin_anew(self) -> None:
        """Have every reader drop what it has: what was forgotten is wrong from now on."""
        self.begun += 1
        self.revision += 1
        self._pruned = self.revision

    def prune(self, now: float) -> None:
        """Forget what was removed long ago."""
        for key in list(self._removed):  # the oldest first
            entry = self._entries[key]
            assert entry.removed_at is not None
            if now - entry.removed_at < KEEP_REMOVED_S:
                return
            self._pruned = max(self._pruned, entry.revision)
            del self._entries[key], self._removed[key]

    def _write(self, key: Key, data: bytes, removed_at: float | None) -> None:
        self._entries.pop(key, None)
        self._removed.pop(key, None)
        self.revision += 1
        framed = frame(key[0], data, f"{self.run}.{self.revision}")
        self._entries[key] = Entry(key, self.revision, data, framed, removed_at)
        if removed_at is not None:
            self._removed[key] = None

    def resume(self, last_id: str | None) -> int | None:
        """Return up to where a reader with this last id has read; None: it must drop what it has, and begin anew."""
        found = _POSITION.fullmatch(last_id or "")
        if found is None or found[1] != self.run:
            return None
        position = int(found[2])
        return None if self.is_lost(position) or position > self.revision else position

    def is_lost(self, position: int) -> bool:
        """Whether a reader that has read up to there has missed a removal that nobody knows any more."""
        return 0 < position < self._pruned

    def after(self, position: int) -> Iterator[Entry]:
        """Yield the entries that changed after a revision, the newest first."""
        for entry in reversed(self._entries.values()):
            if entry.revision <= position:
                return
            yield entry

    def read(self, position: int, limit: int) -> Batch:
        """Return what follows a revision, oldest first, up to the entry that reaches `limit` bytes."""
        frames: list[bytes] = []
        size = 0
        for entry in reversed(list(self.after(position))):
            frames.append(entry.frame)
            size += len(entry.frame)
            if size >= limit:
                return Batch(b"".join(frames), entry.revision)
        return Batch(b"".join(frames), max(position, self.revision))

    def things(self, event: str) -> list[str]:
        """Return the ids of what there is of one kind."""
        return [thing for (name, thing), entry in self._entries.items() if name == event and entry.removed_at is None]

    def data(self, event: str, thing: str) -> bytes | None:
        """Return a thing's state; None if there is none."""
        known = self._entries.get((event, thing))
        return None if known is None or known.removed_at is not None else known.data
