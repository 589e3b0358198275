"""Which of several copies of a service may act: one holds a lease, and its epoch is the fencing number. Pure, no I/O.

Redis grants the lease for a short time and draws an epoch with it, larger than every one before (`leadership`). Every
message carries its sender's epoch and receivers refuse a lower one (`fog_contracts.handlers`), so a process that wakes
up after another took over can do no harm. Times are seconds of the process's own monotonic clock.

The holder may act until a deadline, counted from *before* its last request was sent:

- a grant moves the deadline by the lease's duration, less a margin for clocks that run at different rates;
- so does a request that Redis, out of order or out of reach, promptly failed to answer: a store must not stop the
  fleet, and nobody takes over through a Redis that does not answer. If it answers somebody else, that one's epoch is
  heard soon, and receivers refuse ours;
- a process that did not run for a while (it was stopped, swapped out, or its computer slept) learns nothing from an
  answer that it was too late to read: the deadline has passed, and it waits for the answer to its next request.

Whoever hears an epoch above its own stops acting at once and asks Redis. If it still holds the lease, the other epoch
is an old one, or was made without Redis: it continues with one above. A forged epoch leaves room for that, because a
leader counts no further than receivers follow it (`within_reach`). What robots tell of epochs, anybody with one
robot's password can say: a process whose lease Redis has confirmed goes on meanwhile, and asks only now and then.
Without Redis it gives way to a leader that is alive, and else makes a provisional epoch above all that it heard, which
Redis confirms or corrects later.

Redis also leads from a leader that can't do its work to a process that can: one whose transports or threads do not
answer gives the lease back, if a standby whose own do has said in Redis that it is ready. If none has, it goes on:
what it still does is better than nothing. A leader that is slow can't know that, and its way to Redis may be as slow: a
standby that hears its answers late, and would answer in time itself (`punctuality`), takes its lease, if the last time
that this happened is long enough ago. The old leader acts on until it hears of that; receivers and Redis's scripts
refuse its epoch. Nobody takes the lease of a leader that answers in time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Literal

from fog_contracts.handlers import within_reach

LEASE_S: Final = 1.2
"""Duration of the lease in Redis."""
RENEW_S: Final = 0.3
"""Period of the holder's requests; three may be lost."""
ATTEMPT_S: Final = 0.4
"""How long a request waits for Redis."""
ANNOUNCE_S: Final = 0.25
"""Period of the leader's announcements."""
LEADER_LOST_S: Final = 1.5
"""Without Redis: how long no leader must have been heard until a process leads with a provisional epoch."""
CUT_OFF_S: Final = 1.0
"""A process is cut off when what it needs to lead has not answered for so long."""
READY_S: Final = 0.35
"""A standby is ready to take over from a leader that is cut off while all that it needs has answered within this time.

It says so for `READY_SAID_S` more. Together they are shorter than `CUT_OFF_S` by a question's period: if a broker fails
for all, no standby is ready any more when the leader knows that it is cut off, and the lease stays where it is.
"""
READY_SAID_S: Final = 0.45
HEARSAY_PAUSE_S: Final = 10.0
"""So seldom Redis is asked for an epoch above one of which robots tell: each new one makes all fetch the map anew."""
HANDED_PAUSE_S: Final = 30.0
"""So long nobody takes the lease of another leader because it is late; after each further time, twice as long ..."""
HANDED_KNOWN_S: Final = 600.0
"""... until none did so for this time."""
_LISTEN_S: Final = 2 * ANNOUNCE_S + 0.1
"""Without Redis: how long a leader listens, after it did not run or could not hear, until it acts again."""
_RATE_MARGIN: Final = 0.9
"""The holder uses this share of the lease: its clock and that of Redis may run at rates 10 % apart."""
_PROMPT_S: Final = ATTEMPT_S + 0.2
"""An attempt that took longer shows that this process did not run, and not that Redis does not answer."""
_RETRY_S: Final = 0.02
"""Shortest time between two requests for a lease that is about to end."""
_PAUSE_S: Final = 1.0
"""A time between two calls of `tick`, which come ten times a second, that shows that this process did not run."""

Permission = Literal["granted", "pending", "refused"]
"""Whether the process may act: yes, not before Redis has answered, or no because another one leads (standby)."""


