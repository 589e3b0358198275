"""The transport of the robot side: typed publishing, subscribing, querying and answering on zenoh channels.

A session is a client of the site's routers. A router serves clients, unlike peers, without their knowing one another
(zenoh 1.9 and later never route between peers), and a robot that comes or goes changes no other routes. A client's
session can't be opened while no router is up; what was declared before is declared when it opens.
"""

import asyncio
import base64
import inspect
import json
import os
import random
import threading
from collections import Counter, deque
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager
from contextvars import ContextVar
from functools import partial
from typing import Any, Final, Generic, Literal, TypeVar
from urllib.parse import urlsplit

import zenoh
from zenoh import ext

from fog_contracts.channels import LIVE, Channel, Durability, Role
from fog_contracts.codec import ContractError, decode, encode
from fog_contracts.handlers import RefusedMessageError
from fog_contracts.messages import Message
from fog_runtime import logs, metrics
from fog_runtime.clock import Clock
from fog_runtime.concurrency import Slot
from fog_runtime.credentials import NOBODY, Credentials
from fog_runtime.transports.zenoh_query import GONE, PART, PART_BYTES, REPLY, LargeReplies, ask, ask_who_is_present

M = TypeVar("M", bound=Message)
Ids = dict[str, str]

RECOVERED_SAMPLES: Final = 256
"""Messages of a recovered channel that its publisher caches for recovery: 16 MiB of full deltas."""
HEARTBEAT_S: Final = 0.5
"""Real seconds between a publisher's heartbeats, by which a subscriber detects that the last message was lost."""
_CACHE_DEPTH: Final[Mapping[Durability, int]] = {"volatile": 0, "latest": 1, "recovered": RECOVERED_SAMPLES}
"""How many messages of a key its publisher caches for recovery."""
_QUEUE: Final = 4096
"""Messages of a recovered channel that may wait for the loop; further ones are dropped, which their versions show."""
_KEYS: Final = 256
"""Keys that are remembered, and not checked and put together again for each message."""
_RING: Final = 16
"""Messages of a polled channel that may wait for the next look; the newest stay."""
_PENDING_QUERIES: Final = 64
_PENDING_OF_ONE: Final = 16
"""How many queries on one key may wait for their answers: of all askers, and of one session."""
ASKER: Final[ContextVar[str]] = ContextVar("asker", default="")
"""The session that asks, by its id, in the handler of a query; empty if it did not say."""
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


def _finish(query: Any) -> None:  # noqa: ANN401  # `drop` has no types in zenoh's stubs
    """Tell the querier that no further reply will come."""
    query.drop()


def _asker(query: Any) -> str:  # noqa: ANN401  # as above
    """Return the id of the session that asks; empty if it did not say."""
    source = query.source_info
    return "" if source is None else str(source.source_id.zid)


class _Publisher:
    """Publishes on one key, from any thread; messages that must not be lost are queued until the session opens."""

    def __init__(self, channel: Channel, key: str) -> None:
        self._channel = channel
        self._key = key
        self._depth = _CACHE_DEPTH[channel.durability]
        self._lock = threading.Lock()
        self._pending: deque[bytes] = deque(maxlen=self._depth)
        self._put: Callable[[bytes], object] | None = None
        self._traffic = metrics.Traffic(channel.name, "sent")

    def declare(self, session: zenoh.Session) -> None:
        drop = zenoh.CongestionControl.DROP
        if self._depth:
            miss = ext.MissDetectionConfig(heartbeat=HEARTBEAT_S, sporadic_heartbeat=None)
            advanced = ext.declare_advanced_publisher(
                session,
                self._key,
                congestion_control=drop,
                cache=ext.CacheConfig(self._depth),
                sample_miss_detection=miss,
                publisher_detection=True,
            )
            put: Callable[[bytes], object] = advanced.put
        else:
            put = session.declare_publisher(self._key, congestion_control=drop).put
        with self._lock:
            self._put = put
            while self._pending:
                self._send(put, self._pending.popleft())

    def put(self, data: bytes) -> None:
        with self._lock:
            if self._put is not None:
                self._send(self._put, data)
            elif self._depth:
                self._pending.append(data)
            else:
                metrics.DROPPED.labels(self._channel.name).inc()

    def _send(self, put: Callable[[bytes], object], data: bytes) -> None:
        put(data)
        self._traffic.count(len(data))


class _Publishers:
    """The publishers by key; a new one is declared by the thread that first needs it."""

    def __init__(self, declare: Callable[[Callable[[zenoh.Session], object]], None]) -> None:
        self._declare = declare
        self._by_key: dict[str, _Publisher] = {}
        self._lock = threading.Lock()

    def of(self, channel: Channel, key: str) -> _Publisher:
        publisher = self._by_key.get(key)
        if publisher is not None:
            return publisher
        with self._lock:
            publisher = self._by_key.get(key)
            if publisher is not None:
                return publisher
            publisher = self._by_key[key] = _Publisher(channel, key)
        try:
            self._declare(publisher.declare)
        except zenoh.ZError:
            with self._lock:
                del self._by_key[key]  # the next message declares it again
            raise
        return publisher


