"""A zenoh router process: `python -m fog_runtime.router --listen tcp/127.0.0.1:7447`.

With `--certificate` and `--key` it encrypts (`--listen tls/…`), with `--users` it admits only these, and with
`--access` each of them may only do what that list allows. With `--health-port` it says at `/readyz` of this computer
whether it answers its clients (`RouterHealth`).

Zenoh itself listens on a Unix socket, and gets only those connections that a relay has encrypted: connections that say
nothing, or leave again, would keep it from everybody else (ADR 55, docs/upstream/zenoh-accept-loop.md). A router
to which no session can be opened for a while ends, to be started again.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import faulthandler
import json
import math
import secrets
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import zenoh

from fog_runtime import admission, logs, machine, process
from fog_runtime.credentials import Credentials
from fog_runtime.health import Health, serve_health
from fog_runtime.relay import Relay, ZenohOpening, place_of, server_tls, to_socket
from fog_runtime.transports.zenoh_edge import session_config

if TYPE_CHECKING:
    import ssl
    from collections.abc import Sequence

ANSWERS: Final = "answers"
"""The condition: a session can be opened."""
OPEN_S: Final = 1.5
"""How long that may take: less than a container's check waits for the answer (deploy/images/ready)."""

AGAIN_S: Final = 15.0
"""For how long an answer is good: a session costs a small computer half a second of processor time."""

_log = logs.get("router")


class RouterHealth(Health):
    """Health of a router, which is asked for a report unless it has answered just before.

    A router whose process runs may still serve nobody: stopped, out of file descriptors, with a certificate that
    expired. That its port accepts connections says nothing, for the operating system accepts them in its name.
    """

    def __init__(self, endpoint: str, credentials: Credentials) -> None:
        """Ask at an endpoint such as `tls/localhost:7447`, as a user who need not have any right.

        Raises `CredentialsError` if the endpoint would reveal the password.
        """
        super().__init__(ANSWERS)
        self._endpoint = endpoint
        self._config = session_config("client", connect=[endpoint], credentials=credentials)
        self._config.insert_json5("connect/timeout_ms", json.dumps(round(1000 * OPEN_S)))
        self._config.insert_json5("connect/exit_on_failure", "true")
        self._one_at_a_time = threading.Lock()
        self._answered_at = -math.inf

    def report(self) -> dict[str, Any]:
        """Open and close a session, and return what came of it, or of the last one; takes `OPEN_S` at most."""
        with self._one_at_a_time:
            if time.monotonic() - self._answered_at > AGAIN_S:
                answers, problem = self._ask()
                self._answered_at = time.monotonic() if answers else -math.inf
                self.set(ANSWERS, answers, problem)
        return super().report()

    def _ask(self) -> tuple[bool, str]:
        try:
            with zenoh.open(self._config) as session:
                known = list(session.info.routers_zid())
        except zenoh.ZError as error:
            return False, f"no session within {OPEN_S:g} s at {self._endpoint}: {error}"
        return bool(known), "" if known else f"the session at {self._endpoint} ended at once"


WATCH_S: Final = 5.0
"""How often the router looks whether a session can be opened to it (it asks itself less often while that works)."""
DEAF_S: Final = 40.0
"""After how long without any such session it ends: longer than a small computer is busy with its start."""
HANGS_S: Final = 60.0
"""After how long without such a look it is ended: its loop, or the interpreter, hangs."""

_SECURITY = {
    "--certificate": "its certificate, for --listen tls/ADDRESS:PORT",
    "--key": "the certificate's private key",
    "--users": "who is admitted: name:password by line",
    "--access": "what each user may do",
    "--credentials": "its own, for the routers at --connect",
}


class RouterSecurityError(ValueError):
    """A file of the router's credentials can't be used; the message names the file and the remedy."""


@dataclass(frozen=True, kw_only=True)
class RouterSecurity:
    """Whom a router admits, and what for: files with its certificate and key (PEM), users (`name:password` by line).

    `access` is zenoh's `access_control` (JSON5), as `fognav channels --format acl` writes it; `credentials` are those
    with which it connects to other routers.
    """

    certificate: Path | None = None
    key: Path | None = None
    users: Path | None = None
    access: Path | None = None
    credentials: Path | None = None

    def tls(self) -> ssl.SSLContext:
        """Return what its clients encrypt by; raises `RouterSecurityError` or `CertificateError`."""
        if self.certificate is None or self.key is None:
            raise RouterSecurityError("--listen tls/… needs --certificate and --key, or write tcp/…")
        return server_tls(self.certificate, self.key)

    def config(self, listen: Sequence[str], connect: Sequence[str]) -> zenoh.Config:
        """Return the router's configuration; raises `RouterSecurityError` or `CredentialsError`."""
        for file in (self.certificate, self.key, self.users, self.access):
            if file is not None and not file.is_file():
                raise RouterSecurityError(f"{file} does not exist: create it (fognav ca create), or correct its name")
        own = Credentials.read(self.credentials)
        config = session_config("router", listen=listen, connect=connect, credentials=own)
        if self.access is not None:
            rules = json.loads(zenoh.Config.from_file(str(self.access)).get_json("access_control"))
            config.insert_json5("access_control", json.dumps(rules))
        # As many as the relay lets through that have not proved who they are, and some.
        config.insert_json5("transport/unicast/accept_pending", json.dumps(2 * admission.STRANGERS))
        if self.users is not None:
            config.insert_json5("transport/auth/usrpwd/dictionary_file", json.dumps(str(self.users)))
            if not any(own.login("zenoh", each, "", encrypted=True) for each in connect):
                # zenoh checks nobody's password without one of its own.
                config.insert_json5("transport/auth/usrpwd/user", json.dumps("router"))
                config.insert_json5("transport/auth/usrpwd/password", json.dumps(secrets.token_urlsafe()))
        return config