@dataclass(frozen=True)
class Request:
    """What to ask of Redis: the lease, with this epoch if it is still the highest (0: a new one), above `floor`.

    `confirmed`: Redis has granted the epoch before. `sent_at` is the time just before the request is sent. `ready`:
    this process would take over from one that is `cut_off` from what it needs. `late`: the epoch of a leader that
    answers later than this process would, 0 for none.
    """

    epoch: int
    floor: int
    confirmed: bool
    sent_at: float
    ready: bool = True
    cut_off: bool = False
    late: int = 0


@dataclass(frozen=True)
class Granted:
    """Redis granted the lease with this epoch; `taken`: it was a late leader's."""

    epoch: int
    taken: bool = False


@dataclass(frozen=True)
class Held:
    """Another process holds the lease, for `remaining_s` unless it renews it."""

    epoch: int
    holder: str
    remaining_s: float


@dataclass(frozen=True)
class LeftToOther:
    """This process is cut off, and another one is ready: it takes the lease, which is free now."""

    successor: str


Reply = Granted | Held | LeftToOther | None
"""The answer of Redis; None when there was none."""


@dataclass(frozen=True)
class Leader:
    """The other process that leads, as last heard."""

    epoch: int
    holder: str
    heard_at: float


class Lease:
    """The state of one process; `holder` is its id, unique among all processes that ever were."""

    def __init__(self, holder: str, now: float) -> None:
        self.holder = holder
        self.epoch = 0
        """The epoch with which this process leads; 0 on standby."""
        self.confirmed = False
        """Whether Redis has granted the epoch; else it is provisional."""
        self.leader: Leader | None = None
        """The other process that leads, if one was heard since this one last led."""
        self._floor = 0
        self._hearsay = 0
        """The highest epoch of which robots tell."""
        self._hearsay_due = -math.inf
        self._deadline = -math.inf
        self._request_due = now
        self._silent_since: float | None = None
        self._listening_since = now
        self._ticked_at = now
        self._started_at = now
        self._answered_at = -math.inf
        """A process that starts is not ready before it has an answer; for `cut_off` it has `CUT_OFF_S` to get one."""
        self._said_cut_off = False
        self._late = 0
        """The epoch of the leader, if this process finds it late; 0 if not."""

    # --- State out --------------------------------------------------------------------------------------------------

    def permission(self, now: float) -> Permission:
        """Return whether the process may act now; ask at the moment of each act, never before."""
        if self.epoch == 0:
            return "refused"
        return "granted" if now < self._deadline and not self._contested else "pending"

    @property
    def redis_silent(self) -> bool:
        """Whether Redis did not answer the last request."""
        return self._silent_since is not None

    def cut_off(self, now: float) -> bool:
        """Whether what this process needs to lead has not answered for too long."""
        return now - max(self._started_at, self._answered_at) > CUT_OFF_S

    @property
    def _contested(self) -> bool:
        """Whether an epoch was heard that is not below ours."""
        return self._floor >= self.epoch

    # --- Redis ------------------------------------------------------------------------------------------------------

    def request(self, now: float) -> Request | None:
        """Return the request that is due, if any; its outcome must come before the next call (`on_reply`)."""
        cut_off = self.cut_off(now)
        asks = self._hearsay > max(self._floor, self.epoch) and now >= self._hearsay_due
        urgent = self._contested or asks or (cut_off and not self._said_cut_off)
        if now < self._request_due and not (self.epoch and urgent):
            return None
        late = 0 if self.epoch else self._late
        self._request_due = now + RENEW_S
        self._said_cut_off = cut_off
        ready = now - self._answered_at <= READY_S
        if asks:
            self._hearsay_due = now + HEARSAY_PAUSE_S
        floor = max(self._floor, self._hearsay) if asks else self._floor
        return Request(self.epoch, floor, self.confirmed, now, ready=ready, cut_off=cut_off, late=late)

    def on_reply(self, request: Request, reply: Reply, now: float) -> None:
        """Apply the outcome of a request."""
        if reply is None:
            self._on_no_reply(request, now)
            return
        self._silent_since = None
        if isinstance(reply, Granted):
            if reply.epoch < self.epoch:
                # It comes so late that this process leads by now, with a provisional epoch, which receivers may know:
                # they would refuse a lower one. Redis confirms that epoch with the next request.
                self._request_due = now
                return
            self._lead(reply.epoch, request.sent_at, confirmed=True)
            return
        if isinstance(reply, LeftToOther):
            self._stand_by(None)
            return
        self._request_due = min(self._request_due, now + max(_RETRY_S, reply.remaining_s))
        self._stand_by(Leader(reply.epoch, reply.holder, now))

    def _on_no_reply(self, request: Request, now: float) -> None:
        if now - request.sent_at > _PROMPT_S:
            return
        if self._silent_since is None:
            self._silent_since = request.sent_at
        if self.epoch == 0:
            return
        if self._contested:
            if self._hears_leader(now):
                self._stand_by(self.leader)
        elif request.sent_at - self._listening_since >= _LISTEN_S:
            self._extend(request.sent_at)

    def _extend(self, sent_at: float) -> None:
        self._deadline = max(self._deadline, sent_at + LEASE_S * _RATE_MARGIN)

    def on_answer(self, asked_at: float) -> None:
        """Handle that all that this process needs to lead has answered a question that was asked then, or later.

        -inf: something has answered none yet.
        """
        self._answered_at = asked_at

    def judge(self, late: int, now: float) -> None:
        """Handle that the leader with the epoch `late` answers later than this process would; 0: no leader does."""
        if late and late != self._late and not self.epoch:
            self._request_due = min(self._request_due, now)
        self._late = late

    # --- Epochs heard -----------------------------------------------------------------------------------------------

    def on_leader(self, epoch: int, holder: str, now: float) -> None:
        """Handle the announcement of a process that leads; our own is ignored."""
        if holder == self.holder:
            return
        epoch = self._within_reach(epoch)
        if self.leader is None or epoch >= self.leader.epoch:
            self.leader = Leader(epoch, holder, now)
        if epoch >= self.epoch:
            self._hear(epoch)

    def on_epoch(self, epoch: int) -> None:
        """Handle an epoch of this service that other services have seen, whoever sent it; our own is no news."""
        if epoch > self.epoch:
            self._hear(epoch)

    def on_hearsay(self, epoch: int) -> None:
        """Handle an epoch of this service that a robot says it received: it may be forged."""
        self._hearsay = max(self._hearsay, self._within_reach(epoch))
        if self.epoch and not self.confirmed:
            self.on_epoch(epoch)

    def on_rival(self, epoch: int) -> None:
        """Handle a message of another process of this service that leads, or did; ours must be above its epoch."""
        self._hear(epoch)

    def _hear(self, epoch: int) -> None:
        self._floor = max(self._floor, self._within_reach(epoch))

    def _within_reach(self, epoch: int) -> int:
        return within_reach(epoch, max(self._floor, self.epoch))

    def _leader_heard_at(self) -> float:
        """When a leader with an epoch not below ours was last heard."""
        return self.leader.heard_at if self.leader is not None and self.leader.epoch >= self.epoch else -math.inf

    def _hears_leader(self, now: float) -> bool:
        return now - self._leader_heard_at() <= LEADER_LOST_S

    # --- Without Redis ----------------------------------------------------------------------------------------------

    def tick(self, now: float, proposal: int, *, connected: bool) -> None:
        """Lead with a provisional epoch if nobody else does; call it ten times a second.

        `proposal` is used if it is higher than all epochs heard; two processes must not propose the same. `connected`:
        whether this process could hear a leader.
        """
        if not connected or now - self._ticked_at > _PAUSE_S:
            self._listening_since = now
        self._ticked_at = now
        if self._silent_since is None or (self.epoch and not self._contested):
            return
        quiet_since = max(self._listening_since, self._silent_since, self._leader_heard_at())
        if now - quiet_since > LEADER_LOST_S:
            # The distance keeps two processes apart that heard the same epochs.
            heard = max(self._floor, self._hearsay)
            self._lead(max(proposal, heard + 1 + proposal % 1000), now, confirmed=False)

    def give_up(self) -> None:
        """Stop acting for good: the process ends, and gives the lease back."""
        self._stand_by(None)

    # --- Changes ----------------------------------------------------------------------------------------------------

    def _lead(self, epoch: int, since: float, *, confirmed: bool) -> None:
        if epoch != self.epoch:
            self._deadline = -math.inf
        self.epoch, self.confirmed, self.leader = epoch, confirmed, None
        self._extend(since)

    def _stand_by(self, leader: Leader | None) -> None:
        self._floor = max(self._floor, self.epoch, self._within_reach(leader.epoch) if leader is not None else 0)
        self.epoch, self.confirmed, self.leader, self._deadline = 0, False, leader, -math.inf
