"""Runs Mosquitto behind a relay: `python -m fog_runtime.broker --listen tls/0.0.0.0:8883 --certificate … --key …`.

Connections that say nothing would fill the broker's descriptors, and one user's client could end those of others
(`MqttOpening`, ADR 55). With `--configuration` it runs Mosquitto, which then listens on a Unix socket of this
process, and reads its files again on SIGHUP; with `--to FILE` a broker listens on that socket, now or later. A new
certificate is used as soon as it is there.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import ctypes
import signal
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from fog_runtime import admission, logs, machine, process
from fog_runtime.relay import Relay, place_of, server_tls, to_socket

if TYPE_CHECKING:
    import ssl
    from collections.abc import Iterator, Sequence

CONNECT_BYTES: Final = 64 * 1024
"""Longest CONNECT that is read: with id, will, name and password; those of Fognav have less than 1 KiB."""
_CONNECT: Final = 0x10
_CONNACK: Final = 0x20
_MQTT_5: Final = 5
_LEVELS: Final = frozenset({3, 4, _MQTT_5, 0x83, 0x84})
"""Versions of the protocol; the highest bit is a bridge's. Mosquitto takes 0x85 for MQTT 5 with properties of
the will alone, so that it reads the user elsewhere than this relay."""
_WILL: Final = 0x04
_USER: Final = 0x80
_TEXT_MAX: Final = 0xFFFF
_CONTINUES: Final = 0x80
_NUMBER_BYTES: Final = 4

_log = logs.get("broker")


class MalformedError(ValueError):
    """What should be a CONNECT packet is none."""


class _IncompleteError(Exception):
    """More bytes are needed."""


@dataclass
class _Reader:
    """Reads the fields of a packet one after another."""

    data: bytes
    at: int = 0

    def take(self, size: int) -> bytes:
        """Return the next bytes; raises `_IncompleteError`."""
        if self.at + size > len(self.data):
            raise _IncompleteError
        self.at += size
        return self.data[self.at - size : self.at]

    def number(self) -> int:
        """Return a number of variable length (section 2.2.3, 1.5.5)."""
        value = 0
        for index in range(_NUMBER_BYTES):
            byte = self.take(1)[0]
            value |= (byte & ~_CONTINUES) << (7 * index)
            if not byte & _CONTINUES:
                return value
        raise MalformedError("a length of more than four bytes")

    def text(self) -> bytes:
        """Return a string, or binary data, without its length."""
        return self.take(int.from_bytes(self.take(2), "big"))


def _number(value: int) -> bytes:
    encoded = bytearray()
    while True:
        value, low = divmod(value, _CONTINUES)
        encoded.append(low | (_CONTINUES if value else 0))
        if not value:
            return bytes(encoded)


def _text(data: bytes) -> bytes:
    if len(data) > _TEXT_MAX:
        raise MalformedError("a client id that is too long")
    return len(data).to_bytes(2, "big") + data


def with_user_in_id(packet: bytes) -> tuple[bytes, bytes]:
    """Return the body of a CONNECT packet whose client id begins with `USER/`, and the user; raises `MalformedError`.

    An id that the broker shall choose stays empty, and who gives no user's name keeps his.
    """
    reader = _Reader(packet)
    try:
        reader.text()  # the protocol's name
        level, flags, *_ = reader.take(4)  # and the keep-alive
        if level not in _LEVELS:
            raise MalformedError(f"the protocol's version {level:#x}")
        if level == _MQTT_5:
            reader.take(reader.number())
        before = reader.at
        client = reader.text()
        after = reader.at
        if flags & _WILL:
            if level == _MQTT_5:
                reader.take(reader.number())
            reader.text()
            reader.text()
        user = reader.text() if flags & _USER else b""
    except _IncompleteError as error:
        raise MalformedError("a CONNECT packet that ends too early") from error
    if not client or not user:
        return packet, user
    return packet[:before] + _text(user + b"/" + client) + packet[after:], user


class MqttOpening:
    """Changes the client id in CONNECT, and sees in CONNACK whether the broker has let the client in.

    A broker ends a connection when another one opens with the same client id. Ids can be guessed, so whoever has one
    user's password could end the connections of all others. With `USER/` before it, a client id is the user's own
    (MQTT 3.1.1 and 5.0, section 3.1).
    """

    def __init__(self) -> None:
        self.user = ""
        self._sent = bytearray()
        self._connected = False
        self._answered = bytearray()
        self._head = bytearray()
        self._left = 0

    def from_client(self, data: bytes) -> bytes:
        """Return what to pass on of the client's next bytes; raises `MalformedError`."""
        if self._connected:
            return data
        self._sent += data
        reader = _Reader(bytes(self._sent[: CONNECT_BYTES + 8]))
        try:
            if reader.take(1)[0] != _CONNECT:
                raise MalformedError("something else than CONNECT")
            size = reader.number()
            if size > CONNECT_BYTES:
                raise MalformedError("a CONNECT packet that is too long")
            packet, user = with_user_in_id(reader.take(size))
        except _IncompleteError:
            return b""
        self._connected, self.user = True, user.decode(errors="replace")
        return bytes((_CONNECT,)) + _number(len(packet)) + packet + bytes(self._sent[reader.at :])

    def parts(self, data: bytes) -> Iterator[bytes]:
        """Yield the broker's next bytes, none of which follows the end of a packet in its part.

        Of the packets in a TLS record paho reads the first, and the others only when more comes (its issue 131). What
        uses it without knowing that, as Home Assistant does, would see what the broker has kept only after a change.
        """
        begin = at = 0
        while at < len(data):
            if self._left:
                step = min(self._left, len(data) - at)
                at, self._left = at + step, self._left - step
            else:
                self._head.append(data[at])
                at += 1
                if len(self._head) == 1 or (self._head[-1] & _CONTINUES and len(self._head) <= _NUMBER_BYTES):
                    continue
                self._left = sum((byte & ~_CONTINUES) << (7 * index) for index, byte in enumerate(self._head[1:]))
                self._head.clear()
            if not self._left:
                yield data[begin:at]
                begin = at
        if begin < at:
            yield data[begin:]

    def admits(self, data: bytes) -> bool:
        """Whether CONNACK with the code 0 has come, with these next bytes of the broker's."""
        self._answered += data
        reader = _Reader(bytes(self._answered[:16]))
        try:
            if reader.take(1)[0] != _CONNACK:
                return False
            reader.number()
            return reader.take(2)[1] == 0
        except _IncompleteError:
            return False


