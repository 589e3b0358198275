"""The lease's state machine: single steps, and a model of processes with pauses and partitions, and a lossy Redis.

`FOGNAV_HISTORIES` sets how many random histories of the model are tried.
"""

import contextlib
import itertools
import math
import os

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from lease_model import LEASE_S, LeaseModel

from fog_contracts.handlers import HEARD_LIMIT, MOST_AHEAD, Fence, RefusedMessageError
from fog_runtime.lease import CUT_OFF_S, HANDED_PAUSE_S, HEARSAY_PAUSE_S, Granted, Held, Lease, LeftToOther
from fog_runtime.punctuality import Punctuality

ATTEMPT_S, STEP_S, PROBE_S = 0.4, 0.05, 0.2
TAKEOVER_S, LATE_TAKEOVER_S = 2.0, 1.2
QUESTION_S = 0.1
DEATHS = ("crash", "stop", "cut", "needs", "late", "lost")


def leading(epoch: int = 5, at: float = 0.0) -> Lease:
    lease = Lease("a", at - 10.0)
    request = lease.request(at)
    assert request is not None
    lease.on_reply(request, Granted(epoch), at + 0.01)
    return lease


def test_permission_ends_before_the_lease_does_counted_from_before_the_request():
    lease = leading(at=100.0)
    assert lease.permission(101.0) == "granted"
    assert lease.permission(101.1) == "pending"
    assert lease.permission(101.0) == "granted"


def test_grant_that_was_read_too_late_permits_nothing():
    lease = leading(at=100.0)
    request = lease.request(100.3)
    lease.on_reply(request, Granted(5), 103.0)
    assert lease.permission(103.0) == "pending"
    request = lease.request(103.0)
    lease.on_reply(request, Granted(5), 103.1)
    assert lease.permission(103.1) == "granted"


@pytest.mark.parametrize("hear", ["on_epoch", "on_rival", "on_leader"])
def test_forged_epoch_leaves_room_for_a_leader_above_it(hear):
    lease = leading(at=100.0)

    def forge() -> None:
        if hear == "on_leader":
            lease.on_leader(2**53, "b", 100.1)
        else:
            getattr(lease, hear)(2**53)

    forge()
    assert lease.permission(100.1) == "pending"
    request = lease.request(100.1)
    lease.on_reply(request, Granted(request.floor + 1), 100.2)
    assert request.floor + 1 < 2**53, "a number that messages and Redis can carry"
    assert lease.permission(100.3) == "granted"


@pytest.mark.parametrize("forged", [HEARD_LIMIT + 2, HEARD_LIMIT + MOST_AHEAD, HEARD_LIMIT + 2**32, 2**53])
def test_leader_continues_above_an_epoch_that_was_forged_to_its_receivers(forged):
    lease, fence = leading(at=100.0), Fence()
    for round_ in range(3):
        now = 100.1 + 0.3 * round_
        with contextlib.suppress(RefusedMessageError):
            fence.accept("planner", forged)
        lease.on_epoch(fence.epochs["planner"])  # as receivers report it
        request = lease.request(now)
        if request is not None:
            lease.on_reply(request, Granted(max(lease.epoch, request.floor + 1)), now + 0.01)
        fence.accept("planner", lease.epoch)
        assert lease.permission(now + 0.02) == "granted"


@pytest.mark.parametrize("hear", ["on_rival", "on_leader"])
def test_leader_above_all_clocks_still_gives_way_to_a_higher_epoch(hear):
    lease = leading(HEARD_LIMIT + 5, at=100.0)
    if hear == "on_leader":
        lease.on_leader(HEARD_LIMIT + 6, "b", 100.1)
    else:
        lease.on_rival(HEARD_LIMIT + 6)
    assert lease.permission(100.1) == "pending"
    request = lease.request(100.1)
    assert request is not None
    assert request.floor == HEARD_LIMIT + 6


def test_leader_acts_on_while_redis_promptly_fails_to_answer():
    lease = leading(at=100.0)
    for step in range(40):
        now = 100.3 + 0.4 * step
        request = lease.request(now)
        lease.on_reply(request, None, now + 0.4)
        assert lease.permission(now + 0.4) == "granted"


def test_attempt_during_which_the_process_did_not_run_permits_nothing():
    lease = leading(at=100.0)
    request = lease.request(100.3)
    lease.on_reply(request, None, 103.0)
    assert lease.permission(103.0) == "pending"


