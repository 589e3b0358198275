"""Leading and standing by, with the edges that publish: three processes of a service, a store of leases, one receiver.

Time is simulated, and each process has an event loop of its own, so that one can be stopped while the others go on.
`FOGNAV_HISTORIES` sets how many random histories of the model are tried.
"""

import asyncio
import contextlib
import gc
import itertools
import os
import threading

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, invariant, rule
from lease_model import LeaseModel
from manual_clock import ManualClock

from fog_contracts import channels as ch
from fog_contracts.handlers import Fence, Publication, RefusedMessageError
from fog_contracts.messages import Leader, MapHeartbeat, RobotState, ZoneSet
from fog_runtime import leadership
from fog_runtime.health import Health
from fog_runtime.leadership import Leadership
from fog_runtime.stores.redis_connection import StoreError
from fog_runtime.transports.edges import Edges

STEP_S = 0.01
TAKEOVER_S = 2.0
SERVICE = "map-service"
NAMES = ("a", "b", "c")


class SimulatedLoop(asyncio.SelectorEventLoop):
    """An event loop whose time is the world's; `turn` runs what is due, and waits for nothing."""

    def __init__(self, world: "World") -> None:
        super().__init__()
        self._world = world

    def time(self) -> float:
        return self._world.now

    def turn(self) -> None:
        for _ in range(4):
            self.call_soon(self.stop)
            self.run_forever()


class Process:
    """One copy of the service: its leadership, its edges, and a core that publishes all the time."""

    def __init__(self, name: str, world: "World") -> None:
        self.name = name
        self.world = world
        self.loop = SimulatedLoop(world)
        self.running = True
        self.store_reachable = True
        self.network_reachable = True
        self.isolated_at = -100.0
        """When it was last cut off from the store, or slow."""
        self.loadable = True
        self.answered = world.answered
        """Whether the broker answers it; nothing passes there."""
        self.epoch = 0
        """The epoch of its core; 0 on standby."""
        self.handler = None
        self.served = {}
        self.health = Health()
        self.leadership = Leadership(
            SERVICE, self, self, self.health, connected=lambda: self.network_reachable, epochs=dict
        )
        self.leadership.holder = self.leadership._lease.holder = name
        self.edges = Edges(ManualClock(), zenoh=self, gate=self.leadership)
        self.edges.serve({ch.ZONES: lambda _ids, _request, _at: self.zones()})
        self.leadership.subscribe()
        self.tasks = [
            self.loop.create_task(each)
            for each in (self.leadership.run(self, {"zenoh": self.answers}), self.publish_loop())
        ]

    async def answers(self) -> bool:
        return self.network_reachable and self.answered

    async def publish_loop(self) -> None:
        while True:
            self.edges.publish(Publication(ch.MAP_HEARTBEAT, self.heartbeat()))
            await asyncio.sleep(0.1)

    def heartbeat(self) -> MapHeartbeat:
        return MapHeartbeat(epoch=self.epoch, seq=1, hash=1, sent=(0, self.world.now))

    def zones(self) -> ZoneSet:
        return ZoneSet(epoch=self.epoch, seq=1, zones=[], active=[])

    def close(self) -> None:
        for task in self.tasks:
            task.cancel()
        self.loop.turn()
        self.loop.close()

    # --- The service ------------------------------------------------------------------------------------------------

    async def lead(self, epoch: int, *, confirmed: bool) -> None:
        if not self.loadable and confirmed:
            raise StoreError("the records can't be read")
        self.epoch = epoch
        self.edges.publish(Publication(ch.MAP_HEARTBEAT, self.heartbeat()))

    def stand_by(self) -> None:
        # The core keeps its last epoch, as the services' do, and goes on computing.
        self.world.note_standby(self)

    # --- The store of leases ----------------------------------------------------------------------------------------

    async def acquire(self, holder: str, request):
        if not self.store_reachable:
            await asyncio.sleep(0.4)
            return None
        await asyncio.sleep(0.01)
        reply = self.world.records.acquire(holder, request, self.world.now)
        await asyncio.sleep(0.01)
        return reply

    async def release(self, holder: str) -> None:
        if self.world.records.lease is not None and self.world.records.lease[1] == holder:
            self.world.records.lease = None

    # --- The network ------------------------------------------------------------------------------------------------

    def subscribe(self, channel, kind, handler) -> None:
        assert (channel, kind) == (ch.LEADER, Leader)
        self.handler = handler

    def serve(self, channel, reply) -> None:
        self.served[channel] = reply

    def publish(self, channel, message, **ids) -> None:
        self.world.send(self, channel, message, ids)

    def query(self) -> ZoneSet | None:
        return self.served[ch.ZONES]({}, None)