_PR_SET_PDEATHSIG: Final = 1
_END_S: Final = 5.0
_LOOK_S: Final = 0.01
_AGAIN_S: Final = 2.0
"""How often it looks for a new certificate."""


class BrokerEndedError(Exception):
    """The broker that this process runs has ended by itself."""


def _end_with_parent() -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


class _Broker:
    """A broker that runs as this process's child, with a socket in a folder of its own."""

    def __init__(self, folder: Path, program: str, configuration: Path) -> None:
        self.socket = folder / "mqtt"
        self._file = folder / "mosquitto.conf"
        self._program = program
        self._file.write_text(f"{configuration.read_text('utf-8')}\nlistener 0 {self.socket}\n", "utf-8")
        self._process: asyncio.subprocess.Process | None = None

    async def start(self) -> None:
        """Start it, and return once it accepts connections; raises `BrokerEndedError`."""
        self._process = await asyncio.create_subprocess_exec(
            self._program, "-c", str(self._file), preexec_fn=_end_with_parent
        )
        while True:
            with contextlib.suppress(FileNotFoundError, ConnectionRefusedError):
                _, writer = await asyncio.open_unix_connection(str(self.socket))
                writer.close()
                return
            if self._process.returncode is not None:
                raise BrokerEndedError(f"{self._program} did not start: its own lines before this one say why")
            await asyncio.sleep(_LOOK_S)

    def reread(self) -> None:
        """Let it read its files again."""
        if self._process is not None and self._process.returncode is None:
            self._process.send_signal(signal.SIGHUP)

    async def ended(self) -> None:
        """Wait for its end; raises `BrokerEndedError`."""
        assert self._process is not None
        raise BrokerEndedError(f"{self._program} has ended with status {await self._process.wait()}")

    async def stop(self) -> None:
        """End it in order, or after a while anyhow."""
        if self._process is None or self._process.returncode is not None:
            return
        self._process.terminate()
        try:
            async with asyncio.timeout(_END_S):
                await self._process.wait()
        except TimeoutError:
            self._process.kill()
            await self._process.wait()


async def run_broker(options: argparse.Namespace) -> None:
    """Relay, and run the broker if it is this process's, until cancelled.

    Raises `OSError` when the port is taken or a file can't be read, `CertificateError`, and `BrokerEndedError`.
    """
    machine.raise_limit()
    tls = server_tls(options.certificate, options.key)
    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(admission.listen(*place_of(options.listen)))
        broker = None
        if options.configuration is not None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="fognav-broker-")))
            broker = _Broker(folder, options.program, options.configuration)
        connect = to_socket(options.to if broker is None else broker.socket)
        try:
            if broker is not None:
                await broker.start()
                asyncio.get_running_loop().add_signal_handler(signal.SIGHUP, broker.reread)
            _log.info("listening", endpoint=options.listen)
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(Relay(connect, MqttOpening, tls).serve([listener]))
                tasks.create_task(_renew(tls, options.certificate, options.key))
                if broker is not None:
                    tasks.create_task(broker.ended())
        finally:
            if broker is not None:
                await broker.stop()


async def _renew(tls: ssl.SSLContext, certificate: Path, key: Path) -> None:
    """Use each new certificate for the connections after it."""
    known = await asyncio.to_thread(certificate.read_bytes)
    while True:
        await asyncio.sleep(_AGAIN_S)
        try:
            if (found := await asyncio.to_thread(certificate.read_bytes)) == known:
                continue
            tls.load_cert_chain(certificate, key)
        except OSError as error:  # the one before stays in use; perhaps its key is still being written
            _log.warning("certificate_unusable", file=str(certificate), reason=str(error))
        else:
            known = found


def main(arguments: Sequence[str] | None = None) -> None:
    """Run until SIGTERM."""
    parser = argparse.ArgumentParser(
        prog="fog_runtime.broker", description="Run a broker behind a relay until SIGTERM."
    )
    parser.add_argument("--listen", required=True, metavar="tls/ADDRESS:PORT")
    parser.add_argument("--certificate", type=Path, required=True, metavar="FILE")
    parser.add_argument("--key", type=Path, required=True, metavar="FILE")
    parser.add_argument("--program", default="mosquitto", metavar="FILE", help="Mosquitto, for --configuration")
    to = parser.add_mutually_exclusive_group(required=True)
    to.add_argument("--configuration", type=Path, metavar="FILE", help="of Mosquitto, without any listener")
    to.add_argument("--to", type=Path, metavar="FILE", help="the socket of a broker that another process runs")
    options = parser.parse_args(arguments)
    logs.configure("broker", "info", "json")
    process.run(lambda: run_broker(options))


if __name__ == "__main__":
    main()
