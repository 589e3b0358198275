"""Runs the lease of a process: one of several copies of a service leads, the others follow everything and say nothing.

`lease` decides, `LeaseStore` asks Redis. The edges pass everything that is published through `admit`, and answer
queries only while this process leads. See ADR 12.

What it is worth: another copy leads within 2 s of a leader's death, whatever of pauses, partitions and a slow or lossy
Redis comes together (`test_lease`), and never two at once, which would give a robot two missions. Robots hold after 3 s
without a map.
"""

from __future__ import annotations

import asyncio
import math
import secrets
import threading
import time
from collections import deque
from functools import partial
from typing import TYPE_CHECKING, Any, Final, Protocol, Self

from prometheus_client import Counter, Gauge

from fog_contracts import channels as ch
from fog_contracts.handlers import epoch_in
from fog_contracts.messages import Leader
from fog_runtime import logs
from fog_runtime.credentials import NOBODY
from fog_runtime.lease import (
    ANNOUNCE_S,
    ATTEMPT_S,
    CUT_OFF_S,
    LEASE_S,
    READY_SAID_S,
    Granted,
    Held,
    Lease,
    LeftToOther,
    Reply,
    Request,
)
from fog_runtime.process import process_id
from fog_runtime.stores.redis_connection import RedisConnection, StoreError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from fog_contracts.channels import Channel, Role
    from fog_runtime.credentials import Credentials
    from fog_runtime.health import Health
    from fog_runtime.stores.redis_connection import Command
    from fog_runtime.transports.zenoh_edge import ZenohEdge

# The lease is "EPOCH HOLDER" and expires; the epoch stays. An epoch that Redis has granted is renewed as long as nobody
# drew another one, even if the lease expired or Redis lost it meanwhile; a provisional one must be above every other.
# Whoever asks in vain, but knows of a higher epoch than the leader's, leaves that in Redis (the floor), and the leader
# draws one above it at its next renewal. Else nobody might tell it of a provisional epoch that receivers heard, and
# they would refuse it for ever.
# A standby that has what it needs to lead leaves its name for a moment (ready). A leader that is cut off from what it
# needs finds it, and gives the lease back.
# The clock (ms) only keeps epochs growing that Redis and all who could know have forgotten.
_ACQUIRE: Final = """
local holder, epoch, floor, confirmed = ARGV[1], tonumber(ARGV[2]), tonumber(ARGV[3]), ARGV[4] == '1'
local stored = tonumber(redis.call('GET', KEYS[2]) or '0')
local lease = redis.call('GET', KEYS[1])
local held_epoch, held_by
if lease then held_epoch, held_by = string.match(lease, '^(%d+) (.*)$') end
local left = tonumber(redis.call('GET', KEYS[3]) or '0')
local ready, cut_off = ARGV[7] == '1', ARGV[8] == '1'
if held_by and held_by ~= holder then
  if ready then redis.call('SET', KEYS[4], holder, 'PX', ARGV[9]) end
  if floor > math.max(left, tonumber(held_epoch)) then redis.call('SET', KEYS[3], string.format('%.0f', floor)) end
  return {0, held_epoch, held_by, redis.call('PTTL', KEYS[1])}
end
local successor = redis.call('GET', KEYS[4])
if cut_off and successor and successor ~= holder then
  redis.call('DEL', KEYS[1])
  return {2}
end
floor = math.max(floor, left)
if epoch == 0 and held_by then epoch, confirmed = tonumber(held_epoch), true end
if epoch <= floor or epoch < stored or (epoch == stored and not confirmed) then
  epoch = math.max(stored + 1, floor + 1, tonumber(ARGV[5]))
end
local text = string.format('%.0f', epoch)
if epoch ~= stored then redis.call('SET', KEYS[2], text) end
redis.call('SET', KEYS[1], text .. ' ' .. holder, 'PX', ARGV[6])
return {1, text}
"""
_GRANTED, _LEFT_TO_OTHER = 1, 2
_RELEASE: Final = """
local lease = redis.call('GET', KEYS[1])
if lease and string.match(lease, '^%d+ (.*)$') == ARGV[1] then return redis.call('DEL', KEYS[1]) end
return 0
"""

_log = logs.get("leadership")