class World:
    def __init__(self) -> None:
        self.now = 1000.0
        self.records = LeaseModel()
        self.answered = True
        """Whether the broker answers processes that start."""
        self.receiver = Fence()
        self.received: list[tuple[float, str, int]] = []
        self.owners: dict[int, str] = {}
        self.sent: list[tuple[float, str, int]] = []
        self.problems: list[str] = []
        self.processes = {}
        for name in NAMES:
            self.processes[name] = Process(name, self)

    def note_standby(self, process: Process) -> None:
        process.epoch = 0 if not process.epoch else process.epoch

    def send(self, process: Process, channel, message, ids) -> None:
        """Check what passed the gate, and deliver it."""
        lease = process.leadership._lease
        if lease.permission(self.now) != "granted" or message.epoch != lease.epoch:
            self.problems.append(f"{self.now:.2f}: {process.name} sent {message} without permission")
        held = self.records.lease
        taken = held is not None and self.now < held[2] and held[1] != process.name
        if taken and self.now - process.isolated_at > TAKEOVER_S:
            self.problems.append(f"{self.now:.2f}: {process.name} sent {message} after it lost the lease to {held}")
        if not process.network_reachable:
            return
        if channel is ch.LEADER:
            for other in self.processes.values():
                if other.network_reachable and other is not process:
                    other.loop.call_soon(other.handler, {"role": SERVICE}, message)
            return
        self.sent.append((self.now, process.name, message.epoch))
        try:
            self.receiver.guarded({channel: lambda *_: []})[channel](ids, message, None)
        except RefusedMessageError:
            return
        if self.owners.setdefault(message.epoch, process.name) != process.name:
            self.problems.append(
                f"epoch {message.epoch} of {self.owners[message.epoch]} is used by {process.name}, too"
            )
        self.received.append((self.now, process.name, message.epoch))

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / STEP_S)):
            self.now += STEP_S
            for process in self.processes.values():
                if process.running:
                    process.loop.turn()
                else:
                    process.isolated_at = self.now
                if not (process.store_reachable and process.network_reachable):
                    process.isolated_at = self.now

    def leaders(self) -> list[str]:
        """Return who was heard in the last half second."""
        return sorted({name for at, name, _ in self.received if at > self.now - 0.5})

    def close(self) -> None:
        for process in self.processes.values():
            process.close()


@pytest.fixture
def world(monkeypatch):
    made = World.__new__(World)
    monkeypatch.setattr(leadership.time, "monotonic", lambda: made.now)
    made.__init__()
    yield made
    made.close()
    assert made.problems == []


def test_one_process_leads_and_the_others_neither_publish_nor_answer(world):
    world.run(3.0)
    assert len(world.leaders()) == 1
    assert {name for _, name, _ in world.sent} == set(world.leaders())
    for name, process in world.processes.items():
        leads = name in world.leaders()
        assert (process.query() is not None) == process.leadership.answers() == leads
        assert (process.leadership.standby_reason() == "") == leads
        assert process.health.report()["parts"]["lease"]["ok"]


def test_process_that_was_stopped_says_nothing_when_it_wakes_up(world):
    world.run(2.0)
    (old,) = world.leaders()
    world.processes[old].running = False
    world.run(TAKEOVER_S)
    (new,) = world.leaders()
    assert new != old
    before = len(world.sent)
    world.processes[old].running = True
    world.run(1.0)
    assert old not in {name for _, name, _ in world.sent[before:]}
    assert world.processes[old].leadership.standby_reason().startswith(f"this process stands by: {new} leads")