def test_process_that_finds_the_lease_held_by_another_stands_by():
    lease = leading(5, at=100.0)
    request = lease.request(100.3)
    lease.on_reply(request, Held(6, "b", 1.0), 100.4)
    assert lease.permission(100.4) == "refused"
    assert lease.leader is not None
    assert (lease.leader.holder, lease.leader.epoch) == ("b", 6)


def test_higher_epoch_stops_the_leader_at_once_until_redis_gives_it_one_above():
    lease = leading(5, at=100.0)
    lease.on_epoch(9)
    assert lease.permission(100.1) == "pending"
    request = lease.request(100.1)
    assert request is not None, "it asks at once"
    assert request.floor == 9
    lease.on_reply(request, Granted(10), 100.2)
    assert (lease.epoch, lease.permission(100.2)) == (10, "granted")


def test_higher_epoch_that_robots_tell_of_leaves_the_leader_acting_and_is_asked_about_once_in_ten_seconds():
    lease = leading(5, at=100.0)
    floors = []
    for step in range(400):
        now = 100.05 + 0.05 * step
        lease.on_hearsay(lease.epoch + 1000)
        assert lease.permission(now) == "granted"
        if (request := lease.request(now)) is not None:
            if request.floor >= lease.epoch:
                floors.append(request.floor)
            lease.on_reply(request, Granted(max(lease.epoch, request.floor + 1)), now + 0.01)
    assert floors == [1005, 2006]
    assert lease.epoch == 2007


def test_epoch_that_robots_tell_of_is_one_step_of_theirs_however_often_it_is_forged():
    lease, fence = leading(HEARD_LIMIT, at=100.0), Fence()
    for _ in range(1000):
        lease.on_hearsay(2**53)
    request = lease.request(100.1)
    fence.accept("planner", HEARD_LIMIT)
    fence.accept("planner", request.floor)


def test_same_epoch_of_another_process_stops_the_leader():
    lease = leading(5, at=100.0)
    lease.on_leader(5, "a", 100.1)
    assert lease.permission(100.1) == "granted"
    lease.on_leader(5, "b", 100.1)
    assert lease.permission(100.1) == "pending"


def test_epoch_heard_while_the_grant_was_on_its_way_is_answered_with_a_further_request():
    lease = Lease("a", 0.0)
    request = lease.request(0.0)
    lease.on_epoch(50)
    lease.on_reply(request, Granted(7), 0.1)
    assert lease.permission(0.1) == "pending"
    assert lease.request(0.1).floor == 50


def test_grant_that_comes_after_the_process_led_without_it_does_not_lower_its_epoch():
    lease = Lease("a", 100.0)
    lost = lease.request(100.0)
    lease.on_reply(lost, None, 100.4)
    late = lease.request(100.5)
    for step in range(20):  # the process runs slowly: the answer waits to be read
        lease.tick(100.5 + 0.1 * step, 2000, connected=True)
    assert (lease.epoch, lease.confirmed) == (2000, False)
    lease.on_reply(late, Granted(1500), 102.45)
    assert (lease.epoch, lease.confirmed, lease.permission(102.46)) == (2000, False, "granted")
    again = lease.request(102.46)
    assert (again.epoch, again.confirmed) == (2000, False)
    lease.on_reply(again, Granted(2000), 102.47)
    assert (lease.epoch, lease.confirmed) == (2000, True)


def test_standby_asks_again_when_the_lease_of_the_other_is_about_to_end():
    lease = Lease("a", 0.0)
    lease.on_reply(lease.request(0.0), Held(3, "b", 0.1), 0.05)
    assert lease.request(0.1) is None
    assert lease.request(0.16) is not None


def test_leader_without_answers_asks_redis_at_once_whether_another_is_ready_and_leaves_it_the_lease():
    lease = leading(5, at=100.0)
    for at, cut_off in ((100.3, False), (100.6, False), (100.9, False)):
        lease.on_answer(100.0)
        request = lease.request(at)
        assert (request.ready, request.cut_off) == (at < 100.35, cut_off)
        lease.on_reply(request, Granted(5), at + 0.01)
    assert lease.request(100.99) is None
    request = lease.request(101.05)
    assert (request.ready, request.cut_off) == (False, True)
    lease.on_reply(request, LeftToOther("b"), 101.06)
    assert lease.permission(101.06) == "refused"
    assert lease.request(101.1) is None, "the other one comes first"


