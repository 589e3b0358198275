"""The last hour, in memory: what changed every 5 s, compressed, from which the state at any time is made. Pure.

A frame has the things that changed since the one before, as the log has them; the oldest one is preceded by the state
of that time. When the time or the memory is up, the oldest frame becomes part of that state.
"""

from __future__ import annotations

import zlib
from collections import deque
from typing import TYPE_CHECKING, Final, NamedTuple

import msgspec

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from console_service.log import CompactedLog, Key

STEP_S: Final = 5.0
KEEP_S: Final = 3600.0
MOST_BYTES: Final = 48 * 1024 * 1024
"""Of all frames, compressed, and the state before them."""
ANSWER_BYTES: Final = 4 * 1024 * 1024
"""An answer ends with the frame that reaches this size."""
LEFT_OUT: Final = frozenset({"record"})
"""What has a trail of its own."""

Change = tuple[str, str, bytes]
"""An event's name, the id of what it is about, and its data (JSON)."""


class Frame(NamedTuple):
    """What changed up to a time (s since the epoch), packed."""

    stamp: float
    packed: bytes


class Shown(NamedTuple):
    """Frames as they are answered, and where the next answer begins; None: there are no more."""

    frames: list[tuple[float, list[Change]]]
    next: float | None


class Recording:
    """The frames of one log."""

    def __init__(self) -> None:
        self._frames: deque[Frame] = deque()
        self._before: dict[Key, bytes] = {}
        """The state before the first frame."""
        self._size = 0
        self._revision = 0
        self._begun = 0

    @property
    def size(self) -> int:
        """The memory of all frames and of the state before them (bytes)."""
        return self._size

    @property
    def span(self) -> tuple[float, float] | None:
        """The times (s since the epoch) of the first and last frame; None without any."""
        return (self._frames[0].stamp, self._frames[-1].stamp) if self._frames else None

    def changes(self, log: CompactedLog) -> list[Change]:
        """Return what has changed since the last call; after a beginning of the log anew, everything."""
        if log.begun != self._begun:
            self._begun, self._revision = log.begun, 0
            self._frames.clear()
            self._before, self._size = {}, 0
        found = [(*entry.key, entry.data) for entry in log.after(self._revision) if entry.key[0] not in LEFT_OUT]
        self._revision = log.revision
        return found

    def add(self, frame: Frame) -> None:
        """Append a frame, and make room for it."""
        self._frames.append(frame)
        self._size += len(frame.packed)
        while len(self._frames) > 1 and (self._frames[0].stamp < frame.stamp - KEEP_S or self._size > MOST_BYTES):
            oldest = self._frames.popleft()
            self._size -= len(oldest.packed)
            for event, thing, data in unpack(oldest.packed):
                self._size += len(data) - len(self._before.get((event, thing), b""))
                self._before[event, thing] = data

    def copy(self) -> Recording:
        """Return a copy that another thread may read."""
        copied = Recording()
        copied._frames, copied._before = deque(self._frames), dict(self._before)
        return copied

    def show(self, begin: float, end: float, limit: int = ANSWER_BYTES) -> Shown:
        """Return the state at `begin` as one frame, then the frames up to `end`, up to about `limit` bytes.

        Before the first frame there is no state: it is that of the first frame then.
        """
        state = dict(self._before)
        frames: list[tuple[float, list[Change]]] = []
        size = 0
        for number, frame in enumerate(self._frames):
            if frame.stamp > end and number:
                break
            changes = list(unpack(frame.packed))
            if not frames:
                state.update({(event, thing): data for event, thing, data in changes})
                following = self._frames[number + 1].stamp if number + 1 < len(self._frames) else None
                if following is not None and following <= begin:
                    continue
                changes = [(event, thing, data) for (event, thing), data in state.items()]
            elif size >= limit:
                return Shown(frames, frame.stamp)
            frames.append((frame.stamp, changes))
            size += sum(len(data) for _, _, data in changes)
        return Shown(frames, None)


def pack(changes: list[Change]) -> bytes:
    """Return changes in less space."""
    return zlib.compress(msgspec.msgpack.encode(changes), 1)


def unpack(packed: bytes) -> Iterator[Change]:
    """Yield what was packed."""
    yield from msgspec.msgpack.decode(zlib.decompress(packed), type=list[Change])


def as_json(shown: Shown) -> Iterable[bytes]:
    """Yield the parts of a JSON array of frames: `{stamp, events: [{event, data}]}`."""
    for number, (stamp, changes) in enumerate(shown.frames):
        events = b",".join(b'{"event":"%b","data":%b}' % (event.encode(), data) for event, _, data in changes)
        yield (b"," if number else b"") + b'{"stamp":%.3f,"events":[%b]}' % (stamp, events)
