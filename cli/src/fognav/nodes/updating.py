"""Updates of a node's firmware: the maker's key, a signed offer, and an HTTP server of the image (ADR 29)."""

from __future__ import annotations

import hashlib
import threading
from contextlib import contextmanager
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Final

from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.hashes import SHA256
from cryptography.hazmat.primitives.serialization import (
    Encoding,
    NoEncryption,
    PrivateFormat,
    PublicFormat,
    load_pem_private_key,
)

from fog_contracts.messages import NodeUpdate
from fog_runtime.files import PRIVATE, atomic_write
from fog_runtime.health import reachable_address
from fog_runtime.transports.mqtt_connection import Broker
from fognav.output import WrongUseError

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

_THIS_COMPUTER: Final = ("localhost", "127.0.0.1", "::1")
_SOMEWHERE: Final = "tcp/192.0.2.1:9"
"""Behind the default route; nothing is sent to it (TEST-NET-1, RFC 5737)."""
_MAX_BYTES: Final = 4 * 1024 * 1024


def make_key(file: Path) -> str:
    """Write a new private key (PEM), readable for its owner only, unless there is one; return its public half.

    That is what `update_key` of a node's settings takes: 130 hexadecimal digits, the point of P-256 uncompressed.
    Raises `WrongUseError`.
    """
    if not file.exists():
        key = ec.generate_private_key(ec.SECP256R1())
        try:
            atomic_write(
                file, key.private_bytes(Encoding.PEM, PrivateFormat.TraditionalOpenSSL, NoEncryption()), mode=PRIVATE
            )
        except OSError as error:
            raise WrongUseError(f"{file} can't be written: {error.strerror}") from error
    return _key(file).public_key().public_bytes(Encoding.X962, PublicFormat.UncompressedPoint).hex()


def signed_offer(image: bytes, number: int, board: str, key: Path, url: str) -> NodeUpdate:
    """Return the offer of an image, signed as the firmware checks it (`signed_text` in `update.cpp`).

    Raises `WrongUseError` for a key that is none.
    """
    digest = hashlib.sha256(image).hexdigest()
    text = f"fognav-firmware\n{board}\n{number}\n{len(image)}\n{digest}\n"
    signature = _key(key).sign(text.encode(), ec.ECDSA(SHA256())).hex()
    return NodeUpdate(number=number, board=board, size=len(image), sha256=digest, signature=signature, url=url)


def read_image(file: Path) -> bytes:
    """Return a firmware image; raises `WrongUseError` for none, or one that no node's flash holds."""
    try:
        image = file.read_bytes()
    except OSError as error:
        raise WrongUseError(f"{file} can't be read: {error.strerror}") from error
    if not 0 < len(image) <= _MAX_BYTES:
        raise WrongUseError(f"{file} is no image: it has {len(image)} bytes, of 1 to {_MAX_BYTES}")
    return image


@dataclass
class ServedImage:
    """An image that nodes can fetch, and whether one has fetched it to its end."""

    url: str
    fetched: bool = False


@contextmanager
def served(image: bytes, broker: str) -> Iterator[ServedImage]:
    """Serve an image over HTTP, at the URL at which a node can fetch it that reaches the same broker.

    Not encrypted: what the node fetches is compared with the hash that is signed. Raises `WrongUseError` where the
    broker's address says no way to this computer.
    """
    found = ServedImage("")

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Length", str(len(image)))
            self.end_headers()
            self.wfile.write(image)
            found.fetched = True

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002  # the name that its base gives it
            """Say nothing: standard error belongs to the command."""

    with ThreadingHTTPServer(("", 0), Handler) as server:
        known = Broker.of(broker)
        towards = f"tcp/{known.host}:{known.port}"
        address = reachable_address("", server.server_port, [towards])
        if known.host in _THIS_COMPUTER:
            # A board comes from the network; only a simulated node would find this computer at its own loopback.
            address = reachable_address("", server.server_port, [_SOMEWHERE]) or address
        if not address:
            raise WrongUseError(f"no network leads to {known}: serve the image elsewhere, and name it with --url")
        threading.Thread(target=server.serve_forever, daemon=True).start()
        found.url = f"http://{address}/firmware.bin"
        try:
            yield found
        finally:
            server.shutdown()


def _key(file: Path) -> ec.EllipticCurvePrivateKey:
    try:
        key = load_pem_private_key(file.read_bytes(), password=None)
    except OSError as error:
        raise WrongUseError(f"{file} can't be read: {error.strerror}. `fognav node key {file}` makes a key") from error
    except (ValueError, TypeError, UnsupportedAlgorithm) as error:
        raise WrongUseError(f"{file} is no private key without a passphrase") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey) or not isinstance(key.curve, ec.SECP256R1):
        raise WrongUseError(f"{file} is not a key of P-256: nodes can check no other")
    return key