class _Subscription(Generic[M]):
    """Passes samples from zenoh's threads to the loop: all in order, or only the newest of each key."""

    def __init__(
        self, edge: "ZenohEdge", channel: Channel, kind: type[M], handler: Callable[[Ids, M], object], pattern: str
    ) -> None:
        self._edge = edge
        self._channel = channel
        self._kind = kind
        self._handler = handler
        self._pattern = pattern
        self._lock = threading.Lock()
        self._queue: deque[tuple[str, bytes]] = deque()
        self._newest: dict[str, bytes] = {}
        self._drain_scheduled = False
        self._traffic = metrics.Traffic(channel.name, "received")

    def declare(self, session: zenoh.Session) -> object:
        depth = _CACHE_DEPTH[self._channel.durability]
        if not depth:
            return session.declare_subscriber(self._pattern, self._on_sample)
        return ext.declare_advanced_subscriber(
            session,
            self._pattern,
            self._on_sample,
            history=ext.HistoryConfig(detect_late_publishers=True, max_samples=depth),
            recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
        )

    def _on_sample(self, sample: zenoh.Sample) -> None:
        """Queue a sample; runs on one of zenoh's threads and must be short."""
        if (admitted := self._admitted(sample)) is None:
            return
        key, data = admitted
        with self._lock:
            if self._channel.durability == "recovered":
                if len(self._queue) >= _QUEUE:
                    self._queue.popleft()
                    metrics.DROPPED.labels(self._channel.name).inc()
                self._queue.append((key, data))
            elif key in self._newest or len(self._newest) < _QUEUE:
                self._newest[key] = data
            else:
                metrics.DROPPED.labels(self._channel.name).inc()
            schedule = not self._drain_scheduled
            self._drain_scheduled = True
        if schedule:
            self._edge.call(self._drain)

    def _admitted(self, sample: zenoh.Sample) -> tuple[str, bytes] | None:
        """Return key and payload of a sample; None for one that is not to be delivered."""
        if sample.kind != zenoh.SampleKind.PUT:
            return None
        key, size = str(sample.key_expr), len(sample.payload)
        self._traffic.count_size(size)
        if size > self._channel.limit:
            self._edge.refuse(self._channel, key, f"{size} bytes are over the limit of {self._channel.limit}")
            return None
        return key, sample.payload.to_bytes()

    def _drain(self) -> None:
        with self._lock:
            self._drain_scheduled = False
            samples = [*self._queue, *self._newest.items()]
            self._queue.clear()
            self._newest.clear()
        for key, data in samples:
            self._deliver(key, data)

    def _deliver(self, key: str, data: bytes) -> None:
        ids = self._edge.ids(self._channel, key)
        if ids is None:
            self._edge.refuse(self._channel, key, "the ids in the key are malformed")
            return
        try:
            message = decode(self._channel, data, self._kind)
        except ContractError as error:
            self._edge.refuse(self._channel, key, error.reason)
            return
        self._traffic.count_message()
        try:
            self._handler(ids, message)
        except RefusedMessageError as error:
            self._edge.refuse(self._channel, key, str(error))
        except Exception as error:  # noqa: BLE001  # one message must not end the process; the bug is logged
            metrics.HANDLER_ERRORS.labels(self._channel.name).inc()
            _log.error("handler_failed", error=error, channel=self._channel.name, key=key)


class _PolledSubscription(_Subscription[M]):
    """Keeps the newest samples inside zenoh until somebody looks: neither a thread nor the loop is woken for each."""

    _subscriber: zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]] | None = None

    def declare(self, session: zenoh.Session) -> object:
        ring: zenoh.handlers.RingChannel[zenoh.Sample] = zenoh.handlers.RingChannel(_RING)
        self._subscriber = session.declare_subscriber(self._pattern, ring)
        return self._subscriber

    def poll(self) -> None:
        """Deliver what has arrived; on the loop's thread. Nothing arrives on a session that is closed."""
        if (subscriber := self._subscriber) is None:
            return
        # At most as many as the ring holds: a flood must not keep the caller.
        for _ in range(_RING):
            try:
                sample = subscriber.try_recv()
            except zenoh.ZError:
                if not self._edge.closed:
                    raise
                return
            if sample is None:
                return
            if (admitted := self._admitted(sample)) is not None:
                self._deliver(*admitted)


Answer = Message | None | Awaitable[Message | None]
"""The reply to a query; None leaves it to another process that serves the same key."""


