"""A floor as its console shows it: the stream of events, and the REST that operators use, by a token of its own."""

from __future__ import annotations

import asyncio
import copy
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol, runtime_checkable

import httpx
import msgspec
from prometheus_client import Counter

from fog_runtime import logs
from fog_runtime.http.tokens import PART

if TYPE_CHECKING:
    import ssl
    from collections.abc import AsyncIterator, Sequence

    from starlette.routing import WebSocketRoute

    from fog_runtime.clock import Clock

ORDERS = Counter("fognav_bridge_orders_total", "Orders of other systems, by what became of them", ["system", "result"])
REFUSED = Counter(
    "fognav_bridge_refused_messages_total", "Messages of other systems that were not understood", ["system", "reason"]
)
"""What all adapters count."""
RETRY_S: Final = 2.0
SILENT_S: Final = 5.0
"""A stream that says nothing for so long is lost: the console tells the time each second."""
REQUEST_S: Final = 10.0
LINE_MAX: Final = 16 << 20
"""Bytes of a line of the events: a longer one is no console's, and must not fill the memory."""
_log = logs.get("floor")


class Request(NamedTuple):
    """A request to the floor's REST; `body` is sent as JSON, None: without one."""

    method: str
    path: str
    body: dict[str, Any] | None = None
    headers: dict[str, str] | None = None


class Answer(NamedTuple):
    """What the floor answered: why it refused, in words (empty: it did not), the problem's identifier, and the body.

    Without an identifier nobody knows whether the request was carried out.
    """

    refusal: str
    problem: str = ""
    body: dict[str, Any] = {}  # noqa: RUF012  # nobody changes it


class Adapter(Protocol):
    """Who tells another system of the floor."""

    @property
    def name(self) -> str:
        """Which system, as settings and logs name it."""

    @property
    def problem(self) -> str:
        """Why the other system is told nothing; empty while it is."""

    async def run(self, floor: Floor, clock: Clock) -> None:
        """Connect, and do all until cancelled."""

    def on_event(self, name: str, data: dict[str, Any]) -> object:
        """Take in an event of the floor."""

    def on_lost(self) -> object:
        """Take in that nobody knows the floor's state."""


@runtime_checkable
class ServesSockets(Protocol):
    """An adapter to which other systems connect."""

    @property
    def routes(self) -> Sequence[WebSocketRoute]:
        """What the bridge serves of it."""


WAITS: Final = "the robot waits for an operator of Fognav, who enables it: send the goal again then"
"""Why such a robot gets no goal: it would wait, and drive off when somebody enables the robot for something else."""


class Floor:
    """Reads the events of one floor, again and again from where it was, and sends requests."""

    def __init__(self, url: str, token: str, trusted: ssl.SSLContext | bool) -> None:  # noqa: FBT001  # httpx's `verify`
        """`url` is the console's address, `trusted` whose certificates it may have."""
        self._client = httpx.AsyncClient(
            base_url=url, headers={"Authorization": f"Bearer {token}"}, timeout=REQUEST_S, verify=trusted
        )
        self._part: dict[str, str] = {}
        self._last_id = ""
        self.problem = "not connected yet"
        """Why the events are not up to date; empty while they are."""

    def of(self, adapter: str) -> Floor:
        """Return the same floor for one adapter, whose name the audit trail has behind that of the token."""
        found = copy.copy(self)
        found._part = {PART: adapter}  # noqa: SLF001  # of the same class
        return found

    async def aclose(self) -> None:
        """Close the connections."""
        await self._client.aclose()

    async def send(self, request: Request) -> str:
        """Send a request; return why it was refused, in the floor's words, empty if it was not."""
        return (await self.ask(request)).refusal

    async def ask(self, request: Request) -> Answer:
        """Send a request; return the answer."""
        try:
            answer = await self._client.request(
                request.method, request.path, json=request.body, headers=self._part | (request.headers or {})
            )
        except httpx.HTTPError as error:
            return Answer(f"the floor can't be reached: {error!r}")
        try:
            body = answer.json()
            if answer.is_success:
                return Answer("", body=body if isinstance(body, dict) else {})
            return Answer(str(body["detail"]), str(body["type"]).removeprefix("urn:fognav:"), body)
        except (ValueError, KeyError, TypeError):
            return Answer("" if answer.is_success else f"{answer.status_code} {answer.reason_phrase}")

    async def role_of(self, token: str) -> str | None:
        """Return the role of whoever has a token, empty for nobody's; None while the floor does not say."""
        try:
            answer = await self._client.get("/api/v1/session", headers={"Authorization": f"Bearer {token}"})
            if answer.status_code == httpx.codes.UNAUTHORIZED:
                return ""
            return str(answer.raise_for_status().json()["role"])
        except (httpx.HTTPError, ValueError, KeyError) as error:
            _log.warning("caller_unknown", reason=repr(error))
            return None

    async def follow(self, adapters: Sequence[Adapter]) -> None:
        """Pass each event on to all adapters, and when the state is not known any more, that. Never returns."""
        while True:
            try:
                async with self._client.stream(
                    "GET", "/api/v1/events", headers=self._resumed(), timeout=SILENT_S
                ) as lines:
                    if not lines.is_success:
                        await lines.aread()
                    lines.raise_for_status()
                    async for name, data in self._events(lines):
                        self.problem = ""
                        for each in adapters:
                            each.on_event(name, data)
                problem = "the console ended the stream"
            except (httpx.HTTPError, msgspec.MsgspecError) as error:
                problem = f"{self._client.base_url}api/v1/events: {error!r}"
            if not self.problem or self.problem != problem:
                _log.warning("floor_lost", reason=problem)
            self.problem = problem
            for each in adapters:
                each.on_lost()
            await asyncio.sleep(RETRY_S)

    def _resumed(self) -> dict[str, str]:
        return {"Last-Event-ID": self._last_id} if self._last_id else {}

    async def _events(self, lines: httpx.Response) -> AsyncIterator[tuple[str, dict[str, Any]]]:
        """Yield events (server-sent, WHATWG HTML 9.2; the console's data have one line)."""
        name, data, position = "message", "", ""
        async for line in whole_lines(lines.aiter_bytes()):
            field, _, value = line.partition(":")
            value = value.removeprefix(" ")
            if field == "id":
                position = value
            elif field == "event":
                name = value
            elif field == "data":
                data = value
            elif not line and data:
                yield name, msgspec.json.decode(data, type=dict[str, Any])
                self._last_id = position or self._last_id
                name, data, position = "message", "", ""


async def whole_lines(parts: AsyncIterator[bytes], most: int = LINE_MAX) -> AsyncIterator[str]:
    """Yield lines without their ends, LF or CR LF; what follows the last end is left out.

    httpx's own lines, as those of `str.splitlines`, also end at characters that JSON has as they are, such as U+2028.
    Raises `httpx.DecodingError` for a line of more than `most` bytes.
    """
    rest = bytearray()
    async for part in parts:
        rest += part
        if b"\n" in part:
            *whole, rest = rest.split(b"\n")
            for line in whole:
                yield str(line.removesuffix(b"\r"), "utf-8", "replace")
        if len(rest) > most:
            raise httpx.DecodingError(f"a line has more than {most} bytes: look what runs at console_url")
