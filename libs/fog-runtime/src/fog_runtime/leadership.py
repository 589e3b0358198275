"""Runs the lease of a process: one of several copies of a service leads, the others follow everything and say nothing.

`lease` decides, `lease_store` asks Redis. The edges pass everything that is published through `admit`, and answer
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
from typing import TYPE_CHECKING, Final, Protocol

from prometheus_client import Counter, Gauge

from fog_contracts import channels as ch
from fog_contracts.handlers import epoch_in
from fog_contracts.messages import Leader
from fog_runtime import logs
from fog_runtime.lease import ANNOUNCE_S, CUT_OFF_S, Granted, Lease, LeftToOther, Reply, Request
from fog_runtime.process import process_id
from fog_runtime.punctuality import QUICK_S, Punctuality
from fog_runtime.stores.redis_connection import StoreError

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable, Mapping

    from fog_contracts.channels import Channel, Role
    from fog_contracts.messages import Sent
    from fog_runtime.health import Health
    from fog_runtime.transports.zenoh_edge import ZenohEdge

_log = logs.get("leadership")


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
        self._took = dict.fromkeys(needs, math.inf)
        self._waiting: dict[str, float] = {}
        """When each question was asked that has no answer yet."""

    def answered_at(self) -> float:
        """Return when the question was asked that was answered last, of the need for which that is longest ago.

        -inf while something has answered none.
        """
        return min(self._answered_at.values(), default=time.monotonic())

    def took(self) -> float:
        """Return how long (s) the slowest of the latest answers took, or is awaited."""
        now = time.monotonic()
        return max((*self._took.values(), *(now - asked_at for asked_at in self._waiting.values())), default=0.0)

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
            asked_at = self._waiting[name] = time.monotonic()
            if await ask():
                self._answered_at[name] = asked_at
                self._took[name] = time.monotonic() - asked_at
            del self._waiting[name]
            await asyncio.sleep(PROBE_S)


_LEADERS_WAY: Final = "zenoh"
"""The need on whose way leaders announce themselves."""
_TICK_S: Final = 0.05
_RETRY_S: Final = 0.2
_HELD_BACK: Final = 2048
"""Messages that may wait while the lease is uncertain; the oldest are dropped first."""

LEADS: Final = Gauge("fognav_leader", "Whether this process leads its service (1) or stands by (0)")
EPOCH: Final = Gauge("fognav_epoch", "Epoch with which this process leads, its fencing number; 0 on standby")
TAKEOVERS: Final = Counter("fognav_takeovers_total", "How often this process began to lead, or got another epoch")
HANDED_OVER: Final = Counter(
    "fognav_leases_handed_over_total",
    "How often this process gave its lease to a copy that was ready (cut off), or took that of a leader (late)",
    ["reason"],
)
for _reason in ("late", "cut off"):  # `increase` sees the first time only of what was 0 before
    HANDED_OVER.labels(_reason)
LATENESS: Final = Gauge(
    "fognav_leader_lateness_seconds",
    "Median time in which the leader answers, as this standby hears it; NaN if unknown",
)
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
        self._newest: Sent | None = None
        self._asked = asyncio.Event()
        self._leaders, self._own = Punctuality(), Punctuality()
        """How late the leader answers while this process stands by, and how late this process would."""
        self._late = 0
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
            now = time.monotonic()
            self._lease.on_leader(leader.epoch, leader.holder, now)
            self._leaders.follow(self._leader_epoch())
            if leader.epoch == self._leader_epoch() and leader.answered is not None:
                self._leaders.on_answer(leader.answered, now)
            elif leader.epoch == self._leader_epoch():
                self._leaders.on_no_answer()
        else:
            self.on_message(ch.LEADER, leader)

    # --- Late leaders -----------------------------------------------------------------------------------------------

    def ask(self, question: Sent) -> None:
        """Hear a question that every copy handles, and the leader answers in its announcement."""
        now = time.monotonic()
        self._leaders.on_question(question, now)
        self._own.on_question(question, now)
        self._newest = question
        self._asked.set()

    async def _answer_loop(self, handled: Callable[[], Awaitable[object]]) -> None:
        """Answer the newest question whenever it has been handled; a standby only finds out how long that takes."""
        while True:
            await self._asked.wait()
            self._asked.clear()
            question = self._newest
            assert question is not None
            await handled()
            self._own.on_answer(question, time.monotonic())
            self._announce(question)

    def _leader_epoch(self) -> int:
        return 0 if self._lease.epoch or self._lease.leader is None else self._lease.leader.epoch

    def _judge_leader(self) -> None:
        """Say whether the leader is late, and this process would be quicker."""
        now, epoch = time.monotonic(), self._leader_epoch()
        self._leaders.follow(epoch)
        took = self._leaders.median(now) if epoch else math.nan
        LATENESS.set(took)
        late = self._leaders.is_late(now) and self._own.is_quick(now) and self._probes.took() <= QUICK_S
        late_epoch = epoch if late else 0
        if late_epoch and late_epoch != self._late:
            own = round(self._own.median(now), 3)
            _log.warning("leader_is_late", epoch=epoch, median_s=round(took, 3), own_median_s=own, holder=self.holder)
        self._late = late_epoch
        self._lease.judge(late_epoch, now)

    # --- Running ----------------------------------------------------------------------------------------------------

    async def run(
        self,
        member: Member,
        needs: Mapping[str, Callable[[], Awaitable[bool]]],
        handled: Callable[[], Awaitable[object]] | None = None,
    ) -> None:
        """Take the lease when it is free, renew it, and let the service lead or stand by; until cancelled.

        needs: by name, what asks a transport or thread without which this process leaves the lease to another one.
        handled: returns once what came before has been handled; with it, this process answers what it is asked (`ask`).
        """
        member.stand_by()
        self._probes = Probes(needs)
        try:
            async with asyncio.TaskGroup() as tasks:
                self._probes.start(tasks)
                tasks.create_task(self._request_loop(), name="lease requests")
                if handled is not None:
                    tasks.create_task(self._answer_loop(handled), name="answers")
                while True:
                    self._lease.on_answer(self._probes.answered_at())
                    self._judge_leader()
                    # A connection that looks well, and on which nothing comes, tells nothing of other leaders.
                    hears = self._connected() and _LEADERS_WAY not in self._probes.silent(CUT_OFF_S)
                    self._lease.tick(time.monotonic(), _proposal(), connected=hears)
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
            match reply:
                case LeftToOther(successor):
                    HANDED_OVER.labels("cut off").inc()
                    _log.warning("lease_handed_over", epoch=request.epoch, to=successor)
                case Granted(taken=True):
                    HANDED_OVER.labels("late").inc()
                    _log.warning("lease_taken", of=request.late, epoch=reply.epoch)
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

    def _announce(self, answered: Sent | None = None) -> None:
        now = time.monotonic()
        due = answered is not None or now - self._announced_at >= ANNOUNCE_S - _TICK_S / 2
        if due and self._lease.permission(now) == "granted":
            self._announced_at = now
            epochs = dict(self._epochs())
            leader = Leader(epoch=self._lease.epoch, holder=self.holder, epochs=epochs, answered=answered)
            self._zenoh.publish(ch.LEADER, leader, role=self._service)

    def _send_waiting(self) -> None:
        """Send what was held back; the caller holds the lock."""
        while self._waiting:
            _, send = self._waiting.popleft()
            send()


def _proposal() -> int:
    """Return an epoch for a process that knows nothing: the clock (ms), and no other process proposes the same."""
    return int(time.time() * 1000) + secrets.randbelow(1000)
