"""Notices that Redis lost acknowledged records: that it was emptied, replaced, or went back to an older state.

A site's store has a generation (a random text, written once) and counts the writes of each table. A service remembers
both, and in a file the generation of the store that it used last, so that it notices a loss at its start too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final, NamedTuple

from prometheus_client import Gauge

from fog_runtime.files import atomic_write
from fog_runtime.stores.redis_connection import StoreError, StoreRefusedError

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

LOST: Final = Gauge(
    "fognav_store_lost", "Whether Redis lost acknowledged records (1), so that writes are refused until it is decided"
)
_REMEDY: Final = (
    "writes are refused until an administrator decides: `fognav store restore` (write back what this service has in"
    " memory) or `fognav store accept` (go on with what Redis has), or POST /api/v1/store/recovery with"
    ' {"action": "restore"} or {"action": "accept"}; see docs/operations.md'
)


class StoreLostError(StoreRefusedError):
    """Redis lost acknowledged records; the message says how, and what an administrator can do."""

    def __init__(self, what: str) -> None:
        super().__init__(f"{what}: {_REMEDY}")
        self.what = what
        LOST.set(1)


class Expectation(NamedTuple):
    """What a store must have: its generation, empty if this service used none before, and at least these writes."""

    generation: str
    writes: Mapping[str, int]


class StoreIdentity:
    """What a service knows of the store that it uses; `marker` is the file that outlives the service, if there is one.

    `generation` is empty until the store was seen.
    """

    def __init__(self, marker: Path | None) -> None:
        self._marker = marker
        self._acknowledged: dict[str, int] = {}
        self.generation = ""
        LOST.set(0)

    def guard(self, table: str) -> dict[str, object]:
        """Return what must hold for a write to the table, for the scripts."""
        return {"generation": self.generation, "table": table, "acknowledged": self._acknowledged.get(table, 0)}

    def acknowledge(self, table: str, writes: int) -> None:
        """Record that Redis acknowledged a write; `writes` is the table's count of them."""
        self._acknowledged[table] = max(writes, self._acknowledged.get(table, 0))

    def expectation(self) -> Expectation:
        """Return what the store must have from now on; raises `StoreError` when the marker file can't be read.

        Take it before Redis is asked: a write that is acknowledged while the answer travels is not in that answer.
        """
        return Expectation(self.generation or self._remembered(), dict(self._acknowledged))

    def verify(self, expected: Expectation, generation: str, writes: Mapping[str, int]) -> None:
        """Compare the store (`generation` is empty if it has none) with what was expected of it.

        Raises `StoreLostError`, and `StoreError` when the marker file can't be read or written.
        """
        if expected.generation and generation != expected.generation:
            kind = "was emptied" if not generation else "was replaced by another store"
            raise StoreLostError(f"Redis {kind}, so acknowledged records are lost")
        for table, acknowledged in expected.writes.items():
            if (found := writes.get(table, 0)) < acknowledged:
                raise StoreLostError(
                    f"Redis went back to an older state: it has {found} of {acknowledged} writes of {table}"
                )
        if generation and not self.generation:
            self.adopt(generation, writes)
        LOST.set(0)

    def adopt(self, generation: str, writes: Mapping[str, int]) -> None:
        """Use this store from now on; raises `StoreError` when the marker file can't be written."""
        if self._marker is not None and generation != self._remembered():
            try:
                atomic_write(self._marker, generation.encode())
            except OSError as error:
                raise StoreError(
                    f"{self._marker} can't be written ({error}): let FOGNAV_DATA_DIR name a folder for it"
                ) from error
        self.generation, self._acknowledged = generation, dict(writes)
        LOST.set(0)

    def _remembered(self) -> str:
        if self._marker is None:
            return ""
        try:
            return self._marker.read_text("ascii").strip()
        except FileNotFoundError:
            return ""
        except (OSError, UnicodeDecodeError) as error:
            raise StoreError(f"{self._marker} can't be read ({error}): delete it to accept what Redis has") from error