def test_process_that_has_just_started_is_neither_ready_nor_cut_off_before_the_first_answer():
    lease = Lease("a", 100.0)
    for at, answered_at, outcome in (
        (100.0, -math.inf, (False, False)),
        (101.0, -math.inf, (False, False)),
        (101.3, -math.inf, (False, True)),
        (101.6, 101.5, (True, False)),
    ):
        lease.on_answer(answered_at)
        request = lease.request(at)
        assert (request.ready, request.cut_off) == outcome
        lease.on_reply(request, Held(5, "b", 0.1), at + 0.01)


def test_leader_without_answers_goes_on_while_nobody_else_is_ready():
    lease = leading(5, at=100.0)
    lease.on_answer(100.0)
    for step in range(20):
        now = 101.1 + 0.3 * step
        lease.on_reply(lease.request(now), Granted(5), now + 0.01)
        assert (lease.epoch, lease.permission(now + 0.02)) == (5, "granted")


def test_standby_that_finds_the_leader_late_asks_for_its_lease_at_once_and_no_more_when_that_answers_in_time():
    lease = Lease("a", 100.0)
    lease.on_answer(100.0)
    lease.on_reply(lease.request(100.0), Held(5, "b", 1.2), 100.01)
    assert lease.request(100.1) is None
    lease.judge(5, 100.1)
    assert lease.request(100.1).late == 5
    lease.judge(5, 100.15)
    assert lease.request(100.15) is None
    lease.judge(0, 100.25)
    assert lease.request(100.41).late == 0


def test_leader_judges_nobody():
    lease = leading(5, at=100.0)
    lease.judge(5, 100.1)
    assert lease.request(100.1) is None
    assert lease.request(100.3).late == 0


def without_redis(lease: Lease, begin: float, end: float, *, connected: bool = True, proposal: int = 1000) -> None:
    """Let a process run without an answer from Redis."""
    for step in range(round((end - begin) / 0.1)):
        now = begin + 0.1 * step
        lease.tick(now, proposal, connected=connected)
        if (request := lease.request(now)) is not None:
            lease.on_reply(request, None, now + 0.01)


def test_process_without_redis_and_without_a_leader_leads_above_all_that_it_heard():
    lease = Lease("a", 0.0)
    lease.on_epoch(5000)
    without_redis(lease, 0.0, 1.4)
    assert lease.epoch == 0
    without_redis(lease, 1.4, 2.2)
    assert lease.epoch > 5000
    assert not lease.confirmed
    assert lease.permission(2.2) == "granted"


def test_provisional_epoch_is_corrected_above_one_that_is_heard_later():
    lease = Lease("a", 0.0)
    without_redis(lease, 0.0, 2.2)
    assert lease.epoch == 1000
    lease.on_epoch(2000)
    assert lease.permission(2.2) == "pending"
    without_redis(lease, 2.2, 2.5)
    assert lease.epoch > 2000
    assert lease.permission(2.5) == "granted"


def test_provisional_epoch_is_confirmed_or_corrected_when_redis_answers():
    lease = Lease("a", 0.0)
    without_redis(lease, 0.0, 2.2)
    request = lease.request(2.5)
    assert (request.epoch, request.confirmed) == (1000, False)
    lease.on_reply(request, Granted(7777), 2.6)
    assert (lease.epoch, lease.confirmed) == (7777, True)


def test_process_without_redis_follows_a_leader_that_is_alive():
    lease = Lease("a", 0.0)
    for second in range(10):
        lease.on_leader(5, "b", float(second))
        without_redis(lease, float(second), second + 1.0)
    assert lease.epoch == 0
    without_redis(lease, 10.0, 12.0)
    assert lease.epoch == 1000


def test_process_that_can_hear_nobody_does_not_lead_without_redis():
    lease = Lease("a", 0.0)
    without_redis(lease, 0.0, 10.0, connected=False)
    assert lease.epoch == 0


