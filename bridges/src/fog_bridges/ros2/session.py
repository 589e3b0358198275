"""A node of ROS 2 on a zenoh session: what it says of itself, what it publishes, and what reaches it."""

from __future__ import annotations

import asyncio
import json
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import zenoh
import zenoh.ext as ze

from fog_bridges.floor import REFUSED
from fog_bridges.ros2.wire import Attachment, Node, RosMessage, Topic, WireError, Writer, decoded, type_hash
from fog_runtime import logs

if TYPE_CHECKING:
    from collections.abc import Callable

    from fog_runtime.clock import Clock

_RETRY: Final = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 1.5}
WAITING_MAX: Final = 1000
"""Messages that wait to be read; further ones are counted, and lost."""
WAITING_BYTES: Final = 4 * 1024 * 1024
"""So do messages beyond so many bytes."""
BYTES_MAX: Final = 64 * 1024
"""A longer message is refused unread: to read one of 1 MiB would take 0.1 s, in which nothing else is done."""

RETRY_S: Final = 1.0
NO_ROUTER: Final = "ROS's router (`ros2 run rmw_zenoh_cpp rmw_zenohd`) is not connected"

_log = logs.get("ros2")


def ros_config(source: Path | str) -> zenoh.Config:
    """Return the configuration of a session: that of a file, or that of a client of the router at an address.

    rmw_zenoh's own sessions are peers, which a router connects with one another only where they can't be reached
    directly; a client's messages always go by the router. Raises `ValueError`.
    """
    try:
        if isinstance(source, Path):
            return zenoh.Config.from_file(str(source))
        config = zenoh.Config()
        values = {
            "mode": "client", "connect/endpoints": [source], "connect/retry": _RETRY,
            "scouting/multicast/enabled": False, "timestamping/enabled": True,
            "transport/shared_memory/enabled": False,  # 16 MB, which only peers on this computer could use
        }  # fmt: skip
        for key, value in values.items():
            config.insert_json5(key, json.dumps(value))
    except zenoh.ZError as error:
        raise ValueError(f"{source} can't be used to reach ROS's router: {error}") from error
    return config