class _Queryable:
    """Answers queries on one key, with the handler on the loop's thread."""

    def __init__(self, edge: "ZenohEdge", channel: Channel, handler: Callable[[Ids, Any], Answer], key: str) -> None:
        self._edge = edge
        self._channel = channel
        self._handler = handler
        self._key = key
        self._ids = edge.ids(channel, key) or {}
        self._pending: Counter[str] = Counter()
        self._last: tuple[Message, bytes] | None = None
        self._large = LargeReplies()

    def declare(self, session: zenoh.Session) -> object:
        return session.declare_queryable(self._key, self._on_query)

    def _on_query(self, query: zenoh.Query) -> None:
        """Pass a query to the loop; runs on one of zenoh's threads."""
        if not self._edge.call(self._begin, query):
            _finish(query)

    def _begin(self, query: zenoh.Query) -> None:
        asker = _asker(query)
        refusal = ""
        if self._pending.total() >= _PENDING_QUERIES:
            refusal = f"more than {_PENDING_QUERIES} queries at once"
        elif self._pending[asker] >= _PENDING_OF_ONE:
            refusal = f"more than {_PENDING_OF_ONE} queries at once of session {asker or 'without id'}"
        if refusal:
            self._edge.refuse(self._channel, self._key, refusal)
            _finish(query)
            return
        self._pending[asker] += 1
        self._edge.spawn(self._answer(query, asker))

    async def _answer(self, query: zenoh.Query, asker: str) -> None:
        ASKER.set(asker)
        try:
            if (reply := query.parameters.get(REPLY)) is not None:
                await self._send_part(query, reply, query.parameters.get(PART) or "")
                return
            try:
                request = self._request(query)
            except ContractError as error:
                self._edge.refuse(self._channel, self._key, error.reason)
                await self._edge.in_thread(partial(query.reply_err, error.reason.encode()))
                return
            metrics.RECEIVED.labels(self._channel.name).inc()
            try:
                answer = self._handler(self._ids, request)
                message = await answer if inspect.isawaitable(answer) else answer
                if message is None:
                    return
                data = self._encoded(message)
            except Exception as error:  # noqa: BLE001  # as for messages: the querier gets an error, the bug is logged
                metrics.HANDLER_ERRORS.labels(self._channel.name).inc()
                _log.error("handler_failed", error=error, channel=self._channel.name, key=self._key)
                await self._edge.in_thread(partial(query.reply_err, b"the answering process failed; see its log"))
                return
            if len(data) > PART_BYTES:
                announcement = self._large.announce(data).encoded()
                await self._edge.in_thread(partial(query.reply, self._key, b"", attachment=announcement))
            else:
                await self._edge.in_thread(partial(query.reply, self._key, data))
                metrics.count_bytes(self._channel.name, "sent", len(data))
            metrics.ANSWERED.labels(self._channel.name).inc()
        finally:
            self._pending[asker] -= 1
            if not self._pending[asker]:
                del self._pending[asker]
            _finish(query)

    async def _send_part(self, query: zenoh.Query, reply: str, number: str) -> None:
        if not self._large.announced(reply):
            return
        part = self._large.part(reply, number)
        if part is None:
            await self._edge.in_thread(partial(query.reply_err, GONE))
        else:
            await self._edge.in_thread(partial(query.reply, self._key, part))
            metrics.count_bytes(self._channel.name, "sent", len(part))

    def _request(self, query: zenoh.Query) -> Message | None:
        if self._channel.kind != "query" or self._channel.message is None:
            return None
        payload = query.payload
        size = 0 if payload is None else len(payload)
        metrics.count_bytes(self._channel.name, "received", size)
        if size > self._channel.limit:
            raise ContractError(self._channel.name, f"{size} bytes are over the limit of {self._channel.limit}")
        return decode(self._channel, b"" if payload is None else payload.to_bytes(), self._channel.message)

    def _encoded(self, message: Message) -> bytes:
        """Encode a reply; the same object as last time (a snapshot) is not encoded again."""
        if self._last is None or self._last[0] is not message:
            self._last = (message, encode(self._channel, message, reply=self._channel.kind == "query"))
        return self._last[1]


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
        self._publishers = _Publishers(self._declare)
        self._lock = threading.Lock()
        """Held while the session begins to take declarations."""
        self._declared: list[object] = []
        self._polled: list[_PolledSubscription[Any]] = []
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

        `role` and `id` identify the process in logs; `site` is filled into every key. Raises
        `CredentialsError` if an endpoint would reveal the password in the `credentials`.
        """
        edge = cls(clock, site=site, role=role, name=id, connect=connect, credentials=credentials)
        connecting: asyncio.Task[None] | None = None
        try:
            if not await edge._try_connect():
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
        self._declare(_Subscription(self, channel, kind, handler, pattern).declare)

    def subscribe_polled(
        self, channel: Channel, kind: type[M], handler: Callable[[Ids, M], object], **ids: str
    ) -> None:
        """Subscribe as `subscribe` does, but deliver only when `poll` is called, the newest messages.

        For a process that looks often anyhow: it is not woken for each message. The channel must be volatile.
        """
        self._check(channel, ids)
        if _CACHE_DEPTH[channel.durability]:
            raise ValueError(f"messages of channel {channel.name} must not be lost: it can't be polled")
        pattern = channel.pattern(**self._with_site(channel, ids))
        polled = _PolledSubscription(self, channel, kind, handler, pattern)
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
        self._declare(_Queryable(self, channel, handler, self._key(channel, ids)).declare)

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

    # --- For the other classes of this module -----------------------------------------------------------------------

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
