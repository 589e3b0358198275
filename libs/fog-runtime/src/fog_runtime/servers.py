"""Private Mosquitto, Redis and zenoh router processes on loopback ports: for the demonstration and for tests.

Each has its own configuration, data and log in a folder, is started and stopped by its own process id, and is ready
when its `start_` function returns. The functions block for some 30 ms (the router for some 0.5 s).
"""

import os
import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, Final, Self

_READY_S: Final = 15.0
_STOP_S: Final = 5.0
_ATTEMPTS: Final = 5
"""Free ports to try: another process may take one between its choice and its use."""


class ServerError(RuntimeError):
    """A server that is not installed or does not start; the message holds the end of its log."""


def free_port() -> int:
    """Return a TCP port of the loopback interface that nobody listens on right now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _accepts(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), timeout=0.5).close()
    except OSError:
        return False
    return True


def _answers_ping(port: int) -> bool:
    try:
        with socket.create_connection(("127.0.0.1", port), timeout=0.5) as redis:
            redis.sendall(b"PING\r\n")
            return redis.recv(16).startswith(b"+PONG")
    except OSError:
        return False


class Server:
    """A running server process; a context manager that stops it. Belongs to the thread that made it."""

    def __init__(
        self, name: str, folder: Path, port: int, url: str, command: list[str], ready: Callable[[int], bool]
    ) -> None:
        """Start it at once and wait until it is ready; raises `ServerError`."""
        self.name = name
        self.folder = folder
        self.port = port
        self.url = url
        self._command = command
        self._ready = ready
        self._process: subprocess.Popen[bytes] | None = None
        self.start()

    @property
    def endpoint(self) -> str:
        """The same as `url`: what zenoh calls it."""
        return self.url

    @property
    def pid(self) -> int:
        """Process id; raises `ServerError` when it is not running."""
        if self._process is None:
            raise ServerError(f"{self.name} is not running: start it first")
        return self._process.pid

    @property
    def log(self) -> Path:
        """File with everything that it printed."""
        return self.folder / f"{self.name}.log"

    def running(self) -> bool:
        """Whether the process lives."""
        return self._process is not None and self._process.poll() is None

    def start(self) -> None:
        """Start it (again, on the same port, with the same data) and wait until it is ready."""
        if self.running():
            return
        with self.log.open("ab") as log:
            self._process = self._spawn(log)
        deadline = time.monotonic() + _READY_S
        while not self._ready(self.port):
            if self._process.poll() is not None or time.monotonic() > deadline:
                self.kill()
                tail = "\n".join(self.log.read_text("utf-8", "replace").splitlines()[-8:])
                raise ServerError(f"{self.name} did not start on port {self.port}; the end of {self.log}:\n{tail}")
            time.sleep(0.01)

    def _spawn(self, log: IO[bytes]) -> subprocess.Popen[bytes]:
        # Its own session: Ctrl-C in a terminal is for whoever started it, who stops it in the right order.
        return subprocess.Popen(  # noqa: S603  # a fixed command, no shell
            self._command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, cwd=self.folder, start_new_session=True
        )

    def stop(self) -> None:
        """End it in good order (SIGTERM), or by force when it does not end within 5 s."""
        if self._process is None:
            return
        self._process.terminate()
        try:
            self._process.wait(_STOP_S)
        except subprocess.TimeoutExpired:
            self.kill()
        self._process = None

    def kill(self) -> None:
        """End it as a crash would (SIGKILL)."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None

    def restart(self) -> None:
        """Stop it in good order, if it still runs, and start it again on the same port with the same data."""
        self.stop()
        self.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def _program(name: str, package: str) -> str:
    # Debian keeps servers in /usr/sbin, which is not on every user's path.
    found = shutil.which(name) or shutil.which(name, path="/usr/sbin:/usr/local/sbin:/opt/homebrew/sbin")
    if found is None:
        raise ServerError(f"{name} is not installed: apt-get install -y --no-install-recommends {package}")
    return found


def _wrapped(command: list[str], *, die_with_parent: bool) -> list[str]:
    setpriv = shutil.which("setpriv") if die_with_parent else None
    return [setpriv, "--pdeathsig", "TERM", "--", *command] if setpriv else command


def _start(name: str, folder: Path, port: int, make: Callable[[int], Server]) -> Server:
    folder.mkdir(parents=True, exist_ok=True)
    if port:
        return make(port)
    for attempt in range(1, _ATTEMPTS + 1):
        try:
            return make(free_port())
        except ServerError:
            if attempt == _ATTEMPTS:
                raise
    raise AssertionError(name)


def start_mosquitto(folder: Path, port: int = 0, *, extra: str = "", die_with_parent: bool = False) -> Server:
    """Start an MQTT broker for anonymous clients on the loopback interface; `extra` lines end its configuration.

    With `die_with_parent` the kernel ends it when the thread that called this ends (Linux).
    """
    folder = folder.resolve()
    program = _program("mosquitto", "mosquitto")

    def make(chosen: int) -> Server:
        lines = [
            f"listener {chosen} 127.0.0.1",
            "allow_anonymous true",
            "persistence true",
            f"persistence_location {folder}/",
            "log_dest stdout",
            "log_type error",
            "log_type warning",
        ]
        if os.geteuid() == 0:
            lines.append("user root")  # else it changes to a user who may not enter the folder
        (folder / "mosquitto.conf").write_text("\n".join([*lines, extra, ""]))
        command = _wrapped([program, "-c", str(folder / "mosquitto.conf")], die_with_parent=die_with_parent)
        return Server("mosquitto", folder, chosen, f"mqtt://127.0.0.1:{chosen}", command, _accepts)

    return _start("mosquitto", folder, port, make)


def start_redis(folder: Path, port: int = 0, *, die_with_parent: bool = False) -> Server:
    """Start a Redis whose acknowledged writes survive a crash (`appendonly yes`, `appendfsync always`)."""
    folder = folder.resolve()
    program = _program("redis-server", "redis-server")

    def make(chosen: int) -> Server:
        options = {
            "--port": str(chosen), "--bind": "127.0.0.1", "--dir": str(folder), "--appendonly": "yes",
            "--appendfsync": "always", "--save": "", "--daemonize": "no",
        }  # fmt: skip
        command = [program, *(part for option in options.items() for part in option)]
        command = _wrapped(command, die_with_parent=die_with_parent)
        return Server("redis", folder, chosen, f"redis://127.0.0.1:{chosen}/0", command, _answers_ping)

    return _start("redis", folder, port, make)


def start_router(folder: Path, port: int = 0, *, die_with_parent: bool = False) -> Server:
    """Start a zenoh router (`python -m fog_runtime.router`)."""
    folder = folder.resolve()

    def make(chosen: int) -> Server:
        endpoint = f"tcp/127.0.0.1:{chosen}"
        command = [sys.executable, "-m", "fog_runtime.router", "--listen", endpoint]
        command = _wrapped(command, die_with_parent=die_with_parent)
        return Server("router", folder, chosen, endpoint, command, _accepts)

    return _start("router", folder, port, make)
