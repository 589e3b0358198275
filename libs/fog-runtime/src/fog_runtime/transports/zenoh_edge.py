"""The transport of the robot side: typed publishing, subscribing, querying and answering on zenoh channels.

A session is a client of the site's routers. A router serves clients, unlike peers, without their knowing one another
(zenoh 1.9 and later never route between peers), and a robot that comes or goes changes no other routes. A client's
session can't be opened while no router is up; what was declared before is declared when it opens.
"""

import asyncio
import base64
import json
import os
import random
import threading
from collections.abc import AsyncIterator, Callable, Coroutine, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from typing import Any, Final, Literal, TypeVar
from urllib.parse import urlsplit

import zenoh

from fog_contracts.channels import LIVE, Channel, Role
from fog_contracts.codec import decode, encode
from fog_contracts.messages import Message
from fog_runtime import logs, metrics
from fog_runtime.clock import Clock
from fog_runtime.concurrency import Slot
from fog_runtime.credentials import NOBODY, Credentials
from fog_runtime.transports.zenoh_declarations import (
    CACHE_DEPTH,
    Answer,
    Ids,
    PolledSubscription,
    Publishers,
    Queryable,
    Subscription,
)
from fog_runtime.transports.zenoh_query import ask, ask_who_is_present

M = TypeVar("M", bound=Message)

_KEYS: Final = 256
"""Keys that are remembered, and not checked and put together again for each message."""
_RETRY_S: Final = (0.2, 1.0)
_ENCRYPTED: Final = ("tls/", "quic/")

_log = logs.get("zenoh")


def use_one_thread() -> None:
    """Let zenoh work on one thread of this process; call it before the first session is opened.

    Its usual four or five wake one another for each message. One is enough for a process of few and small messages,
    and costs a small computer less. A variable ZENOH_RUNTIME that is set already has priority.
    """
    os.environ.setdefault("ZENOH_RUNTIME", "(rx: (handover: app), tx: (handover: app), net: (handover: app))")


