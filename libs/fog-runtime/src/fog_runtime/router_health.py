"""Whether a zenoh router answers, asked as its clients ask: by opening a session over its own listener.

A router whose process runs may still serve nobody: stopped, out of file descriptors, with a certificate that expired.
That its port accepts connections says nothing, for the operating system accepts them in its name.
"""

from __future__ import annotations

import json
import math
import threading
import time
from typing import TYPE_CHECKING, Any, Final

import zenoh

from fog_runtime.health import Health
from fog_runtime.transports.zenoh_edge import session_config

if TYPE_CHECKING:
    from fog_runtime.access.credentials import Credentials

ANSWERS: Final = "answers"
"""The condition: a session can be opened."""
OPEN_S: Final = 1.5
"""How long that may take: less than a container's check waits for the answer (deploy/images/ready)."""

AGAIN_S: Final = 15.0
"""For how long an answer is good: a session costs a small computer half a second of processor time."""


class RouterHealth(Health):
    """Health of a router, which is asked for a report unless it has answered just before."""

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
