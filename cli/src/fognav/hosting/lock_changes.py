"""Brings changes of the locks into force while a fog node runs: new robots and nodes, new certificates.

Mosquitto reads its files again on a signal. Redis, the router and the services read them at their start only, so each
is started again, one at a time, when its own files have changed: what else is connected goes on meanwhile, and what was
connected to it connects again.
"""

import hashlib
import signal
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from fog_supervisor.supervisor import Supervisor
from fognav.output import FailedError
from fognav.programs import BROKER

_REREAD_ON: Final[Mapping[str, signal.Signals]] = {BROKER: signal.SIGHUP}
_READY_S: Final = 180.0
"""How long a restarted program may take before the others are brought up to date without it."""


class LockChanges:
    """Watches the files of each program's locks; `round` is called once a second."""

    def __init__(self, supervisor: Supervisor, files: Mapping[str, Sequence[Path]]) -> None:
        """Watch these files, or all in these folders, by the program that reads them; servers come first."""
        self._supervisor = supervisor
        self._files = files
        self._in_force = {name: self._digest(name) for name in files}
        self._seen = dict(self._in_force)
        self._restarting: str | None = None
        self._restarted_at = 0.0

    async def round(self) -> str | None:
        """Bring the changes of one program into force; return its name, or None.

        Raises `OSError`, and once for each restart `FailedError`, if the program does not become ready after it.
        """
        if self._restarting is not None:
            name = self._restarting
            missing = await self._supervisor.missing([name])
            late = time.monotonic() - self._restarted_at > _READY_S
            if missing and not late:
                return None  # never two at once
            self._restarting = None
            if missing:
                raise FailedError(
                    f"{name} is not ready {_READY_S:.0f} s after its restart with them ({missing[name]}). Its log says "
                    f"why (fognav logs {name}); the other programs get theirs"
                )
        for name in self._files:
            found, before = self._digest(name), self._seen[name]
            self._seen[name] = found
            # Several files change together: wait until they rest, so that no key meets another certificate.
            if found != before or found == self._in_force[name]:
                continue
            self._in_force[name] = found
            await self._bring_into_force(name)
            return name
        return None

    async def _bring_into_force(self, name: str) -> None:
        if self._supervisor.pid(name) is None:
            return  # it died, and reads them at its next start
        number = _REREAD_ON.get(name)
        if number is None:
            self._restarting, self._restarted_at = name, time.monotonic()
            await self._supervisor.restart(name)
        else:
            self._supervisor.kill(name, number)

    def _digest(self, name: str) -> bytes:
        found = hashlib.sha256()
        for path in self._files[name]:
            for file in sorted(path.iterdir()) if path.is_dir() else [path] if path.exists() else []:
                found.update(file.name.encode() + b"\0" + hashlib.sha256(file.read_bytes()).digest())
        return found.digest()