def session_config(
    mode: Literal["client", "router", "peer"],
    *,
    connect: Sequence[str] = (),
    listen: Sequence[str] = (),
    credentials: Credentials = NOBODY,
) -> zenoh.Config:
    """Build a configuration without scouting and shared memory: a session connects only to the given endpoints.

    Endpoints are `tcp/host:port`, or `tls/host:port` for encrypted connections. `credentials` prove who this session is
    to what it connects to. Raises `CredentialsError` if an endpoint would reveal the password in them.
    """
    config = zenoh.Config()
    values: dict[str, object] = {
        "mode": mode,
        "connect/endpoints": list(connect),
        "listen/endpoints": list(listen),
        "connect/retry": {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        "timestamping/enabled": True,
    }
    for endpoint in connect:
        login = credentials.login("zenoh", endpoint, _host(endpoint), encrypted=endpoint.startswith(_ENCRYPTED))
        if login is not None:
            values["transport/auth/usrpwd"] = {"user": login[0], "password": login[1]}
    if credentials.authority:
        authority = base64.b64encode(credentials.authority.encode()).decode()
        values["transport/link/tls/root_ca_certificate_base64"] = authority
    for key, value in values.items():
        config.insert_json5(key, json.dumps(value))
    return config


def _host(endpoint: str) -> str:
    """Return the host of an endpoint such as `tcp/[::1]:7447?option=value`."""
    return urlsplit("//" + endpoint.partition("/")[2]).hostname or ""


class ZenohEdge:
    """The zenoh session of a process. All handlers run on the thread of the event loop that opened it.

    Everything but `publish` is called on that thread.
    """

    def __init__(
        self, clock: Clock, *, site: str, role: Role, name: str, connect: Sequence[str], credentials: Credentials
    ) -> None:
        """Prepare a session; use `ZenohEdge.open`."""
        self._connect = connect
        self._credentials = credentials
        self._config()  # raises now, not whenever a router is up
        self._clock = clock
        self._site = site
        self._client_name = f"{role}/{name}"
        self._own_presence = LIVE.key(site=site, role=role, id=name)
        self._loop = asyncio.get_running_loop()
        self._session: zenoh.Session | None = None
        self._closed = False
        self._publishers = Publishers(self._declare)
        self._lock = threading.Lock()
        """Held while the session begins to take declarations."""
        self._declared: list[object] = []
        self._polled: list[PolledSubscription[Any]] = []
        self._keys: dict[tuple[object, ...], str] = {}
        """Keys by channel and ids, which are the same ones again and again."""
        self._ids_of_keys: dict[tuple[str, str], Ids] = {}
        self._undeclared: list[Callable[[zenoh.Session], object]] = []
        self._tasks: set[asyncio.Task[None]] = set()
        self._limited = logs.RateLimited(_log)
        # Requests and replies may block while a connection is congested: never on the loop's thread.
        self._threads = ThreadPoolExecutor(4, thread_name_prefix="zenoh")

    @classmethod
    @asynccontextmanager
    async def open(
        cls,
        *,
        connect: Sequence[str],
        clock: Clock,
        role: Role,
        id: str,  # noqa: A002  # as in the channel `live`
        site: str,
        credentials: Credentials = NOBODY,
    ) -> AsyncIterator["ZenohEdge"]:
        """Open a session as a client of one of the routers `connect`; while none is reachable it keeps trying.

        Without any, nothing is ever sent or received.

        `role` and `id` identify the process in logs; `site` is filled into every key. Raises
        `CredentialsError` if an endpoint would reveal the password in the `credentials`.
        """
        edge = cls(clock, site=site, role=role, name=id, connect=connect, credentials=credentials)
        connecting: asyncio.Task[None] | None = None
        try:
            if connect and not await edge._try_connect():
                connecting = asyncio.create_task(edge._connect_when_possible(), name="zenoh connect")
            yield edge
        finally:
            if connecting is not None:
                connecting.cancel()
                await asyncio.gather(connecting, return_exceptions=True)
            await edge._close()

    @property
    def site(self) -> str:
        """The site that is filled into every key."""
        return self._site

    @property
    def closed(self) -> bool:
        """Whether its session is closed, or about to be."""
        return self._closed

    @property
    def connected(self) -> bool:
        """Whether a router is connected right now."""
        return self._session is not None and not self._closed and bool(self._session.info.routers_zid())

    def publish(self, channel: Channel, message: Message, **ids: str) -> None:
        """Publish without waiting, from any thread; raises `ContractError` for a message that violates its contract.

        Without a connection the message is lost, except on channels of durability `recovered` and, for the latest
        message, `latest`: these messages reach their subscribers as soon as there is a connection, but for those that
        a newer one overtakes meanwhile. One that zenoh fails to send is lost, logged and counted.
        """
        key = self._key(channel, ids)
        data = encode(channel, message)
        try:
            self._publishers.of(channel, key).put(data)
        except zenoh.ZError as error:
            # Whoever publishes goes on: it would end the loop of a process.
            metrics.DROPPED.labels(channel.name).inc()
            self._limited.warning("message_dropped", key, self._clock.now(), key=key, reason=str(error))

    def subscribe(self, channel: Channel, kind: type[M], handler: Callable[[Ids, M], object], **ids: str) -> None:
        """Call `handler(ids, message)` for each message, with every value of the ids that are not given.

        When the loop is behind, only the newest message of each key is delivered, except on recovered channels: all
        messages since the first are delivered, in the publisher's order.
        """
        self._check(channel, ids)
        pattern = channel.pattern(**self._with_site(channel, ids))
        self._declare(Subscription(self, channel, kind, handler, pattern).declare)

    def subscribe_polled(
        self, channel: Channel, kind: type[M], handler: Callable[[Ids, M], object], **ids: str
    ) -> None:
        """Subscribe as `subscribe` does, but deliver only when `poll` is called, the newest messages.

        For a process that looks often anyhow: it is not woken for each message. The channel must be volatile.
        """
        self._check(channel, ids)
        if CACHE_DEPTH[channel.durability]:
            raise ValueError(f"messages of channel {channel.name} must not be lost: it can't be polled")
        pattern = channel.pattern(**self._with_site(channel, ids))
        polled = PolledSubscription(self, channel, kind, handler, pattern)
        self._polled.append(polled)
        self._declare(polled.declare)

    def poll(self) -> None:
        """Deliver what has arrived on the polled channels."""
        for subscription in self._polled:
            subscription.poll()

    def latest(self, channel: Channel, kind: type[M], **ids: str) -> Slot[M]:
        """Return a slot that holds the newest message of one key."""
        self._key(channel, ids)
        slot: Slot[M] = Slot()
        self.subscribe(channel, kind, lambda _, message: slot.put(message, self._clock.now()), **ids)
        return slot

    async def query(
        self, channel: Channel, request: Message | None, kind: type[M], timeout_s: float, **ids: str
    ) -> M | None:
        """Send a query; return the first reply, or None when there is none within `timeout_s` of the clock.

        Published channels (hazards, zones) are queried without a request. Raises `ContractError` for a reply that
        violates the contract, or when the answering side refuses the query or fails.
        """
        key = self._key(channel, ids)
        data = None if request is None else encode(channel, request)
        session = self._session
        if session is None:
            return None
        result = await ask(self, session, channel, key, data, max(0.001, self._clock.real(timeout_s)))
        metrics.count_bytes(channel.name, "sent", len(data or b""))
        metrics.count_bytes(channel.name, "received", len(result or b""))
        return None if result is None else decode(channel, result, kind, reply=channel.kind == "query")

    def serve(self, channel: Channel, handler: Callable[[Ids, Any], Answer], **ids: str) -> None:
        """Answer queries with `handler(ids, request)`, plain or async; `request` is None where the channel has none."""
        self._declare(Queryable(self, channel, handler, self._key(channel, ids)).declare)

    def declare_liveliness(self, role: Role, id: str) -> None:  # noqa: A002  # as in the channel `live`
        """Declare that this process is present, for as long as its session is open."""
        key = LIVE.key(site=self._site, role=role, id=id)
        self._declare(lambda session: session.liveliness().declare_token(key))

    async def present(self, timeout_s: float = 2.0) -> set[tuple[str, str]]:
        """Return role and id of each process whose session is open now, as far as its router knows it.

        Empty while this process has no router. Waits for answers of other routers for `timeout_s` (real seconds).
        """
        session = self._session
        if session is None:
            return set()
        presence = await ask_who_is_present(self, session, LIVE.pattern(site=self._site), timeout_s)
        found = [LIVE.match(key) for key in presence.keys]
        return {(ids["role"], ids["id"]) for ids in found if ids is not None}

    async def router_answers(self, timeout_s: float = 1.0) -> bool:
        """Ask the router something (whether this process is present); return whether it answers within real seconds.

        `connected` notices a router that hangs, or a connection on which nothing passes any more, after 10 s only.
        """
        session = self._session
        if session is None or not self.connected:
            return False
        presence = await ask_who_is_present(self, session, self._own_presence, timeout_s)
        return presence.complete and self.connected

    # --- For what is declared on it (`zenoh_declarations`) ------------------------------------------------------------

    def call(self, function: Callable[..., object], *arguments: object) -> bool:
        """Call a function on the loop's thread, from any thread; False when the edge is closed."""
        if self._closed or self._loop.is_closed():
            return False
        self._loop.call_soon_threadsafe(function, *arguments)
        return True

    async def in_thread(self, function: Callable[[], object]) -> None:
        """Run a call that may block on one of the edge's own threads."""
        await self._loop.run_in_executor(self._threads, function)

    def spawn(self, work: Coroutine[Any, Any, None]) -> None:
        """Run a coroutine as a task of the edge; it is cancelled when the edge is closed."""
        task: asyncio.Task[None] = self._loop.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def ids(self, channel: Channel, key: str) -> Ids | None:
        """Return the ids in a key of the channel, without the site; None when it is malformed."""
        known = self._ids_of_keys.get((channel.name, key))
        if known is None:
            if (known := channel.match(key)) is None:
                return None
            known.pop("site", None)
            if len(self._ids_of_keys) < _KEYS:
                self._ids_of_keys[channel.name, key] = known
        return dict(known)

    def refuse(self, channel: Channel, key: str, reason: str) -> None:
        """Count and log (rate-limited) a message that violates its contract; from any thread."""
        metrics.REFUSED.labels(channel.name).inc()
        self._limited.warning(
            "message_refused", channel.name, self._clock.now(), channel=channel.name, key=key, reason=reason
        )

    def _check(self, channel: Channel, ids: Ids) -> None:
        if channel.transport != "zenoh":
            raise ValueError(f"channel {channel.name} is carried by {channel.transport}, not by zenoh")
        if "site" in ids:
            raise ValueError("the edge fills in the site: leave it out")

    def _with_site(self, channel: Channel, ids: Ids) -> Ids:
        return {**ids, "site": self._site} if "site" in channel.fields else ids

    def _key(self, channel: Channel, ids: Ids) -> str:
        name = (channel.name, *ids.items())
        if (key := self._keys.get(name)) is None:
            self._check(channel, ids)
            key = channel.key(**self._with_site(channel, ids))
            if len(self._keys) < _KEYS:
                self._keys[name] = key
        return key

    def _declare(self, declare: Callable[[zenoh.Session], object]) -> None:
        with self._lock:
            session = self._session
            if session is None:
                self._undeclared.append(declare)
                return
        # zenoh undeclares what is no longer referenced.
        self._declared.append(declare(session))

    def _config(self) -> zenoh.Config:
        return session_config("client", connect=self._connect, credentials=self._credentials)

    async def _try_connect(self) -> bool:
        try:
            session = await asyncio.to_thread(zenoh.open, self._config())
        except zenoh.ZError as error:
            # zenoh does not say whether nobody listens, or refuses these credentials, or is not to be trusted.
            self._limited.warning(
                "router_unreachable", "router_unreachable", self._clock.now(), connect=list(self._connect),
                reason=str(error), credentials=self._credentials.origin,
            )  # fmt: skip
            return False
        with self._lock:
            self._session = session
            pending, self._undeclared = self._undeclared, []
        metrics.CONNECTED.labels("zenoh").set_function(lambda: float(self.connected))
        metrics.CONNECTIONS.labels("zenoh").inc()
        for declare in pending:
            self._declared.append(declare(session))
        _log.info("router_connected", client=self._client_name, connect=list(self._connect), zid=str(session.zid()))
        return True

    async def _connect_when_possible(self) -> None:
        while True:
            await asyncio.sleep(random.uniform(*_RETRY_S))  # noqa: S311  # spreads attempts in time, no secret
            if await self._try_connect():
                return

    async def _close(self) -> None:
        self._closed = True
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        if self._session is not None:
            # Without this, callback subscribers would keep the interpreter running.
            await asyncio.to_thread(self._session.close)
            metrics.CONNECTED.labels("zenoh").set_function(lambda: 0.0)
        self._threads.shutdown(wait=False, cancel_futures=True)