class LeaseStore:
    """The lease of one service of a site; none of its calls raises for a Redis that does not answer."""

    def __init__(self, url: str, site: str, service: str, *, credentials: Credentials = NOBODY) -> None:
        self._redis = RedisConnection(url, timeout_s=ATTEMPT_S, credentials=credentials)
        self._keys = tuple(f"fog:{site}:{service}:{name}" for name in ("lease", "epoch", "floor", "ready"))

    async def __aenter__(self) -> Self:
        """Return the store; it connects with the first command."""
        return self

    async def __aexit__(self, *_: object) -> None:
        """Close the connections."""
        await self._redis.aclose()

    async def acquire(self, holder: str, request: Request) -> Reply:
        """Take or renew the lease; None when Redis did not answer in time: it may have done it all the same."""
        arguments = (
            holder, request.epoch, request.floor, int(request.confirmed), _now_ms(), round(LEASE_S * 1000),
            int(request.ready), int(request.cut_off), round(READY_SAID_S * 1000),
        )  # fmt: skip
        reply = await self._attempt(("EVAL", _ACQUIRE, len(self._keys), *self._keys, *arguments))
        match reply:
            case None:
                return None
            case [outcome] if outcome == _LEFT_TO_OTHER:
                return LeftToOther()
            case [outcome, epoch] if outcome == _GRANTED:
                return Granted(int(epoch))
            case [_, epoch, other, remaining_ms]:
                return Held(int(epoch), other.decode("utf-8", "replace"), max(0, remaining_ms) / 1000)
        raise AssertionError(f"the script returned {reply!r}")

    async def release(self, holder: str) -> None:
        """Give the lease back, if this process holds it, so that another takes over at once; else it expires."""
        await self._attempt(("EVAL", _RELEASE, 1, self._keys[0], holder))

    async def _attempt(self, command: Command) -> Any:  # noqa: ANN401  # redis does not type its replies
        """Execute a command once, in at most `ATTEMPT_S`; None when Redis did not answer, or refused it."""
        try:
            async with asyncio.timeout(ATTEMPT_S):
                (reply,) = await self._redis.write(command)
        except (StoreError, TimeoutError):
            return None
        return reply


def _now_ms() -> int:
    return int(time.time() * 1000)


PROBE_S: Final = 0.2
"""Pause between an answer and the next question (real seconds)."""

AGE: Final = Gauge(
    "fognav_answer_age_seconds",
    "Time since what this process needs to lead (broker, router, thread) was last asked something that it answered",
    ["needed"],
)


class Probes:
    """When everything that is needed last answered, by the monotonic clock; `needs`: by name, what asks it.

    A connection says for 10 to 15 s that it is up after nothing passes on it any more; a thread that hangs says
    nothing. A question returns whether it was answered, and is asked again only then: it may take as long as it likes.
    """

    def __init__(self, needs: Mapping[str, Callable[[], Awaitable[bool]]]) -> None:
        """Prepare; nothing has answered yet."""
        self._needs = needs
        self._started_at = time.monotonic()
        self._answered_at = dict.fromkeys(needs, -math.inf)

    def answered_at(self) -> float:
        """Return when the question was asked that was answered last, of the need for which that is longest ago.

        -inf while something has answered none.
        """
        return min(self._answered_at.values(), default=time.monotonic())

    def silent(self, seconds: float) -> list[str]:
        """Return the names of what has answered no question of the last `seconds`; none so soon after the start."""
        return [name for name in self._answered_at if self._age(name) > seconds]

    def start(self, tasks: asyncio.TaskGroup) -> None:
        """Ask, as tasks of a group, until these are cancelled."""
        for name, ask in self._needs.items():
            AGE.labels(name).set_function(partial(self._age, name))
            tasks.create_task(self._probe(name, ask), name=f"probe of {name}")

    def _age(self, name: str) -> float:
        """Return the time since the last question that was answered, or since the start."""
        return time.monotonic() - max(self._started_at, self._answered_at[name])

    async def _probe(self, name: str, ask: Callable[[], Awaitable[bool]]) -> None:
        while True:
            asked_at = time.monotonic()
            if await ask():
                self._answered_at[name] = asked_at
            await asyncio.sleep(PROBE_S)


_TICK_S: Final = 0.05
_RETRY_S: Final = 0.2
_HELD_BACK: Final = 2048
"""Messages that may wait while the lease is uncertain; the oldest are dropped first."""

