"""Tells systemd how a service does (sd_notify(3)), where it started it with `Type=notify`; does nothing elsewhere."""

import os
import socket
import time
from typing import Final

SOCKET: Final = "NOTIFY_SOCKET"
ALIVE_S: Final = 0.5
"""Shortest time between two signs of life, however often they are given."""


class ServiceManager:
    """The service manager that started this process, if it listens."""

    def __init__(self, address: str | None = None) -> None:
        """Use the socket at `address`; by default the one that the environment names."""
        name = os.environ.get(SOCKET, "") if address is None else address
        # An abstract name is written with an at sign.
        self._address = f"\0{name[1:]}" if name.startswith("@") else name
        self._alive_at = -ALIVE_S

    def ready(self) -> None:
        """Tell that the service runs."""
        self._send("READY=1")

    def alive(self, status: str = "") -> None:
        """Tell that the service lives (`WatchdogSec`), and in one line how it does; call it as often as you like."""
        now = time.monotonic()
        if now - self._alive_at < ALIVE_S:
            return
        self._alive_at = now
        self._send(f"WATCHDOG=1\nSTATUS={' '.join(status.split())}")

    def _send(self, text: str) -> None:
        if not self._address:
            return
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
                sender.settimeout(0)
                sender.sendto(text.encode(), self._address)
        except OSError:
            # A manager that is busy or gone must delay nothing: it judges this service by what it receives later.
            return