def test_process_that_did_not_run_listens_before_it_leads_or_acts_without_redis():
    standby = Lease("a", 0.0)
    without_redis(standby, 0.0, 1.0)
    without_redis(standby, 60.0, 61.0)
    assert standby.epoch == 0
    leader = leading(5, at=0.0)
    without_redis(leader, 0.3, 3.0)
    assert leader.permission(3.0) == "granted"
    without_redis(leader, 60.0, 60.4)
    assert leader.permission(60.4) == "pending"
    without_redis(leader, 60.4, 61.5)
    assert leader.permission(61.5) == "granted"


def test_leader_without_redis_gives_way_to_a_living_leader_with_a_higher_epoch_only():
    lease = leading(5, at=0.0)
    lease.on_leader(4, "b", 0.3)
    without_redis(lease, 0.3, 1.0)
    assert lease.permission(1.0) == "granted"
    lease.on_leader(6, "c", 1.0)
    without_redis(lease, 1.0, 1.5)
    assert (lease.epoch, lease.permission(1.5)) == (0, "refused")


# --- A model: three processes, Redis, one receiver ------------------------------------------------------------------


class Process:
    """A process that runs its loop every 50 ms, unless it is stopped; `rate` is that of its clock."""

    def __init__(self, name: str, now: float, rate: float) -> None:
        self.name, self.rate, self.offset = name, rate, 1000.0 * (ord(name[0]) - 96) - now * rate
        self.lease = Lease(name, self.clock(now))
        self.stopped_until = self.answered_at = -1.0
        self.redis_cut = self.network_cut = self.needs_cut = False
        self.pending = None
        """The request on its way: (request, when it reaches Redis or None, reply, when the reply is here)."""
        self.inbox: list[tuple[int, str]] = []
        self.slow_s = 0.0
        """How long its answers take; infinite: they are lost."""
        self.leaders, self.own = Punctuality(), Punctuality()
        self.answers: list[tuple[float, int, float]] = []
        """Answers on their way to this process: when they arrive, of which epoch, to the question of when."""

    def clock(self, now: float) -> float:
        return now * self.rate + self.offset


