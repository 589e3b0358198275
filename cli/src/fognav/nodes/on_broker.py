"""Sensor nodes on a broker: their readings as they come, what they learn on command, and updates of their firmware.

An update is a signed offer, and an HTTP server of the image (ADR 29).
"""

from __future__ import annotations

import asyncio
import hashlib
import os
import threading
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import TYPE_CHECKING, Final

import aiomqtt
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

from fog_contracts import channels as ch
from fog_contracts.codec import ContractError, decode, decode_text, encode, encode_text
from fog_contracts.messages import NodeCalibration, NodeReading, NodeUpdate
from fog_runtime.credentials import NOBODY, Credentials
from fog_runtime.files import PRIVATE, atomic_write
from fog_runtime.health import reachable_address
from fog_runtime.transports.mqtt_connection import Broker
from fognav.output import FailedError, WrongUseError

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator
    from pathlib import Path

    from fog_contracts.channels import Channel

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


CALIBRATION_S: Final = 180.0
"""A node with two sonars measures for some 40 s, one with eight for two minutes; without an answer after this it is not
there, or its firmware is too old."""


@asynccontextmanager
async def _connected(url: str, topics: dict[str, int], credentials: Credentials) -> AsyncIterator[aiomqtt.Client]:
    try:
        broker = Broker.of(url, credentials)
    except ValueError as error:
        raise WrongUseError(f"--broker {url}: {error}") from error
    try:
        async with broker.client(f"fognav-node-{os.getpid()}", None) as client:
            await client.subscribe(list(topics.items()))
            yield client
    except aiomqtt.MqttError as error:
        raise FailedError(
            f"the broker at {broker} can't be used: {error}. Check its address and your password"
        ) from error


async def readings(
    url: str, site: str, node: str, credentials: Credentials = NOBODY
) -> AsyncIterator[NodeReading | str]:
    """Yield what a node publishes, until cancelled: readings, and `online` or `offline`.

    Raises `FailedError` for a broker that can't be used, or when the connection ends.
    """
    reading, availability = (channel.key(site=site, node=node) for channel in (ch.NODE_READING, ch.NODE_AVAILABILITY))
    async with _connected(url, {reading: 0, availability: 1}, credentials) as client:
        async for message in client.messages:
            data = _bytes(message)
            try:
                if message.topic.value == reading:
                    yield decode(ch.NODE_READING, data, NodeReading)
                elif data:
                    yield decode_text(ch.NODE_AVAILABILITY, data)
            except ContractError as error:
                yield f"not understood: {error}"


async def learn(url: str, site: str, node: str, command: str, credentials: Credentials = NOBODY) -> NodeCalibration:
    """Let a node learn its limits (`CALIBRATE`) or its board's "no echo" (`LEARN_NO_ECHO`), and return what it learned.

    Raises `FailedError` with the node's own words if it refused, or if it does not answer within `CALIBRATION_S`.
    """
    keys = {channel: channel.key(site=site, node=node) for channel in (ch.NODE_CALIBRATION, ch.NODE_PROBLEM)}
    try:
        async with (
            asyncio.timeout(CALIBRATION_S),
            _connected(url, dict.fromkeys(keys.values(), 1), credentials) as client,
        ):
            await client.publish(
                ch.NODE_COMMAND.key(site=site, node=node),
                encode_text(ch.NODE_COMMAND, command),
                qos=ch.NODE_COMMAND.qos,
            )
            async for message in client.messages:
                if message.retain:
                    continue  # an earlier answer, which the broker kept
                found = _answer(keys, message)
                if isinstance(found, NodeCalibration):
                    return found
                if found:
                    raise FailedError(f"node {node} refused: {found}")
    except TimeoutError:
        raise FailedError(
            f"node {node} did not answer within {CALIBRATION_S:.0f} s: check that it is online (fognav node list)"
        ) from None
    raise FailedError(f"the broker closed the connection before node {node} answered: try again")


async def update(
    url: str, site: str, node: str, offer: NodeUpdate, credentials: Credentials = NOBODY, *, seconds: float
) -> NodeReading:
    """Offer a node an update, and return its first reading after the restart; the offer is withdrawn then.

    Raises `FailedError` with the node's own words if it refused or failed, or if it has not restarted after `seconds`.
    """
    reading, problem = (channel.key(site=site, node=node) for channel in (ch.NODE_READING, ch.NODE_PROBLEM))
    topic, channel = ch.NODE_UPDATE.key(site=site, node=node), ch.NODE_UPDATE
    before: int | None = None
    async with _connected(url, {reading: 0, problem: 1}, credentials) as client:
        try:
            async with asyncio.timeout(seconds):
                async for message in client.messages:
                    if message.topic.value == reading:
                        found = decode(ch.NODE_READING, _bytes(message), NodeReading)
                        if before is None:
                            await client.publish(topic, encode(channel, offer), qos=channel.qos, retain=True)
                        elif found.boot != before:
                            return found
                        before = found.boot
                    elif before is not None and not message.retain and (words := _bytes(message).decode()):
                        raise FailedError(f"node {node} was not updated: {words}")
        except TimeoutError:
            what = "is not there (fognav node list)" if before is None else "has not restarted"
            raise FailedError(f"node {node} {what}: waited {seconds:g} s") from None
        except ContractError as error:
            raise FailedError(f"what node {node} says was not understood: {error}") from error
        finally:
            if before is not None:
                await client.publish(topic, b"", qos=channel.qos, retain=True)
    raise FailedError(f"the broker closed the connection before node {node} was updated: try again")


def _answer(keys: dict[Channel, str], message: aiomqtt.Message) -> NodeCalibration | str:
    data = _bytes(message)
    if not data:
        return ""
    try:
        if message.topic.value == keys[ch.NODE_CALIBRATION]:
            return decode(ch.NODE_CALIBRATION, data, NodeCalibration)
        return decode_text(ch.NODE_PROBLEM, data)
    except ContractError as error:
        raise FailedError(f"the node's answer was not understood: {error}. Is its firmware of this version?") from error


def _bytes(message: aiomqtt.Message) -> bytes:
    return bytes(message.payload)
