"""Servers behind the credentials of a site, as in the field: what is off in tests is broken there."""

from __future__ import annotations

from contextlib import contextmanager
from typing import TYPE_CHECKING, Final

from fog_runtime.credentials import VARIABLE, Credentials
from fog_runtime.security.site_security import SiteSecurity
from fog_supervisor.servers import Server, start_mosquitto, start_redis, start_router

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

TESTER: Final = "test"
"""A user who may do everything on broker and router: it stands for all processes that a test does not run."""


class SecuredSite:
    """The credentials of a site in a folder, and its servers."""

    def __init__(self, folder: Path, site: str, *, robots: Sequence[str] = (), nodes: Sequence[str] = ()) -> None:
        """Make the credentials for these robots and nodes."""
        self._folder = folder
        self.security = SiteSecurity(folder / "locks", site, unrestricted=[TESTER])
        self.security.make(["127.0.0.1", "localhost"], robots=robots, nodes=nodes)

    def environment(self, user: str) -> dict[str, str]:
        """Return the variable by which a process is this user."""
        return {VARIABLE: str(self.security.credentials(user))}

    def credentials(self, user: str = TESTER) -> Credentials:
        """Return a user's credentials."""
        return Credentials.read(self.security.credentials(user))

    def mosquitto(self) -> Server:
        """Start the broker."""
        return start_mosquitto(self._folder / "mosquitto", security=self.security.folder("mosquitto"))

    def redis(self) -> Server:
        """Start Redis."""
        return start_redis(self._folder / "redis", security=self.security.folder("redis"))

    def router(self) -> Server:
        """Start the router."""
        return start_router(self._folder / "router", security=self.security.folder("zenoh"))


class SecuredRouter:
    """A running router, and the credentials of its site."""

    def __init__(self, server: Server, site: SecuredSite) -> None:
        self.url = server.url
        self.site = site


@contextmanager
def secured_router(folder: Path, site: str, *, robots: Sequence[str] = ()) -> Iterator[SecuredRouter]:
    """Run a router with credentials for these robots."""
    secured = SecuredSite(folder, site, robots=robots)
    with secured.router() as server:
        yield SecuredRouter(server, secured)
