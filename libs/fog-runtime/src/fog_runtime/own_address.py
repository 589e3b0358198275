"""The address at which other machines reach a server of this process."""

import ipaddress
import socket
from collections.abc import Sequence
from typing import Final

_ANY: Final = ("", "0.0.0.0", "::")  # noqa: S104  # compared with, not listened on


def reachable_address(host: str, port: int, towards: Sequence[str]) -> str:
    """Return `host:port` as the machines in `towards` can use it, or an empty text if they can't reach it.

    host: what the server listens on. towards: zenoh endpoints (`tcp/fog.local:7447`) of the machine that would ask; the
    first whose name is known counts. Blocks while a name is looked up; sends nothing.
    """
    own = _own_side(towards)
    if not own:
        return ""
    if host in _ANY:
        return _join(own, port)
    if _is_loopback(host) and not _is_loopback(own):
        return ""
    return _join(host, port)


def _own_side(towards: Sequence[str]) -> str:
    """Return this machine's address on the way to the first endpoint that has one."""
    for endpoint in towards:
        host, _, port = endpoint.partition("/")[2].partition("?")[0].rpartition(":")
        try:
            found = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_DGRAM)
            family, kind, protocol, _, address = found[0]
            with socket.socket(family, kind, protocol) as way:
                way.connect(address)  # only chooses the route
                return str(way.getsockname()[0])
        except (OSError, ValueError):
            continue  # unknown, or without a route now: the next one
    return ""


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def _join(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