def test_what_a_leader_says_while_its_lease_is_uncertain_is_sent_once_it_is_renewed(world):
    world.run(2.0)
    (name,) = world.leaders()
    process = world.processes[name]
    for other in world.processes.values():
        other.running = other is process
    process.running = False
    world.run(1.15)  # longer than it may act, shorter than the lease
    sent = len(world.sent)
    process.edges.publish(Publication(ch.MAP_HEARTBEAT, process.heartbeat()))
    assert len(world.sent) == sent
    assert not process.leadership.answers()
    process.running = True
    world.run(0.3)
    assert len(world.sent) > sent + 1
    assert process.epoch in {epoch for _, _, epoch in world.sent[sent:]}


def test_robot_that_tells_of_ever_higher_epochs_does_not_hold_up_the_fleet(world):
    world.run(3.0)
    began, forged = world.now, 10**13
    for _ in range(300):
        forged += 1000
        state = RobotState(
            mode="NORMAL", reasons=[], enabled=True, battery=None, goal_id=None, map_epoch=0, map_seq=0, plan_id=None,
            epochs={SERVICE: forged},
        )  # fmt: skip
        for process in world.processes.values():
            process.leadership.on_message(ch.ROBOT_STATE, state)
        world.run(0.05)
    beats = [at for at, _, _ in world.received if at > began]
    assert len(beats) >= 145, "ten a second for 15 s"
    assert max(later - at for at, later in itertools.pairwise(beats)) <= 0.5
    assert len({epoch for at, _, epoch in world.received if at > began}) <= 1 + 2 * len(NAMES)


def test_message_with_another_epoch_than_the_one_that_leads_is_never_sent(world):
    world.run(2.0)
    (name,) = world.leaders()
    process = world.processes[name]
    sent = len(world.sent)
    for epoch in (0, process.epoch - 1, process.epoch + 1):
        process.edges.publish(Publication(ch.MAP_HEARTBEAT, MapHeartbeat(epoch=epoch, seq=1, hash=1, sent=(0, 0.0))))
    assert len(world.sent) == sent


def test_leader_whose_records_cannot_be_read_answers_nothing_until_they_can(world):
    for process in world.processes.values():
        process.loadable = False
    world.run(2.0)
    assert not any(process.query() or process.leadership.answers() for process in world.processes.values())
    (taking_over,) = [process for process in world.processes.values() if not process.leadership.standby_reason()]
    assert "taking over" in taking_over.health.report()["parts"]["lease"]["detail"]
    assert not taking_over.health.report()["ready"]
    for process in world.processes.values():
        process.loadable = True
    world.run(0.5)
    assert sum(process.leadership.answers() for process in world.processes.values()) == 1


def test_process_that_ends_gives_the_lease_back(world):
    world.run(2.0)
    (old,) = world.leaders()
    world.processes[old].tasks[0].cancel()
    world.run(0.9)
    (new,) = world.leaders()
    assert new != old


def test_process_that_starts_while_the_broker_answers_nobody_leaves_the_lease_where_it_is(world):
    world.run(2.0)
    (leader,) = world.leaders()
    standby = next(name for name in NAMES if name != leader)
    epoch = world.processes[leader].epoch
    world.answered = False
    for process in world.processes.values():
        process.answered = False
    world.run(3.0)
    world.processes[standby].close()
    world.processes[standby] = Process(standby, world)
    world.run(4.0)
    assert world.leaders() == [leader]
    assert world.processes[leader].epoch == epoch
    assert "no answer of zenoh" in world.processes[standby].health.report()["parts"]["lease"]["detail"]


def test_process_on_whose_connection_nothing_comes_does_not_lead_beside_another_without_redis(world):
    world.run(2.0)
    (leader,) = world.leaders()
    lossy = world.processes[next(name for name in NAMES if name != leader)]
    lossy.answered = lossy.store_reachable = False
    lossy.handler = lambda *_: None
    world.run(6.0)
    assert {name for at, name, _ in world.received if at > world.now - 4.0} == {leader}
    assert len({epoch for _, _, epoch in world.received}) == 1


