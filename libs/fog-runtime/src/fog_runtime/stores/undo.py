"""Which change an operator may undo: one in the audit trail after which nobody has changed the same record."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final, Literal, TypeVar

import msgspec

from fog_runtime.stores.records import OWN, AuditEntry, entry_at, newer_entries

if TYPE_CHECKING:
    from collections.abc import Sequence

    from fog_contracts.messages import Message
    from fog_runtime.stores.redis_connection import RedisConnection

M = TypeVar("M", bound="Message")

ACTION: Final = "undo"
"""The action of an undo in the audit trail, which can be undone itself."""
MOST_READ: Final = 5_000
"""So many entries of the audit trail are read for one undo; what was changed before them is too old."""
COMMANDS: Final = ("robot", "stop")
"""Kinds of entries that tell of a command, which a robot has carried out."""
_BY_ITSELF: Final = frozenset({"reached", "end"})
"""Actions that nobody has decided: a goal was reached, the time of an override was over."""


class UndoError(Exception):
    """A change can't be undone; `later` is what somebody has changed since, if that is why."""

    def __init__(
        self,
        code: Literal["no_entry", "not_undoable", "changed_since"],
        text: str,
        later: AuditEntry | None = None,
    ) -> None:
        super().__init__(text)
        self.code = code
        self.later = later


async def undoable(redis: RedisConnection, prefix: str, name: str, record: str, kinds: Sequence[str]) -> AuditEntry:
    """Return the entry of this name, if it is the latest change of the record and can be undone.

    `kinds` are those of the service's own entries; the streams' keys begin with `prefix`. Raises `UndoError` and
    `StoreError`.
    """
    kind = name.rpartition(".")[2]
    found = await entry_at(redis, prefix, name) if kind in (*kinds, *COMMANDS) else None
    if found is None or found.id != record:
        raise UndoError("no_entry", f"the audit trail has no entry {name} of {record}: GET /api/v1/audit lists entries")
    if kind in COMMANDS:
        what = f"{found.action} was a command, which {record} has carried out"
        raise UndoError("not_undoable", f"{what}: commands can't be undone, send the robot another one")
    if found.action in _BY_ITSELF or found.who in OWN:
        raise UndoError(
            "not_undoable", f"{found.action} by {found.who} was nobody's decision: there is nothing to undo"
        )
    read = 0
    async for entry in newer_entries(redis, prefix, name):
        read += 1
        if entry.id == record and entry.entry != name:
            when = datetime.fromtimestamp(entry.at, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
            what = f"{entry.who} has changed {record} since ({entry.action}, {when})"
            raise UndoError("changed_since", f"{what}: undo that first, or change it by hand", entry)
        if read > MOST_READ:
            raise UndoError("not_undoable", f"more than {MOST_READ} changes were made since: change {record} by hand")
    return found


def values(entry: AuditEntry, kind: type[M]) -> tuple[M | None, M | None]:
    """Return the record before and after a change; raises `UndoError` when one of them can't be read."""
    try:
        before, after = (msgspec.json.decode(value, type=kind | None) for value in (entry.before, entry.after))
    except msgspec.DecodeError as error:
        raise UndoError("not_undoable", f"the record in the audit trail can't be read ({error})") from error
    return before, after


def require_rest(expires_at: float, now: float, what: str) -> float:
    """Return how long (s) is left until a moment (s since the epoch); raises `UndoError` when it has passed."""
    if expires_at <= now:
        raise UndoError("not_undoable", f"{what} would have ended by now: there is nothing to bring back")
    return expires_at - now
