"""A pseudo terminal that a driver opens as if it were a serial device."""

from __future__ import annotations

import os
import pty
import secrets
import tty
from pathlib import Path
from typing import Final, Self

_READ_BYTES: Final = 65536
_BUFFER_BYTES: Final = 8192


class PtyPort:
    """One pty in raw mode, held open at both ends, so that hosts can connect, disconnect and crash.

    A host that does not read loses the oldest bytes, as on a real line, and never blocks the simulator. Bytes that
    remain in the kernel's buffer (up to 4 KiB) reach the next host, as on a real line.
    Close it or use it in a `with` statement.
    """

    def __init__(self, link: Path | None = None) -> None:
        """Open the pty; `link` becomes a symbolic link to it, replacing one of the same name.

        Raises:
            FileExistsError: if `link` exists and is not a symbolic link.
            OSError: if the link can't be created or no pty is left.

        """
        self._master, self._slave = pty.openpty()
        self._link: Path | None = None
        self._pending = bytearray()
        self.lost_bytes = 0
        try:
            tty.setraw(self._slave)
            os.set_blocking(self._master, False)
            self.slave_path = Path(os.ttyname(self._slave))
            if link is not None:
                self._put_link(link)
        except BaseException:
            self.close()
            raise

    @property
    def path(self) -> Path:
        """Where a host opens this port: the link if there is one, else the pty itself."""
        return self._link or self.slave_path

    def fileno(self) -> int:
        """Descriptor that becomes readable when a host has written; -1 once closed."""
        return self._master

    def read(self) -> bytes:
        """Return what the host has written, without waiting; b"" if nothing."""
        try:
            return os.read(self._master, _READ_BYTES)
        except BlockingIOError:
            return b""

    def write(self, data: bytes) -> None:
        """Send as much as the line accepts; keep the newest 8 KiB of the rest for the next call."""
        self._pending += data
        try:
            while self._pending:
                del self._pending[: os.write(self._master, self._pending)]
        except BlockingIOError:
            surplus = len(self._pending) - _BUFFER_BYTES
            if surplus > 0:
                del self._pending[:surplus]
                self.lost_bytes += surplus

    def close(self) -> None:
        """Remove the link, if it still points to this pty, and close both ends. Closing twice is allowed."""
        if self._link is not None and self._link.is_symlink() and self._link.readlink() == self.slave_path:
            self._link.unlink()
        self._link = None
        for fd in (self._master, self._slave):
            if fd >= 0:
                os.close(fd)
        self._master = self._slave = -1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _put_link(self, link: Path) -> None:
        if link.exists() and not link.is_symlink():
            raise FileExistsError(f"{link} is not a symbolic link: remove it, or give the port another path")
        link.parent.mkdir(parents=True, exist_ok=True)
        temporary = link.with_name(f".{link.name}.{secrets.token_hex(4)}")
        temporary.symlink_to(self.slave_path)
        temporary.replace(link)
        self._link = link