class Copies(RuleBasedStateMachine):
    """Three processes that are stopped, cut off from the store, from one another, and healed."""

    def __init__(self) -> None:
        super().__init__()
        self.patch = pytest.MonkeyPatch()
        self.world = World.__new__(World)
        self.patch.setattr(leadership.time, "monotonic", lambda: self.world.now)
        self.world.__init__()

    @rule(seconds=st.sampled_from([0.05, 0.3, 0.7, 1.3, 2.5]))
    def run(self, seconds):
        self.world.run(seconds)

    @rule(name=st.sampled_from(NAMES), running=st.booleans())
    def stop_or_continue(self, name, running):
        self.world.processes[name].running = running

    @rule(name=st.sampled_from(NAMES), reachable=st.booleans())
    def cut_or_heal_store(self, name, reachable):
        self.world.processes[name].store_reachable = reachable

    @rule(name=st.sampled_from(NAMES), reachable=st.booleans())
    def cut_or_heal_network(self, name, reachable):
        self.world.processes[name].network_reachable = reachable

    @rule(name=st.sampled_from(NAMES), loadable=st.booleans())
    def break_or_mend_records(self, name, loadable):
        self.world.processes[name].loadable = loadable

    @rule()
    def lose_lease(self):
        self.world.records.lease = None
        for process in self.world.processes.values():
            # Whoever holds it learns that at its next renewal; another one may take it at once.
            process.isolated_at = self.world.now

    @invariant()
    def accepted_messages_have_one_sender_and_growing_epochs(self):
        assert self.world.problems == []
        epochs = [epoch for _, _, epoch in self.world.received]
        assert epochs == sorted(epochs)

    def teardown(self):
        for process in self.world.processes.values():
            process.running = process.store_reachable = process.network_reachable = process.loadable = True
        try:
            self.world.run(2 * TAKEOVER_S)
            assert len(self.world.leaders()) == 1, "one leads again"
            self.accepted_messages_have_one_sender_and_growing_epochs()
        finally:
            self.world.close()
            self.patch.undo()


Copies.TestCase.settings = settings(
    max_examples=int(os.environ.get("FOGNAV_HISTORIES", "15")), stateful_step_count=25, deadline=None
)
test_receivers_accept_one_writer_at_a_time_and_one_leads_again = Copies.TestCase


async def test_need_that_does_not_answer_is_slow_however_quick_it_was_before(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(leadership.time, "monotonic", lambda: now[0])
    monkeypatch.setattr(leadership, "PROBE_S", 0.0)
    answers = iter([True])

    async def ask() -> bool:
        return next(answers, False) or await asyncio.Event().wait()

    probes = leadership.Probes({"zenoh": ask})

    async def probe() -> None:
        async with asyncio.TaskGroup() as tasks:
            probes.start(tasks)

    probing = asyncio.create_task(probe())
    for _ in range(5):
        await asyncio.sleep(0.0)
    assert probes.took() == 0.0
    now[0] = 101.5
    assert probes.took() == 1.5
    probing.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await probing


def test_questions_that_a_hanging_thread_does_not_answer_are_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    class Question(tuple):
        __slots__ = ()

    member, now = Leadership(SERVICE, None, None, Health(), connected=lambda: True), itertools.count(1.0, 0.1)
    monkeypatch.setattr(leadership.time, "monotonic", lambda: next(now))
    for number in range(100):
        member.ask(Question((7, 0.1 * number)))
    assert sum(isinstance(each, Question) for each in gc.get_objects()) < 20


def test_messages_of_another_thread_are_sent_behind_those_that_were_held_back(monkeypatch: pytest.MonkeyPatch) -> None:
    member = Leadership(SERVICE, None, None, Health(), connected=lambda: True)
    monkeypatch.setattr(member._lease, "epoch", 5)
    permissions, sent, sending = iter(["pending", "granted", "granted"]), [], threading.Event()
    monkeypatch.setattr(member._lease, "permission", lambda _now: next(permissions))
    message = MapHeartbeat(epoch=5, seq=1, hash=1, sent=(0, 0.0))

    def send_slowly() -> None:
        sending.set()
        threading.Event().wait(0.05)
        sent.append("held back")

    member.admit(ch.MAP_HEARTBEAT, message, send_slowly)
    assert sent == []
    other = threading.Thread(target=member.admit, args=(ch.MAP_HEARTBEAT, message, lambda: sent.append("second")))
    other.start()
    assert sending.wait(60.0)
    member.admit(ch.MAP_HEARTBEAT, message, lambda: sent.append("third"))
    other.join()
    assert sent == ["held back", "second", "third"]