class Cluster(RuleBasedStateMachine):
    """Never two in the eyes of a receiver, and soon one again."""

    @initialize(rates=st.tuples(*[st.sampled_from([0.96, 1.0, 1.04])] * 3))
    def start(self, rates):
        self.now = 0.0
        self.redis, self.redis_up = LeaseModel(), True
        self.names = 0
        self.rates = rates
        self.processes = [self.process(index) for index in range(3)]
        self.owners: dict[int, str] = {}
        self.highest = 0
        self.accepted: list[tuple[float, int]] = []
        self.delay = 0.0
        self.lost_at = -math.inf
        """When Redis last lost its data, and with them the lease of who held it."""

    def process(self, index: int) -> Process:
        self.names += 1
        return Process(f"{'abc'[index]}{self.names}", self.now, self.rates[index])

    # --- Disturbances ---

    @rule(which=st.integers(0, 2), seconds=st.sampled_from([0.2, 0.5, 1.0, 1.4, 3.0, 6.0]))
    def stop(self, which, seconds):
        self.processes[which].stopped_until = self.now + seconds

    @rule(which=st.integers(0, 2), needs_cut=st.booleans())
    def crash(self, which, needs_cut):
        self.processes[which] = self.process(which)
        self.processes[which].needs_cut = needs_cut

    @rule(which=st.integers(0, 2), cut=st.booleans())
    def cut_from_redis(self, which, cut):
        self.processes[which].redis_cut = cut

    @rule(which=st.integers(0, 2), cut=st.booleans())
    def cut_from_network(self, which, cut):
        self.processes[which].network_cut = cut

    @rule(which=st.integers(0, 2), cut=st.booleans())
    def cut_from_needs(self, which, cut):
        self.processes[which].needs_cut = cut

    @rule(which=st.integers(0, 2), seconds=st.sampled_from([0.0, 0.1, 0.3, 0.6, math.inf]))
    def slow(self, which, seconds):
        self.processes[which].slow_s = seconds

    @rule(up=st.booleans(), lost=st.booleans())
    def redis_restarts(self, up, lost):
        self.redis_up = up
        if lost:
            self.redis = LeaseModel()
            self.lost_at = self.now

    @rule(delay=st.sampled_from([0.0, 0.1, 0.3, 0.6]))
    def redis_is_slow(self, delay):
        self.delay = delay

    @rule(steps=st.integers(1, 60))
    def run(self, steps):
        for _ in range(steps):
            self.step()

    @rule()
    def heal(self):
        """Without disturbances, one leads within 2 s, and only one."""
        self.redis_up, self.delay = True, 0.0
        for process in self.processes:
            process.redis_cut = process.network_cut = process.needs_cut = False
            process.stopped_until, process.slow_s = -1.0, 0.0
        for _ in range(round(2 * TAKEOVER_S / STEP_S)):
            self.step()
        for _ in range(round((HEARSAY_PAUSE_S + 2 * TAKEOVER_S) / STEP_S)):
            if self.highest in {p.lease.epoch for p in self.processes}:
                break
            self.step()  # robots tell of an epoch once more, soon after another time
        leaders = [p for p in self.processes if p.lease.permission(p.clock(self.now)) == "granted"]
        assert len(leaders) == 1
        assert leaders[0].lease.epoch == self.highest, "receivers accept its messages"
        assert leaders[0].lease.confirmed
        assert self.accepted[-1][0] > self.now - 2 * STEP_S

    @rule(death=st.sampled_from(DEATHS), steps=st.integers(0, 7), awake=st.booleans())
    def takeover(self, death, steps, awake):
        """After the leader's death, hang, partition or slowness another one's messages are accepted within 2 s."""
        self.heal()
        for _ in range(steps):
            self.step()
        leader = next(p for p in self.processes if p.lease.epoch)
        began, old = self.now, leader.lease.epoch
        if death == "crash":
            self.processes.remove(leader)
        elif death == "stop":
            leader.stopped_until = self.now + 10.0
        elif death == "needs":
            leader.needs_cut = True
        elif death in ("late", "lost"):
            self.redis.handed.clear()  # as if the last one was long ago
            leader.slow_s = 0.5 if death == "late" else math.inf
        else:
            leader.redis_cut = leader.network_cut = True
        while self.highest == old:
            self.step()
            assert self.now - began <= (LATE_TAKEOVER_S if death in ("late", "lost") else TAKEOVER_S)
        if death == "crash":
            self.processes.insert("abc".index(leader.name[0]), self.process("abc".index(leader.name[0])))
        elif awake:
            self.heal()

    @rule(steps=st.integers(0, 7), starts_at=st.none() | st.integers(0, round(3 * CUT_OFF_S / STEP_S) - 1))
    def needs_fail_for_all(self, steps, starts_at):
        """A leader goes on if what it needs answers nobody else either, nor who starts meanwhile."""
        self.heal()
        for _ in range(steps):
            self.step()
        old = self.highest
        for process in self.processes:
            process.needs_cut = True
        for step in range(round(3 * CUT_OFF_S / STEP_S)):
            if step == starts_at:
                standby = next(index for index, process in enumerate(self.processes) if not process.lease.epoch)
                self.crash(standby, needs_cut=True)
            self.step()
        assert self.highest == old
        assert self.accepted[-1][0] > self.now - 2 * STEP_S
        self.heal()

    @rule(seconds=st.sampled_from([0.3, 0.6, math.inf]))
    def all_are_slow(self, seconds):
        """A late leader goes on if the others are as slow."""
        self.heal()
        for process in self.processes:
            process.slow_s = seconds
        old = self.highest
        for _ in range(round(3.0 / STEP_S)):
            self.step()
        assert self.highest == old
        self.heal()

    # --- The world ---

    def step(self) -> None:
        self.now = round(self.now + STEP_S, 6)
        if round(self.now / STEP_S) % round(QUESTION_S / STEP_S) == 0:
            self.question()
        for process in self.processes:
            self.transport(process)
            if self.now >= process.stopped_until:
                self.loop(process)

    def question(self) -> None:
        """Let all hear the map's heartbeat, and answer it: the leader aloud, the others for themselves."""
        for process in self.processes:
            if self.now < process.stopped_until:
                continue
            clock, question = process.clock(self.now), (1, self.now)
            process.leaders.on_question(question, clock)
            process.own.on_question(question, clock)
            answered = self.now + process.slow_s
            process.answers.append((answered, 0, self.now))
            if process.lease.permission(clock) == "granted" and not process.network_cut:
                others = [other for other in self.processes if other is not process and not other.network_cut]
                for other in others:
                    other.answers.append((answered, process.lease.epoch, self.now))

    def judge(self, process: Process, clock: float) -> None:
        """Let a process judge the leader, as `Leadership` does."""
        lease = process.lease
        epoch = 0 if lease.epoch or lease.leader is None else lease.leader.epoch
        process.leaders.follow(epoch)
        for at, answering, asked in process.answers:
            if at <= self.now and answering == 0:
                process.own.on_answer((1, asked), clock)
            elif at <= self.now and answering == epoch:
                process.leaders.on_answer((1, asked), clock)
        process.answers = [answer for answer in process.answers if answer[0] > self.now]
        late = process.leaders.is_late(clock) and process.own.is_quick(clock)
        lease.judge(epoch if late else 0, clock)

    def transport(self, process: Process) -> None:
        """Let a request reach Redis, which answers also who does not run."""
        if process.pending is None:
            return
        request, arrives, reply, back = process.pending
        if reply is None and self.redis_up and not process.redis_cut and self.now >= arrives:
            reply = self.redis.acquire(process.name, request, self.now, self.wall_clock())
            back = self.now + self.delay / 2
            process.pending = request, arrives, reply, back

    def loop(self, process: Process) -> None:
        lease, clock = process.lease, process.clock(self.now)
        # A process that did not run acts before it has read what came meanwhile, and reads the oldest news last.
        self.act(process, clock)
        if process.pending is not None:
            request, _, reply, back = process.pending
            if reply is not None and self.now >= back:
                lease.on_reply(request, reply, clock)
                process.pending = None
            elif clock - request.sent_at >= ATTEMPT_S:
                lease.on_reply(request, None, clock)
                process.pending = None
        self.act(process, clock)
        if not process.network_cut:
            for epoch, holder in process.inbox:
                lease.on_leader(epoch, holder, clock)
            lease.on_hearsay(self.highest)  # the robots' states tell it
        process.inbox.clear()
        self.judge(process, clock)
        if not process.needs_cut and self.now >= process.answered_at + PROBE_S:
            process.answered_at = self.now
            lease.on_answer(clock)
        lease.tick(clock, self.wall_clock() + ord(process.name[0]), connected=not process.network_cut)
        if process.pending is None and (request := lease.request(clock)) is not None:
            process.pending = request, self.now + self.delay / 2, None, 0.0
        self.act(process, clock)

    def wall_clock(self) -> int:
        """Milliseconds; it may be wrong, as long as it is not wrong when everything else is lost."""
        return round(self.now * 1000)

    def act(self, process: Process, clock: float) -> None:
        lease = process.lease
        if lease.permission(clock) != "granted":
            return
        assert self.owners.setdefault(lease.epoch, process.name) == process.name, "an epoch has one owner"
        others = [p for p in self.processes if p is not process]
        both_reach_redis = self.redis_up and not process.redis_cut
        for other in others:
            if both_reach_redis and not other.redis_cut and lease.confirmed and other.lease.confirmed:
                assert not self.rivals(process, other), "two hold the lease of one Redis"
        if process.network_cut:
            return
        if lease.epoch >= self.highest:
            self.highest = lease.epoch
            self.accepted.append((self.now, lease.epoch))
        for other in others:
            if not other.network_cut:
                other.inbox.append((lease.epoch, lease.holder))

    def rivals(self, process: Process, other: Process) -> bool:
        return (
            not process.lease.redis_silent
            and not other.lease.redis_silent
            and other.lease.permission(other.clock(self.now)) == "granted"
            and self.now >= other.stopped_until
            and self.now - self.lost_at > LEASE_S
            and not (self.redis.handed and self.now - self.redis.handed[-1] <= LEASE_S)  # one was late: not told yet
        )

    @invariant()
    def leases_of_late_leaders_change_hands_seldom(self):
        handed = getattr(self, "redis", LeaseModel()).handed
        pauses = [after - before for before, after in itertools.pairwise(handed)]
        assert all(pause >= HANDED_PAUSE_S * 2**times for times, pause in enumerate(pauses))

    @invariant()
    def receiver_never_goes_back(self):
        epochs = [epoch for _, epoch in getattr(self, "accepted", [])]
        assert epochs == sorted(epochs)


TestCluster = Cluster.TestCase
TestCluster.settings = settings(
    max_examples=int(os.environ.get("FOGNAV_HISTORIES", "30")),
    stateful_step_count=25,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)
