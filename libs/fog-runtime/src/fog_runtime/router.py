"""A zenoh router process: `python -m fog_runtime.router --listen tcp/127.0.0.1:7447`.

With `--certificate` and `--key` it encrypts (`--listen tls/…`), with `--users` it admits only these, and with
`--access` each of them may only do what that list allows. With `--health-port` it says at `/readyz` of this computer
whether it answers its clients (`router_health`).
"""

import argparse
import asyncio
import contextlib
import json
import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import zenoh

from fog_runtime import logs, process
from fog_runtime.access.credentials import Credentials
from fog_runtime.health import serve_health
from fog_runtime.router_health import RouterHealth
from fog_runtime.transports.zenoh_edge import session_config

_log = logs.get("router")

_LOCKS = {
    "--certificate": "its certificate, for --listen tls/ADDRESS:PORT",
    "--key": "the certificate's private key",
    "--users": "who is admitted: name:password by line",
    "--access": "what each user may do",
    "--credentials": "its own, for the routers at --connect",
}


class RouterLocksError(ValueError):
    """A file of the router's locks can't be used; the message names the file and the remedy."""


@dataclass(frozen=True, kw_only=True)
class RouterLocks:
    """Whom a router admits, and what for: files with its certificate and key (PEM), users (`name:password` by line).

    `access` is zenoh's `access_control` (JSON5), as `fognav channels --format acl` writes it; `credentials` are those
    with which it connects to other routers.
    """

    certificate: Path | None = None
    key: Path | None = None
    users: Path | None = None
    access: Path | None = None
    credentials: Path | None = None

    def config(self, listen: Sequence[str], connect: Sequence[str]) -> zenoh.Config:
        """Return the router's configuration; raises `RouterLocksError` or `CredentialsError`."""
        for file in (self.certificate, self.key, self.users, self.access):
            if file is not None and not file.is_file():
                raise RouterLocksError(f"{file} does not exist: create it (fognav ca create), or correct its name")
        own = Credentials.read(self.credentials)
        config = session_config("router", listen=listen, connect=connect, credentials=own)
        if self.access is not None:
            rules = json.loads(zenoh.Config.from_file(str(self.access)).get_json("access_control"))
            config.insert_json5("access_control", json.dumps(rules))
        if self.certificate is not None:
            config.insert_json5("transport/link/tls/listen_certificate", json.dumps(str(self.certificate)))
            config.insert_json5("transport/link/tls/listen_private_key", json.dumps(str(self.key)))
        if self.users is not None:
            config.insert_json5("transport/auth/usrpwd/dictionary_file", json.dumps(str(self.users)))
            if not any(own.login("zenoh", each, "", encrypted=True) for each in connect):
                # zenoh checks nobody's password without one of its own.
                config.insert_json5("transport/auth/usrpwd/user", json.dumps("router"))
                config.insert_json5("transport/auth/usrpwd/password", json.dumps(secrets.token_urlsafe()))
        return config


@dataclass(frozen=True, kw_only=True)
class HealthPort:
    """Where a router says whether it answers: a port of this computer, and as whom it asks itself."""

    port: int
    credentials: Path | None = None

    def health(self, listen: str) -> RouterHealth:
        """Return the health of a router that listens there; raises `CredentialsError`."""
        protocol, _, rest = listen.partition("/")
        port = rest.partition("?")[0].rpartition(":")[2]
        return RouterHealth(f"{protocol}/localhost:{port}", Credentials.read(self.credentials))


async def run_router(
    listen: Sequence[str],
    connect: Sequence[str] = (),
    locks: RouterLocks | None = None,
    health_port: HealthPort | None = None,
) -> None:
    """Route between the clients of the endpoints `listen`, and those of the routers `connect`, until cancelled.

    Routers at `connect` need not be up yet. Without `locks` everybody is admitted. Raises `zenoh.ZError` if an endpoint
    of `listen` is taken, `OSError` if the port of its health is, and as `RouterLocks.config`.
    """
    health = None if health_port is None else health_port.health(listen[0])
    session = await asyncio.to_thread(zenoh.open, (locks or RouterLocks()).config(listen, connect))
    try:
        _log.info("listening", endpoints=list(listen), zid=str(session.zid()))
        with contextlib.ExitStack() as stack:
            if health_port is not None and health is not None:
                stack.enter_context(serve_health(health, port=health_port.port))
            await asyncio.get_running_loop().create_future()
    finally:
        await asyncio.to_thread(session.close)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run a router until SIGTERM."""
    parser = argparse.ArgumentParser(prog="fog_runtime.router", description="Run a zenoh router until SIGTERM.")
    parser.add_argument("--listen", action="append", required=True, metavar="tls/ADDRESS:PORT")
    parser.add_argument(
        "--connect", action="append", default=[], metavar="tcp/ADDRESS:PORT", help="another router of the same site"
    )
    for option, what in _LOCKS.items():
        parser.add_argument(option, type=Path, metavar="FILE", help=what)
    parser.add_argument("--health-port", type=int, metavar="PORT", help="of this computer, where /readyz is served")
    parser.add_argument("--health-credentials", type=Path, metavar="FILE", help="as whom it asks itself for /readyz")
    parser.add_argument("--log-level", default="info", choices=["debug", "info", "warning", "error"])
    parser.add_argument("--log-format", default="json", choices=["json", "text"])
    options = parser.parse_args(arguments)
    logs.configure("router", options.log_level, options.log_format)
    if (options.certificate is None) != (options.key is None):
        parser.error("--certificate and --key belong together")
    locks = RouterLocks(**{option.removeprefix("--"): getattr(options, option.removeprefix("--")) for option in _LOCKS})
    health = None
    if options.health_port is not None:
        health = HealthPort(port=options.health_port, credentials=options.health_credentials)
    process.run(lambda: run_router(options.listen, options.connect, locks, health))


if __name__ == "__main__":
    main()
