"""Exports until when certificates are valid: those that servers show, and the authorities that this process trusts.

Each server is asked for what it shows: it may go on with a certificate that was renewed in its files long ago.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import ssl
from typing import TYPE_CHECKING, Final
from urllib.parse import urlsplit

from prometheus_client import Gauge

if TYPE_CHECKING:
    from fog_runtime.configuration.settings import CommonSettings
    from fog_runtime.credentials import Credentials

CERTIFICATE_END: Final = Gauge(
    "fognav_certificate_end_seconds", "Until when a certificate is valid (s since the epoch)", ["certificate"]
)
AUTHORITY: Final = "authority"
_GATEWAY_PORT: Final = 8443
"""On which the gateway listens in its network (deploy/gateway/Caddyfile)."""
_PORTS: Final = {"mqtts": 8883, "rediss": 6379, "tls": 7447}
_ENCRYPTED: Final = re.compile(r"(mqtts|rediss|tls)(?:\+sentinel)?:?/{1,2}(?:[^/@]*@)?([^/?]+)")
_PERIOD_S: Final = 600.0
_TIMEOUT_S: Final = 5.0
_NO_CHECK_TIME: Final = 0x200000
"""X509_V_FLAG_NO_CHECK_TIME of OpenSSL: a certificate that has ended is told of, too."""


def servers(settings: CommonSettings) -> list[tuple[str, int]]:
    """Return host and port of each server of a process's settings that encrypts."""
    found = [] if not settings.http_gateway else [(settings.http_gateway, _GATEWAY_PORT)]
    for address in (*settings.mqtt_url.split(","), settings.redis_url, *settings.zenoh_endpoints):
        if (encrypted := _ENCRYPTED.match(address.strip())) is not None:
            places = (urlsplit(f"//{place}") for place in encrypted[2].split(","))
            found += [(place.hostname or "", place.port or _PORTS[encrypted[1]]) for place in places]
    return found


async def watch_certificates(settings: CommonSettings, credentials: Credentials) -> None:
    """Export them, looked at every ten minutes, until cancelled; nothing for a process that trusts no authority.

    The label is `authority`, of which the first to end counts, or a server's `HOST:PORT`. A server that does not answer
    keeps what was found before: that it is away, other metrics tell.
    """
    if not credentials.authority:
        return
    context = credentials.tls_context()
    context.check_hostname = False
    context.verify_flags |= _NO_CHECK_TIME
    CERTIFICATE_END.labels(AUTHORITY).set(min(map(_end, context.get_ca_certs())))
    while True:
        for host, port in servers(settings):
            with contextlib.suppress(OSError):
                end = await _shown(host, port, context)
                CERTIFICATE_END.labels(f"{host}:{port}").set(end)  # a label without a value would be 0: long ended
        await asyncio.sleep(_PERIOD_S)


def _end(certificate: object) -> float:
    """Return the end of a certificate that `ssl` has decoded."""
    assert isinstance(certificate, dict)
    return float(ssl.cert_time_to_seconds(certificate["notAfter"]))


async def _shown(host: str, port: int, context: ssl.SSLContext) -> float:
    """Return the end of the certificate that a server shows; raises `OSError`."""
    async with asyncio.timeout(_TIMEOUT_S):
        _, writer = await asyncio.open_connection(host, port, ssl=context)
    try:
        return _end(writer.get_extra_info("peercert"))
    finally:
        writer.transport.abort()
