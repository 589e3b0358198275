"""Liveness and readiness: named conditions, and a small HTTP server that reports them at an address for others."""

import ipaddress
import json
import selectors
import socket
import sys
import threading
from collections.abc import Sequence
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any, Final, Self

from fog_runtime import logs, metrics
from fog_runtime.files import write_port_file

_ANY: Final = ("", "0.0.0.0", "::")  # noqa: S104  # compared with, not listened on

_log = logs.get("health")


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


class Health:
    """Named conditions of readiness; any thread may set and read them."""

    def __init__(self, *needed: str) -> None:
        """Start with the `needed` conditions unmet, so that the process is not ready before all are set."""
        self._lock = threading.Lock()
        for name in needed:
            metrics.CONDITION.labels(name).set(0)
        self._conditions: dict[str, tuple[bool, str]] = dict.fromkeys(needed, (False, "not started"))

    def set(self, name: str, ok: bool, detail: str = "") -> None:  # noqa: FBT001  # set("redis", True) reads well
        """Set whether a condition is met, and if not, why."""
        with self._lock:
            before = self._conditions.get(name)
            self._conditions[name] = (ok, detail)
        metrics.CONDITION.labels(name).set(ok)
        if before is None or before[0] != ok:
            _log.info("readiness_changed", condition=name, ok=ok, detail=detail)

    @property
    def ready(self) -> bool:
        """Whether every condition is met."""
        return not self.missing

    @property
    def missing(self) -> list[str]:
        """The names of the unmet conditions."""
        with self._lock:
            return [name for name, (ok, _) in self._conditions.items() if not ok]

    def report(self) -> dict[str, Any]:
        """Return readiness, the names of the unmet conditions, and every condition with its detail."""
        with self._lock:
            conditions = dict(self._conditions)
        missing = [name for name, (ok, _) in conditions.items() if not ok]
        return {
            "ready": not missing,
            "missing": missing,
            "parts": {name: {"ok": ok, "detail": detail} for name, (ok, detail) in conditions.items()},
        }


class _Server(ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, _request: object, client_address: object) -> None:
        """Log what ended a request, which nearly always is that its client has gone; the base writes a traceback."""
        _log.debug("request_failed", client=str(client_address), reason=repr(sys.exception()))


class HealthServer:
    """A running health server; close it, or use it as a context manager."""

    def __init__(self, server: ThreadingHTTPServer) -> None:
        self._server = server
        self._end, self._ended = socket.socketpair()
        self._thread = threading.Thread(target=self._serve, name="health", daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        # `serve_forever` would look several times a second whether it shall end: work for an idle robot.
        with selectors.DefaultSelector() as selector:
            selector.register(self._server, selectors.EVENT_READ)
            selector.register(self._ended, selectors.EVENT_READ)
            while all(key.fileobj is self._server for key, _ in selector.select()):
                self._server.handle_request()

    @property
    def port(self) -> int:
        """The port it listens on."""
        return self._server.server_port

    def close(self) -> None:
        """Stop listening."""
        self._end.close()
        self._thread.join()
        self._ended.close()
        self._server.server_close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def serve_health(health: Health, host: str = "127.0.0.1", port: int = 0, port_file: Path | None = None) -> HealthServer:
    """Serve /healthz, /readyz (503 names what is missing) and /metrics from a thread; port 0: any free port."""

    class Handler(BaseHTTPRequestHandler):
        timeout = 5.0  # seconds until a silent client is dropped

        def do_GET(self) -> None:  # the name is http.server's
            path = self.path.partition("?")[0]
            if path == "/healthz":
                self._send(HTTPStatus.OK, b'{"status":"ok"}')
            elif path == "/readyz":
                report = health.report()
                status = HTTPStatus.OK if report["ready"] else HTTPStatus.SERVICE_UNAVAILABLE
                self._send(status, json.dumps(report).encode())
            elif path == "/metrics":
                self._send(HTTPStatus.OK, *metrics.exposition())
            else:
                self._send(HTTPStatus.NOT_FOUND, b'{"status":404,"title":"Not Found"}', "application/problem+json")

        def _send(self, status: HTTPStatus, body: bytes, kind: str = "application/json") -> None:
            self.send_response(status)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:  # noqa: A002  # the name is http.server's
            _log.debug("request_served", line=format % args)

    server = _Server((host, port), Handler)
    running = HealthServer(server)
    _log.info("listening", url=f"http://{host}:{running.port}", port=running.port)
    write_port_file(port_file, running.port)
    return running
