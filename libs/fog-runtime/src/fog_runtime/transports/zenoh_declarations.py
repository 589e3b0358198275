"""What is declared on a zenoh session: publishers, subscriptions and queryables, each on one key or pattern."""

import inspect
import threading
from collections import Counter, deque
from collections.abc import Awaitable, Callable, Coroutine, Mapping
from contextvars import ContextVar
from functools import partial
from typing import Any, Final, Generic, Protocol, TypeVar

import zenoh
from zenoh import ext

from fog_contracts.channels import Channel, Durability
from fog_contracts.codec import ContractError, decode, encode
from fog_contracts.handlers import RefusedMessageError
from fog_contracts.messages import Message
from fog_runtime import logs, metrics
from fog_runtime.transports.zenoh_query import GONE, PART, PART_BYTES, REPLY, LargeReplies, Threads

M = TypeVar("M", bound=Message)
Ids = dict[str, str]

RECOVERED_SAMPLES: Final = 256
"""Messages of a recovered channel that its publisher caches for recovery: 16 MiB of full deltas."""
HEARTBEAT_S: Final = 0.5
"""Real seconds between a publisher's heartbeats, by which a subscriber detects that the last message was lost."""
CACHE_DEPTH: Final[Mapping[Durability, int]] = {"volatile": 0, "latest": 1, "recovered": RECOVERED_SAMPLES}
"""How many messages of a key its publisher caches for recovery."""
_QUEUE: Final = 4096
"""Messages of a recovered channel that may wait for the loop; further ones are dropped, which their versions show."""
_RING: Final = 16
"""Messages of a polled channel that may wait for the next look; the newest stay."""
_PENDING_QUERIES: Final = 64
_PENDING_OF_ONE: Final = 16
"""How many queries on one key may wait for their answers: of all askers, and of one session."""
ASKER: Final[ContextVar[str]] = ContextVar("asker", default="")
"""The session that asks, by its id, in the handler of a query; empty if it did not say."""

_log = logs.get("zenoh")


class Edge(Threads, Protocol):
    """What they need of the edge that they are declared on (`zenoh_edge`)."""

    @property
    def closed(self) -> bool:
        """Whether its session is closed, or about to be."""

    def spawn(self, work: Coroutine[Any, Any, None]) -> None:
        """Run a coroutine as a task of the edge; it is cancelled when the edge is closed."""

    def ids(self, channel: Channel, key: str) -> Ids | None:
        """Return the ids in a key of the channel, without the site; None when it is malformed."""

    def refuse(self, channel: Channel, key: str, reason: str) -> None:
        """Count and log (rate-limited) a message that violates its contract; from any thread."""


def _finish(query: Any) -> None:  # noqa: ANN401  # `drop` has no types in zenoh's stubs
    """Tell the querier that no further reply will come."""
    query.drop()


def _asker(query: Any) -> str:  # noqa: ANN401  # as above
    """Return the id of the session that asks; empty if it did not say."""
    source = query.source_info
    return "" if source is None else str(source.source_id.zid)


class Publisher:
    """Publishes on one key, from any thread; messages that must not be lost are queued until the session opens."""

    def __init__(self, channel: Channel, key: str) -> None:
        self._channel = channel
        self._key = key
        self._depth = CACHE_DEPTH[channel.durability]
        self._lock = threading.Lock()
        self._pending: deque[bytes] = deque(maxlen=self._depth)
        self._put: Callable[[bytes], object] | None = None
        self._traffic = metrics.Traffic(channel.name, "sent")

    def declare(self, session: zenoh.Session) -> None:
        """Declare the publisher, and publish what is queued."""
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
        """Publish, or queue, an encoded message."""
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


class Publishers:
    """The publishers by key; a new one is declared by the thread that first needs it."""

    def __init__(self, declare: Callable[[Callable[[zenoh.Session], object]], None]) -> None:
        self._declare = declare
        self._by_key: dict[str, Publisher] = {}
        self._lock = threading.Lock()

    def of(self, channel: Channel, key: str) -> Publisher:
        """Return the publisher of a key; raises `ZError` if zenoh can't declare it."""
        publisher = self._by_key.get(key)
        if publisher is not None:
            return publisher
        with self._lock:
            publisher = self._by_key.get(key)
            if publisher is not None:
                return publisher
            publisher = self._by_key[key] = Publisher(channel, key)
        try:
            self._declare(publisher.declare)
        except zenoh.ZError:
            with self._lock:
                del self._by_key[key]  # the next message declares it again
            raise
        return publisher


class Subscription(Generic[M]):
    """Passes samples from zenoh's threads to the loop: all in order, or only the newest of each key."""

    def __init__(
        self, edge: Edge, channel: Channel, kind: type[M], handler: Callable[[Ids, M], object], pattern: str
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
        metrics.expect_messages(channel.name)

    def declare(self, session: zenoh.Session) -> object:
        """Declare the subscription; it lasts while what is returned is referenced."""
        depth = CACHE_DEPTH[self._channel.durability]
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


class PolledSubscription(Subscription[M]):
    """Keeps the newest samples inside zenoh until somebody looks: neither a thread nor the loop is woken for each."""

    _subscriber: zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]] | None = None

    def declare(self, session: zenoh.Session) -> object:
        """Declare the subscription, whose samples wait for `poll`."""
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


class Queryable:
    """Answers queries on one key, with the handler on the loop's thread."""

    def __init__(self, edge: Edge, channel: Channel, handler: Callable[[Ids, Any], Answer], key: str) -> None:
        self._edge = edge
        self._channel = channel
        self._handler = handler
        self._key = key
        self._ids = edge.ids(channel, key) or {}
        self._pending: Counter[str] = Counter()
        self._last: tuple[Message, bytes] | None = None
        self._large = LargeReplies()
        metrics.expect_messages(channel.name)

    def declare(self, session: zenoh.Session) -> object:
        """Declare the queryable; it answers while what is returned is referenced."""
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
