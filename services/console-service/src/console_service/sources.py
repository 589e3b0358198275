"""What is not told by a channel: fetched from the hazard-aggregator by REST, and from the audit trail in Redis.

Areas, nodes and alerts can be read without a token, so the service needs none. In Redis it has a user that may read the
audit trail and the histories of areas, and nothing else.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from typing import TYPE_CHECKING, Any, Final

import httpx
from prometheus_client import Gauge

from fog_runtime import logs
from fog_runtime.stores.records import read_newer
from fog_runtime.stores.redis_connection import RedisConnection, StoreError

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from console_service.core import ConsoleCore, Fetched
    from fog_runtime.clock import Clock
    from fog_runtime.credentials import Credentials

PATHS: Final[Mapping[Fetched, str]] = {"area": "/api/v1/areas", "node": "/api/v1/nodes", "alert": "/api/v1/alerts"}
SOON_S: Final = 0.2
"""The shortest time between two requests for the same."""
PERIOD_S: Final = 5.0
"""How often each is fetched if no message says that it has changed."""
RECORDS_S: Final = 1.0
"""How often the audit trail is read."""
TIMEOUT_S: Final = 3.0

FRESH = Gauge("fognav_console_source_fresh", "Whether the last attempt to fetch these events succeeded", ["event"])
_log = logs.get("console-service")


class Sources:
    """Fetches, and tells the core; `on_news` is called after that."""

    def __init__(  # where everything is
        self,
        core: ConsoleCore,
        clock: Clock,
        *,
        aggregator_url: str,
        redis: RedisConnection,
        credentials: Credentials,
        on_news: Callable[[], object],
    ) -> None:
        self._core = core
        self._clock = clock
        self._lost: set[str] = set()
        tls = credentials.tls_context() if aggregator_url.startswith("https:") else True
        self._client = httpx.AsyncClient(base_url=aggregator_url, timeout=TIMEOUT_S, verify=tls)
        self._redis = redis
        self._on_news = on_news
        self._positions: dict[str, str] = {}

    async def aclose(self) -> None:
        """Close the connections."""
        await self._client.aclose()

    async def fetch_loop(self, event: Fetched) -> None:
        """Fetch one kind of things: soon after a message says that they have changed, and now and then."""
        waited = PERIOD_S
        while True:
            if event in self._core.wanted or waited >= PERIOD_S:
                self._core.wanted.pop(event, None)
                waited = 0.0
                await self._fetch(event)
            await asyncio.sleep(SOON_S)
            waited += SOON_S

    async def _fetch(self, event: Fetched) -> None:
        try:
            answer = await self._client.get(PATHS[event])
            answer.raise_for_status()
            things = by_id(event, answer.json(), self._clock.stamp())
        except (httpx.HTTPError, ValueError, KeyError, TypeError) as error:
            self._tell(event, f"{self._client.base_url}{PATHS[event]}: {error!r}")
            return
        self._tell(event)
        self._core.on_fetched(event, things, self._clock.now())
        self._on_news()

    def _tell(self, event: str, trouble: str = "") -> None:
        """Log when a source is lost and when it is back; the service is ready without any."""
        FRESH.labels(event).set(not trouble)
        if trouble and event not in self._lost:
            self._lost.add(event)
            _log.warning("source_lost", source=event, reason=trouble)
        elif not trouble and event in self._lost:
            self._lost.remove(event)
            _log.info("source_back", source=event)

    async def record_loop(self) -> None:
        """Read what is new in the audit trail."""
        while True:
            try:
                for entry in await read_newer(self._redis, f"fog:{self._core.site}:audit:", self._positions):
                    self._core.on_record(entry.entry, entry)
                self._tell("record")
                self._on_news()
            except StoreError as error:
                self._tell("record", str(error))
            await asyncio.sleep(RECORDS_S)


def by_id(event: Fetched, found: list[dict[str, Any]], stamp: float) -> dict[str, Any]:
    """Return what REST lists, at `stamp` (s since the epoch), by its ids.

    A node that watches several areas is one thing in each, `AREA/NODE`. `heard` is when it was heard last: that stays
    true for as long as the event is kept, and its age does not.
    """
    if event == "area":
        return {each["definition"]["id"]: each for each in found}
    if event == "node":
        for each in found:
            each["heard"] = None if each["age_s"] is None else round(stamp - each["age_s"], 1)
    count = Counter(each["id"] for each in found)
    return {each["id"] if count[each["id"]] == 1 else f"{each['area']}/{each['id']}": each for each in found}
