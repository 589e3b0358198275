"""Traces of hazards: from a path that came because of one, until its first wheel command."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import msgspec

if TYPE_CHECKING:
    from collections.abc import Iterable

    from fog_contracts.messages import Trace

_KEPT: Final = 16


class PathTraces:
    """Traces of the path that is followed, open until a wheel command follows it. Stamps are seconds since the epoch.

    `recent` are the last closed ones, for the state message.
    """

    def __init__(self) -> None:
        self.recent: list[Trace] = []
        self._open: list[Trace] = []
        self._finished: list[Trace] = []

    def begin(self, traces: Iterable[Trace], stamp: float) -> None:
        """Take the traces of a new path; those of the path before it are void."""
        self._open = [msgspec.structs.replace(trace, path_received=stamp) for trace in traces]

    def close(self, stamp: float) -> None:
        """Note that a wheel command follows the new path."""
        if not self._open:
            return
        closed = [msgspec.structs.replace(trace, first_command=stamp) for trace in self._open]
        self._open = []
        self._finished.extend(closed)
        self.recent = [*self.recent, *closed][-_KEPT:]

    def take_finished(self) -> list[Trace]:
        """Return the traces that were closed since the last call, each once."""
        finished, self._finished = self._finished, []
        return finished
