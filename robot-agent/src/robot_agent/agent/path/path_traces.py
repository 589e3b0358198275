"""Traces of hazards: from the path that a hazard caused to the first wheel command on it."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import msgspec

if TYPE_CHECKING:
    from collections.abc import Iterable

    from fog_contracts.messages import Trace

_RECENT_MAX: Final = 16


class PathTraces:
    """Traces of the followed path, open until its first wheel command. Stamps are seconds since the epoch.

    `recent`: the last closed traces, for the state message.
    """

    def __init__(self) -> None:
        self.recent: list[Trace] = []
        self._open: list[Trace] = []
        self._finished: list[Trace] = []

    def begin(self, traces: Iterable[Trace], stamp: float) -> None:
        """Open the traces of a new path; those of the path before it are dropped."""
        self._open = [msgspec.structs.replace(trace, path_received=stamp) for trace in traces]

    def close(self, stamp: float) -> None:
        """Close the open traces: a wheel command follows the new path."""
        if not self._open:
            return
        closed = [msgspec.structs.replace(trace, first_command=stamp) for trace in self._open]
        self._open = []
        self._finished.extend(closed)
        self.recent = [*self.recent, *closed][-_RECENT_MAX:]

    def take_finished(self) -> list[Trace]:
        """Return the traces that were closed since the last call, each once."""
        finished, self._finished = self._finished, []
        return finished