class Arrivals:
    """What arrives from ROS, on whatever wire: limited, read on the event loop's thread, refused in words."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock
        self._waiting = self._waiting_bytes = 0
        self._loop = asyncio.get_running_loop()
        self._limited = logs.RateLimited(_log)

    def arrive(self, topic: Topic, length: int, read: Callable[[], None]) -> None:
        """Have a message of `length` bytes read on the event loop, unless too much waits; from any thread."""
        if self._loop.is_closed():
            return
        if length > BYTES_MAX:
            self.refuse("too_long", topic.name, f"{length} bytes, and {BYTES_MAX} is the limit")
            return
        if self._waiting >= WAITING_MAX or self._waiting_bytes + length > WAITING_BYTES:
            self.refuse("too_many", topic.name, f"{self._waiting} messages wait")
            return
        self._waiting, self._waiting_bytes = self._waiting + 1, self._waiting_bytes + length
        self._loop.call_soon_threadsafe(self._read_next, topic, length, read)

    def _read_next(self, topic: Topic, length: int, read: Callable[[], None]) -> None:
        self._waiting, self._waiting_bytes = self._waiting - 1, self._waiting_bytes - length
        try:
            read()
        except WireError as error:
            self.refuse(error.reason, topic.name, str(error))

    def hand_on(
        self, topic: Topic, handler: Callable[[RosMessage], object], max_age_s: float | None, sent: float, data: bytes
    ) -> None:
        """Call a handler with the message of a payload that was sent at `sent` (s since 1970); raises `WireError`."""
        age = self._clock.stamp() - sent
        if max_age_s is not None and self._clock.speed == 1.0 and abs(age) > max_age_s:
            raise WireError(
                f"sent {age:.1f} s ago, and {max_age_s:g} s is the limit: it waited for too long, or the sender's "
                "clock is not synchronized with this one (NTP)", "old",
            )  # fmt: skip
        handler(decoded(topic, data))

    def refuse(self, reason: str, topic: str, words: str) -> None:
        """Count and log a message that is not understood."""
        REFUSED.labels("ros2", reason).inc()
        self._limited.warning("message_refused", f"{topic} {reason}", self._loop.time(), topic=topic, reason=words)


class ZenohWire:
    """How a bridge reaches ROS by zenoh."""

    def __init__(self, config: zenoh.Config, domain: int) -> None:
        """Use the router, or whatever `config` connects to, and the domain that ROS_DOMAIN_ID is for the robots."""
        self._config, self._domain = config, domain
        self.problem = ""
        """Why there is no session yet."""

    async def opened(self, name: str, clock: Clock) -> RosSession:
        """Return a node once the router is there; afterwards it connects again by itself."""
        while True:
            try:
                session = await asyncio.to_thread(zenoh.open, self._config)
            except zenoh.ZError as error:
                self.problem = f"{NO_ROUTER}: {error}"
                await asyncio.sleep(RETRY_S)
            else:
                return RosSession(session, self._domain, name, clock)


class RosSession(Arrivals):
    """A node of ROS on a zenoh session: publishers and subscribers with their tokens of presence.

    Subscribers' handlers are called on the event loop's thread.
    """

    def __init__(self, session: zenoh.Session, domain: int, name: str, clock: Clock) -> None:
        """Introduce the node `name`."""
        super().__init__(clock)
        self._session = session
        self._domain = domain
        self._node = Node(domain, str(self._session.info.zid()), name)
        self._held: list[object] = [self._session.liveliness().declare_token(self._node.token)]
        self._writers: dict[Topic, tuple[Writer, Any]] = {}

    @property
    def problem(self) -> str:
        """Why nobody hears it; empty while a router or a peer is connected."""
        info = self._session.info
        return "" if info.routers_zid() or info.peers_zid() else NO_ROUTER

    def publish(self, topic: Topic, message: object, stamp: float) -> None:
        """Publish a message without waiting; `stamp` (s since 1970) is when."""
        if topic not in self._writers:
            self._writers[topic] = self._writer(topic)
        writer, publisher = self._writers[topic]
        payload, attachment = writer.encoded(message, int(stamp * 1e9))
        try:
            publisher.put(payload, attachment=attachment)
        except zenoh.ZError as error:
            self._limited.warning("message_dropped", topic.name, self._loop.time(), topic=topic.name, reason=str(error))

    def _writer(self, topic: Topic) -> tuple[Writer, Any]:
        token = self._node.entity("MP", topic)
        key = topic.key(self._domain)
        if topic.latched:
            publisher: Any = ze.declare_advanced_publisher(
                self._session, key, congestion_control=zenoh.CongestionControl.DROP, publisher_detection=True,
                cache=ze.CacheConfig(max_samples=1),
                sample_miss_detection=ze.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=0.5),
            )  # fmt: skip
        else:
            publisher = self._session.declare_publisher(key, congestion_control=zenoh.CongestionControl.DROP)
        self._held.append(self._session.liveliness().declare_token(token))
        return Writer(topic, token), publisher

    def subscribe(self, topic: Topic, handler: Callable[[RosMessage], object], max_age_s: float | None = None) -> None:
        """Call a handler with each message; one of another definition of its type, or none, is counted and logged.

        So is one that was sent more than `max_age_s` ago, or that the handler refuses by a `WireError`.
        """

        def on_sample(sample: zenoh.Sample) -> None:
            attachment = None if sample.attachment is None else sample.attachment.to_bytes()
            arrived = (str(sample.key_expr), sample.payload, attachment)
            self.arrive(topic, len(sample.payload), partial(self._read, topic, handler, max_age_s, *arrived))

        self._held.append(self._session.declare_subscriber(topic.any_hash(self._domain), on_sample))
        self._held.append(self._session.liveliness().declare_token(self._node.entity("MS", topic)))

    def _read(  # what a sample consists of
        self, topic: Topic, handler: Callable[[RosMessage], object], max_age_s: float | None,
        key: str, payload: zenoh.ZBytes, attachment: bytes | None,
    ) -> None:  # fmt: skip
        check_hash(topic.type, key.rpartition("/")[2])
        sent = Attachment.decoded(attachment or b"")
        self.hand_on(topic, handler, max_age_s, sent.sent_ns / 1e9, payload.to_bytes())

    def close(self) -> None:
        """Close the session; its tokens go with it."""
        self._session.close()  # type: ignore[no-untyped-call]  # zenoh's stub has no types for it


def check_hash(kind: str, theirs: str) -> None:
    """Raise `WireError` when the hash of a sender's type is not ours."""
    if theirs not in (own := type_hash(kind), "TypeHashNotSupported"):
        raise WireError(
            f"the sender's {kind} is {theirs}, and ours is {own}: it was built with another version of the message's "
            "package", "type_hash",
        )  # fmt: skip