class RouterDeafError(Exception):
    """No session can be opened to this router."""


@dataclass(frozen=True, kw_only=True)
class HealthPort:
    """How a router finds out whether it answers: as whom it asks itself, and the port of this computer that tells."""

    port: int | None = None
    credentials: Path | None = None

    def health(self, listen: str) -> RouterHealth:
        """Return the health of a router that listens there; raises `CredentialsError`."""
        protocol = listen.partition("/")[0]
        host, port = place_of(listen)
        if host in ("0.0.0.0", "::", "127.0.0.1", "::1"):  # noqa: S104  # compared, not listened on
            host = "localhost"
        return RouterHealth(
            f"{protocol}/{f'[{host}]' if ':' in host else host}:{port}", Credentials.read(self.credentials)
        )


async def run_router(
    listen: Sequence[str],
    connect: Sequence[str] = (),
    security: RouterSecurity | None = None,
    health_port: HealthPort | None = None,
) -> None:
    """Route between the clients of the endpoints `listen`, and those of the routers `connect`, until cancelled.

    Routers at `connect` need not be up yet. Without `security` everybody is admitted. Raises `OSError` if an endpoint
    of `listen` or the port of its health is taken, `RouterDeafError` when its clients can't reach it any more, and as
    `RouterSecurity.config`.
    """
    security = security or RouterSecurity()
    health = None if health_port is None else health_port.health(listen[0])
    machine.raise_limit()
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="fognav-router-")))
        own = folder / "zenoh"
        relays, listeners = [], []
        for endpoint in listen:
            encrypts = endpoint.startswith("tls/")
            tls = security.tls() if encrypts else None
            relays.append(Relay(to_socket(own), ZenohOpening, tls))
            listeners.append(stack.enter_context(admission.listen(*place_of(endpoint))))
        session = await asyncio.to_thread(zenoh.open, security.config([f"unixsock-stream/{own}"], connect))
        try:
            _log.info("listening", endpoints=list(listen), zid=str(session.zid()))
            if health_port is not None and health is not None and health_port.port is not None:
                stack.enter_context(serve_health(health, port=health_port.port))
            async with asyncio.TaskGroup() as tasks:
                for relay, listener in zip(relays, listeners, strict=True):
                    tasks.create_task(relay.serve([listener]))
                if health is not None:
                    tasks.create_task(_watch(health))
        finally:
            await asyncio.to_thread(session.close)


async def _watch(health: Health) -> None:
    """Raise `RouterDeafError` once no session could be opened for `DEAF_S`."""
    answered_at = time.monotonic()
    while True:
        faulthandler.dump_traceback_later(HANGS_S, exit=True)
        await asyncio.sleep(WATCH_S)
        report = await asyncio.to_thread(health.report)
        if report["ready"]:
            answered_at = time.monotonic()
        elif time.monotonic() - answered_at > DEAF_S:
            faulthandler.dump_traceback_later(process.ENDING_S, exit=True)  # a session of it may not end, either
            raise RouterDeafError(report["parts"][ANSWERS]["detail"])


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a router until SIGTERM."""
    parser = argparse.ArgumentParser(prog="fog_runtime.router", description="Run a zenoh router until SIGTERM.")
    parser.add_argument("--listen", action="append", required=True, metavar="tls/ADDRESS:PORT")
    parser.add_argument(
        "--connect", action="append", default=[], metavar="tcp/ADDRESS:PORT", help="another router of the same site"
    )
    for option, what in _SECURITY.items():
        parser.add_argument(option, type=Path, metavar="FILE", help=what)
    parser.add_argument("--health-port", type=int, metavar="PORT", help="of this computer, where /readyz is served")
    parser.add_argument(
        "--health-credentials", type=Path, metavar="FILE", help="as whom it asks itself whether it answers"
    )
    parser.add_argument("--log-level", default="info", choices=["debug", "info", "warning", "error"])
    parser.add_argument("--log-format", default="json", choices=["json", "text"])
    options = parser.parse_args(arguments)
    logs.configure("router", options.log_level, options.log_format)
    if (options.certificate is None) != (options.key is None):
        parser.error("--certificate and --key belong together")
    security = RouterSecurity(
        **{option.removeprefix("--"): getattr(options, option.removeprefix("--")) for option in _SECURITY}
    )
    health = None
    if options.health_port is not None or options.health_credentials is not None or options.users is None:
        health = HealthPort(port=options.health_port, credentials=options.health_credentials)
    process.run(lambda: run_router(options.listen, options.connect, security, health))


if __name__ == "__main__":
    main()
