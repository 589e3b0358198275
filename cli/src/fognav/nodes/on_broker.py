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
import msgspec
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
from fog_contracts.site import NodeSite, Sonar, learned_share
from fog_runtime.credentials import NOBODY, Credentials
from fog_runtime.files import PRIVATE, atomic_write
from fog_runtime.health import reachable_address
from fog_runtime.transports.mqtt_connection import Broker
from fognav.output import FailedError, WrongUseError, writing

if TYPE_CHECKING:
    from collections.abc import AsyncIterator, Iterator
    from pathlib import Path

    from fog_contracts.channels import Channel

_THIS_COMPUTER: Final = ("localhost", "127.0.0.1", "::1")
_SOMEWHERE: Final = "tcp/192.0.2.1:9"
"""Behind the default route; nothing is sent to it (TEST-NET-1, RFC 5737)."""
_MAX_BYTES: Final = 4 * 1024 * 1024
_UNKNOWN_COMMAND: Final = "this firmware does not know the command"
"""How a node's refusal of a command begins that came with a later firmware."""
OLDER_DECLINED: Final = (
    "A node whose firmware does not know the command keep has taken what it learned at once: calibrate it again, which "
    "replaces that, and update its firmware (fognav node update)"
)


class OlderFirmwareError(FailedError):
    """A node's firmware is of before a command."""


def make_key(file: Path) -> str:
    """Write a new private key (PEM), readable for its owner only, unless there is one; return its public half.

    That is what `update_key` of a node's settings takes: 130 hexadecimal digits, the point of P-256 uncompressed.
    Raises `WrongUseError`.
    """
    if not file.exists():
        key = ec.generate_private_key(ec.SECP256R1())
        text = key.private_bytes(Encoding.PEM, PrivateFormat.TraditionalOpenSSL, NoEncryption())
        with writing(file):
            atomic_write(file, text, mode=PRIVATE)
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


LIKELIEST_FALSE_ECHOES: Final = 0.035
"""A rate of false echoes counts as no more by the default options of the rule `evidence`, as a test compares."""
CALIBRATION_S: Final = 180.0
"""A node with two sonars measures for some 40 s, one with eight for two minutes; without an answer after this it is not
there, or its firmware is too old."""
KEEPING_S: Final = 20.0
"""A node says that it keeps what it learned after its next measurement, at the latest when it is connected again."""


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

    It counts once the node was told to `KEEP` it, likewise; firmware of before that command goes by it at once, and
    refuses it: `OlderFirmwareError`. Raises `FailedError` with the node's own words if it refused, or if it does not
    answer within `CALIBRATION_S` (`KEEPING_S`).
    """
    seconds = KEEPING_S if command == ch.KEEP else CALIBRATION_S
    keys = {channel: channel.key(site=site, node=node) for channel in (ch.NODE_CALIBRATION, ch.NODE_PROBLEM)}
    try:
        async with (
            asyncio.timeout(seconds),
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
                    refusal = OlderFirmwareError if found.startswith(_UNKNOWN_COMMAND) else FailedError
                    raise refusal(f"node {node} refused: {found}")
    except TimeoutError:
        raise FailedError(
            f"node {node} did not answer within {seconds:.0f} s: check that it is online (fognav node list)"
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


def with_limits(node: NodeSite, learned: NodeCalibration) -> NodeSite:
    """Return a node of the site with what it has learned; raises `FailedError` for another number of sonars."""
    if len(node.sonars) != len(learned.range_limit_m):
        raise FailedError(
            f"node {node.id} has learned {len(learned.range_limit_m)} limits, and has {len(node.sonars)} sonars in the "
            "site: make site.toml and the board's settings agree"
        )
    sonars = [_calibrated(sonar, learned, index) for index, sonar in enumerate(node.sonars)]
    return msgspec.structs.replace(node, sonars=sonars)


def _calibrated(sonar: Sonar, learned: NodeCalibration, index: int) -> Sonar:
    """Return a sonar with what its node has learned of it; an older firmware does not count false echoes."""
    counted = index < min(len(learned.samples), len(learned.false_echoes)) and learned.samples[index] > 0
    rate = sonar.false_echo_rate
    if counted:
        rate = round(learned_share(learned.false_echoes[index], learned.samples[index]), 4)
    return msgspec.structs.replace(
        sonar,
        range_limit=min(4.0, learned.range_limit_m[index]),
        range_max=(learned.range_max_m[index] or None) if index < len(learned.range_max_m) else sonar.range_max,
        no_echo_is_clear=learned.no_echo_is_clear[index],
        false_echo_rate=rate,
    )


def free_space(learned: NodeCalibration, index: int) -> str:
    """Return what a calibration says of the samples of free space, if anything."""
    if index >= min(len(learned.samples), len(learned.false_echoes), len(learned.no_echoes)):
        return ""
    near, none, samples = learned.false_echoes[index], learned.no_echoes[index], learned.samples[index]
    return f"; of {samples} samples {near} echoed from nearer, {none} not at all" if samples else ""


def hears_too_much(learned: NodeCalibration, index: int) -> str:
    """Return a warning of a sonar with more false echoes than the rule `evidence` takes into account, if it has."""
    if not learned.samples[index] or index >= len(learned.false_echoes):
        return ""
    rate = learned_share(learned.false_echoes[index], learned.samples[index])
    if rate <= LIKELIEST_FALSE_ECHOES:
        return ""
    return (
        f"warning: sonar {index + 1} hears something in {100 * rate:.0f} % of the readings of its free area, and "
        f"false alarms are likely from {100 * LIKELIEST_FALSE_ECHOES:.1f} % on: turn it away from what it hears (an "
        "edge, the floor, another sonar) and calibrate it again"
    )