LEADS: Final = Gauge("fognav_leader", "Whether this process leads its service (1) or stands by (0)")
EPOCH: Final = Gauge("fognav_epoch", "Epoch with which this process leads, its fencing number; 0 on standby")
TAKEOVERS: Final = Counter("fognav_takeovers_total", "How often this process began to lead, or got another epoch")
HELD_BACK: Final = Counter(
    "fognav_held_back_messages_total", "Messages that waited because the lease was uncertain", ["channel"]
)


class Member(Protocol):
    """A service whose copies take turns."""

    async def lead(self, epoch: int, *, confirmed: bool) -> None:
        """Load what is stored, continue with this epoch, and publish everything again.

        `confirmed`: Redis granted the epoch. Raises `StoreError` to be called again.
        """

    def stand_by(self) -> None:
        """Forget what only a leader may do; another process leads."""


class LeaseBackend(Protocol):
    """Where leases are granted (`lease_store.LeaseStore`)."""

    async def acquire(self, holder: str, request: Request) -> Reply:
        """Take or renew the lease; None when there was no answer in time."""

    async def release(self, holder: str) -> None:
        """Give the lease back."""


class Leadership:
    """Whether this process leads. For one event loop; only `admit` may be called on other threads."""

    def __init__(
        self,
        service: Role,
        leases: LeaseBackend,
        zenoh: ZenohEdge,
        health: Health,
        *,
        connected: Callable[[], bool],
        epochs: Callable[[], Mapping[str, int]] = dict,
    ) -> None:
        """Prepare; `run` takes the lease.

        `connected` tells whether this process could hear another leader; `epochs` returns the highest epochs received
        of other services, which the announcement passes on.
        """
        self.holder = process_id(service)
        self._service = service
        self._leases = leases
        self._zenoh = zenoh
        self._health = health
        self._connected = connected
        self._epochs = epochs
        self._lease = Lease(self.holder, time.monotonic())
        self._term = (0, False)
        """The epoch, and whether it is confirmed, that the service was last told."""
        self._serving = 0
        """The epoch with which the service has published everything; 0 before."""
        self._waiting: deque[tuple[Channel, Callable[[], None]]] = deque(maxlen=_HELD_BACK)
        self._sending = threading.Lock()
        """Held while messages are sent or held back, so that they leave in their order."""
        self._takeover: asyncio.Task[None] | None = None
        self._announced_at = 0.0
        self._probes = Probes({})
        health.set("lease", ok=False, detail="waiting for the lease")

    # --- For the edges ----------------------------------------------------------------------------------------------

    def admit(self, channel: Channel, message: object, send: Callable[[], None]) -> None:
        """Send a message of this service: now, once the lease is certain, or never.

        A message with an epoch is sent only if it is the current one: a core may not have taken it yet.
        """
        with self._sending:
            permission = self._lease.permission(time.monotonic())
            epoch = getattr(message, channel.epoch) if channel.epoch and message is not None else self._lease.epoch
            if permission == "refused" or epoch != self._lease.epoch:
                return
            if permission == "granted":
                self._send_waiting()
                send()
                return
            HELD_BACK.labels(channel.name).inc()
            self._waiting.append((channel, send))

    def answers(self) -> bool:
        """Whether this process answers queries: it leads, and its lease is certain."""
        granted = self._lease.permission(time.monotonic()) == "granted"
        return granted and self._serving == self._lease.epoch

    def on_message(self, channel: Channel, message: object) -> None:
        """Hear which epochs of this service others know."""
        epoch = epoch_in(channel, message, self._service)
        if ch.ROBOT in channel.publishers:
            self._lease.on_hearsay(epoch)
        else:
            self._lease.on_epoch(epoch)

    def on_rival(self, epoch: int) -> None:
        """Hear that another process sent a message of this service with this epoch."""
        self._lease.on_rival(epoch)

    # --- For the service and its REST interface ---------------------------------------------------------------------

    def standby_reason(self) -> str:
        """Return that this process stands by, and who leads; empty if it leads or takes over."""
        if self._lease.epoch:
            return ""
        leader = self._lease.leader
        if leader is None:
            return "this process stands by, and does not know yet who leads"
        return f"this process stands by: {leader.holder} leads with epoch {leader.epoch}"

    def subscribe(self) -> None:
        """Hear the announcements of other leaders."""
        self._zenoh.subscribe(ch.LEADER, Leader, self._on_leader)

    def _on_leader(self, ids: dict[str, str], leader: Leader) -> None:
        if ids["role"] == self._service:
            self._lease.on_leader(leader.epoch, leader.holder, time.monotonic())
        else:
            self.on_message(ch.LEADER, leader)

    # --- Running ----------------------------------------------------------------------------------------------------

    async def run(self, member: Member, needs: Mapping[str, Callable[[], Awaitable[bool]]]) -> None:
        """Take the lease when it is free, renew it, and let the service lead or stand by; until cancelled.

        needs: by name, what asks a transport or thread without which this process leaves the lease to another one.
        """
        member.stand_by()
        self._probes = Probes(needs)
        try:
            async with asyncio.TaskGroup() as tasks:
                self._probes.start(tasks)
                tasks.create_task(self._request_loop(), name="lease requests")
                while True:
                    self._lease.on_answer(self._probes.answered_at())
                    self._lease.tick(time.monotonic(), _proposal(), connected=self._connected())
                    self._apply(member, tasks)
                    self._announce()
                    await asyncio.sleep(_TICK_S)
        finally:
            self._lease.give_up()
            await self._leases.release(self.holder)

    async def _request_loop(self) -> None:
        while True:
            request = self._lease.request(time.monotonic())
            if request is None:
                await asyncio.sleep(_TICK_S / 2)
                continue
            reply = await self._leases.acquire(self.holder, request)
            self._lease.on_reply(request, reply, time.monotonic())
            with self._sending:
                if self._lease.permission(time.monotonic()) == "granted" and self._term[0] == self._lease.epoch:
                    self._send_waiting()

    def _apply(self, member: Member, tasks: asyncio.TaskGroup) -> None:
        """Tell the service, the metrics and the health when another epoch, or none, is ours."""
        term = (self._lease.epoch, self._lease.confirmed)
        if term != self._term:
            if term[0] != self._term[0]:
                with self._sending:
                    self._waiting.clear()
            before, self._term = self._term, term
            if self._takeover is not None:
                self._takeover.cancel()
            LEADS.set(term[0] > 0)
            EPOCH.set(term[0])
            if term[0]:
                TAKEOVERS.inc()
                _log.info("leading", epoch=term[0], confirmed=term[1], before=before[0], holder=self.holder)
                self._takeover = tasks.create_task(self._take_over(member, *term), name="takeover")
            else:
                _log.warning("standing_by", epoch=before[0], reason=self.standby_reason())
                member.stand_by()
        self._report()

    def _report(self) -> None:
        """Set the health: standing by is healthy as long as somebody leads."""
        epoch, confirmed = self._term
        lacking = self._lacking()
        if not epoch:
            self._health.set("lease", ok=self._lease.leader is not None, detail=self.standby_reason() + lacking)
        elif self._serving != epoch:
            self._health.set("lease", ok=False, detail=f"taking over with epoch {epoch}")
        else:
            provisional = "" if confirmed else ", which is provisional until Redis answers"
            silent = "; Redis does not answer, so nobody else can take over" if self._lease.redis_silent else ""
            self._health.set("lease", ok=True, detail=f"leads with epoch {epoch}{provisional}{silent}{lacking}")

    def _lacking(self) -> str:
        """Return what this process needs to lead and has no answer of; empty if it has all."""
        silent = ", ".join(self._probes.silent(CUT_OFF_S))
        return f"; no answer of {silent}, so a copy that gets one takes over" if silent else ""

    async def _take_over(self, member: Member, epoch: int, confirmed: bool) -> None:  # noqa: FBT001  # a term's parts
        while True:
            try:
                await member.lead(epoch, confirmed=confirmed)
            except StoreError as error:
                _log.warning("takeover_delayed", epoch=epoch, reason=str(error))
                await asyncio.sleep(_RETRY_S)
                continue
            self._serving = epoch
            return

    def _announce(self) -> None:
        now = time.monotonic()
        if self._lease.permission(now) == "granted" and now - self._announced_at >= ANNOUNCE_S - _TICK_S / 2:
            self._announced_at = now
            leader = Leader(epoch=self._lease.epoch, holder=self.holder, epochs=dict(self._epochs()))
            self._zenoh.publish(ch.LEADER, leader, role=self._service)

    def _send_waiting(self) -> None:
        """Send what was held back; the caller holds the lock."""
        while self._waiting:
            _, send = self._waiting.popleft()
            send()


def _proposal() -> int:
    """Return an epoch for a process that knows nothing: the clock (ms), and no other process proposes the same."""
    return int(time.time() * 1000) + secrets.randbelow(1000)
