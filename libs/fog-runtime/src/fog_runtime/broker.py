"""Runs Mosquitto behind a relay: `python -m fog_runtime.broker --listen tls/0.0.0.0:8883 --certificate … --key …`.

Connections that say nothing would fill the broker's descriptors, and one user's client could end those of others
(`mqtt_opening`, docs/adr/0055). With `--configuration` it runs Mosquitto, which then listens on a Unix socket of this
process, and reads its files again on SIGHUP; with `--to ADDRESS:PORT` a broker runs there. A new certificate is used as
soon as it is there.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import ctypes
import signal
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Final

from fog_runtime import admission, logs, process
from fog_runtime.machine import descriptors
from fog_runtime.mqtt_opening import MqttOpening
from fog_runtime.relay import Relay, place_of, server_tls, to_socket

if TYPE_CHECKING:
    import ssl
    from collections.abc import Callable, Sequence

    from fog_runtime.relay import Connect

_PR_SET_PDEATHSIG: Final = 1
_END_S: Final = 5.0
_LOOK_S: Final = 0.01
_GONE_S: Final = 10.0
"""After how long without a broker at the address of `--to` this process ends: a container that is started again has
another network stack, and its relay must be started again to be in it."""
_AGAIN_S: Final = 2.0
"""How often it looks for a new certificate, and whether the broker of `--to` is there."""

_log = logs.get("broker")


class BrokerEndedError(Exception):
    """The broker behind the relay has ended by itself, or accepts no connection."""


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
    descriptors.raise_limit()
    tls = server_tls(options.certificate, options.key)
    with contextlib.ExitStack() as stack:
        listener = stack.enter_context(admission.listen(*place_of(options.listen)))
        broker = None
        if options.configuration is not None:
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="fognav-broker-")))
            broker = _Broker(folder, options.program, options.configuration)
        connect = _to_port(options.to) if broker is None else to_socket(broker.socket)
        try:
            if broker is not None:
                await broker.start()
                asyncio.get_running_loop().add_signal_handler(signal.SIGHUP, broker.reread)
            _log.info("listening", endpoint=options.listen)
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(Relay(connect, MqttOpening, tls).serve([listener]))
                tasks.create_task(_renew(tls, options.certificate, options.key))
                tasks.create_task(_gone(connect) if broker is None else broker.ended())
        finally:
            if broker is not None:
                await broker.stop()


async def _gone(connect: Connect) -> None:
    """Raise `BrokerEndedError` once the broker has accepted no connection for a while."""
    loop = asyncio.get_running_loop()
    there = loop.time()
    while True:
        transport: asyncio.Transport
        try:
            transport, _ = await connect(asyncio.Protocol)
        except OSError as error:
            if loop.time() - there > _GONE_S:
                raise BrokerEndedError(f"no broker for {_GONE_S:g} s: {error}") from error
        else:
            transport.close()
            there = loop.time()
        await asyncio.sleep(_AGAIN_S)


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


def _to_port(place: str) -> Connect:
    host, _, port = place.rpartition(":")

    async def connect(make_protocol: Callable[[], asyncio.Protocol]) -> tuple[asyncio.Transport, asyncio.Protocol]:
        return await asyncio.get_running_loop().create_connection(make_protocol, host, int(port))

    return connect


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
    to.add_argument("--to", metavar="ADDRESS:PORT", help="where a broker runs already")
    options = parser.parse_args(arguments)
    logs.configure("broker", "info", "json")
    process.run(lambda: run_broker(options))


if __name__ == "__main__":
    main()
