"""Following the map over a network that loses, doubles, delays, reorders and damages, from a writer that restarts.

`FOGNAV_HISTORIES` sets how many random histories are tried.
"""

import itertools
import math
import os

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from fog_contracts.follower import GRACE_S, MapFollower
from fog_contracts.grid import GridGeometry, Window
from fog_contracts.messages import Cause, Trace
from fog_contracts.replica import MapError, MasterMap, TileHashes

HISTORIES = int(os.environ.get("FOGNAV_HISTORIES", "200"))
WIDTH, HEIGHT = 70, 12  # two tiles
BEAT_S = 0.1


def master(epoch=10, seed=0):
    geometry = GridGeometry(WIDTH, HEIGHT, 0.05, -1.0, 2.0)
    static = np.random.default_rng(seed).choice(np.array([0, 254, 255], dtype=np.uint8), geometry.shape)
    return MasterMap("lab", geometry, static, static, epoch)


def write(writer, seed, layers=("cost",), name="z"):
    """Write random cells; return the deltas, one part per layer."""
    rng = np.random.default_rng(seed)
    changes = []
    for layer in layers:
        w, h = int(rng.integers(1, WIDTH // 2)), int(rng.integers(1, HEIGHT))
        window = Window(int(rng.integers(0, WIDTH - w + 1)), int(rng.integers(0, HEIGHT - h + 1)), w, h)
        changes.append((layer, window, rng.integers(0, 256, (h, w), dtype=np.uint8)))
    cause, trace = Cause(kind="zone", id=name, state="set"), Trace(area=name, epoch=1, seq=writer.version.seq)
    return writer.write(changes, [cause], [trace])


def cells(writer):
    return {layer: grid.copy() for layer, grid in writer.layers.items()}


def copied(follower):
    return {"cost": follower.replica.cost, "speed": follower.replica.speed}


class Network:
    """A writer, a follower, and everything that is under way between them."""

    def __init__(self):
        self.now = 50.0
        self.writer = master(epoch=1000)
        self.follower = MapFollower()
        self.history = {self.writer.version: cells(self.writer)}
        self.deltas, self.beats, self.snapshots = [], [], []
        self.asked = 0

    def write(self, seed, layers):
        self.deltas += write(self.writer, seed, layers)
        self.history[self.writer.version] = cells(self.writer)

    def restart(self, epochs, seed):
        """Start another writer; a lower epoch comes with an empty network, for nothing tells late from new then."""
        used = [version.epoch for version in self.history]
        if epochs > 0:
            epoch = max(used) + epochs
        else:
            epoch = min(used) + epochs
            self.deltas, self.beats, self.snapshots = [], [], []
        self.writer = master(epoch, seed)
        self.history[self.writer.version] = cells(self.writer)

    def beat(self):
        self.beats.append((self.now, self.writer.heartbeat(self.now)))

    def hear(self, n):
        """Deliver any of the heartbeats under way; none is under way for as long as the grace."""
        self.beats = [(sent, beat) for sent, beat in self.beats if self.now - sent < GRACE_S]
        if self.beats:
            _, beat = self.beats.pop(n % len(self.beats))
            self.follower.on_heartbeat(beat, self.now)

    def answer(self, n):
        snapshot = self.snapshots.pop(n % len(self.snapshots))
        before = self.follower.version
        try:
            self.follower.on_snapshot(snapshot, self.now)
        except MapError:
            assert self.follower.version == before

    def play(self, step):
        match step:
            case ("write", seed, layers):
                self.write(seed, layers)
            case ("restart", epochs, seed):
                self.restart(epochs, seed)
            case ("beat",):
                self.beat()
            case ("hear", n):
                self.hear(n)
            case ("deliver" | "double" | "lose" | "damage" as fate, n, *position) if self.deltas:
                self.let_arrive(fate, n % len(self.deltas), *position)
            case ("ask",) if self.follower.wants_snapshot(self.now):
                self.snapshots.append(self.writer.snapshot())
            case ("answer", n) if self.snapshots:
                self.answer(n)
            case ("fetch",) if self.follower.wants_snapshot(self.now):
                self.snapshots.append(self.writer.snapshot())
                self.answer(len(self.snapshots) - 1)
            case ("wait", seconds):
                self.wait(seconds)

    def let_arrive(self, fate, index, position=0):
        """Decide what becomes of a delta that is under way."""
        delta = self.deltas[index] if fate == "double" else self.deltas.pop(index)
        if fate == "damage":
            raw = bytearray(delta.cells)
            raw[position % len(raw)] ^= 0x55
            delta = replace(delta, cells=bytes(raw))
        if fate != "lose":
            self.follower.on_delta(delta, self.now)

    def wait(self, seconds):
        """Let time pass, in which age and gap only grow and no wish for a snapshot vanishes."""
        before = self.reading()
        self.now += seconds
        after = self.reading()
        assert all(early <= late for early, late in zip(before, after, strict=True))

    def reading(self):
        follower, now = self.follower, self.now
        return follower.age(now), follower.gap(now), follower.wants_snapshot(now)

    def check(self):
        follower, now = self.follower, self.now
        if follower.version is None:
            assert not follower.up_to_date
            return
        assert follower.version in self.history
        assert all(
            np.array_equal(copied(follower)[layer], grid) for layer, grid in self.history[follower.version].items()
        )
        if follower.up_to_date:
            assert TileHashes(copied(follower)).value == follower.version.hash
            assert follower.gap(now) == 0.0
        if follower.version == self.writer.version:
            assert not follower.wants_snapshot(now), "nothing is missing"

    def recover(self):
        """Let everything arrive from now on; the messages under way still come, late and in any order."""
        for _ in range(20):
            self.wait(BEAT_S)
            self.follower.on_heartbeat(self.writer.heartbeat(self.now), self.now)
            self.check()
            if self.follower.up_to_date and self.follower.age(self.now) == 0.0:
                assert self.follower.version == self.writer.version
            if self.follower.wants_snapshot(self.now):
                self.snapshots.append(self.writer.snapshot())
                self.answer(len(self.snapshots) - 1)
                self.check()
        assert self.follower.up_to_date
        assert self.follower.version == self.writer.version
        assert self.follower.age(self.now) == 0.0


POSITIONS = st.integers(0, 50)
STEPS = st.lists(
    st.one_of(
        st.tuples(
            st.just("write"),
            st.integers(0, 2**32),
            st.sampled_from([("cost",), ("speed",), ("cost", "speed"), ("cost", "cost", "cost")]),
        ),
        st.tuples(st.just("restart"), st.sampled_from([1, 1, 3, -1]), st.integers(0, 2**32)),
        st.tuples(st.just("beat")),
        st.tuples(st.just("hear"), POSITIONS),
        st.tuples(st.just("deliver"), POSITIONS),
        st.tuples(st.just("deliver"), st.just(0)),
        st.tuples(st.just("double"), POSITIONS),
        st.tuples(st.just("lose"), POSITIONS),
        st.tuples(st.just("damage"), POSITIONS, st.integers(0, 10_000)),
        st.tuples(st.just("ask")),
        st.tuples(st.just("fetch")),
        st.tuples(st.just("answer"), POSITIONS),
        st.tuples(st.just("wait"), st.floats(0.0, 0.8)),
    ),
    min_size=10,
    max_size=60,
)


@settings(max_examples=HISTORIES, deadline=None)
@given(loaded=st.booleans(), steps=STEPS)
def test_copy_is_one_version_of_the_writers_and_recovers_whatever_the_network_did(loaded, steps):
    network = Network()
    if loaded:
        network.play(("fetch",))
    for step in steps:
        network.play(step)
        network.check()
    network.recover()


@settings(max_examples=max(20, HISTORIES // 10), deadline=None)
@given(writes=st.lists(st.tuples(st.integers(0, 2**32), st.booleans(), st.booleans()), max_size=20))
def test_copy_that_gets_every_delta_never_asks_again(writes):
    network = Network()
    follower = network.follower
    follower.on_snapshot(network.writer.snapshot(), network.now)
    for seed, overtaken, beating in writes:
        network.write(seed, ("cost", "speed"))
        network.wait(BEAT_S)
        if overtaken:
            follower.on_heartbeat(network.writer.heartbeat(network.now), network.now)
        deltas, network.deltas = network.deltas, []
        for delta in deltas:
            assert not follower.wants_snapshot(network.now)
            follower.on_delta(delta, network.now)
        if beating:
            follower.on_heartbeat(network.writer.heartbeat(network.now), network.now)
        assert follower.up_to_date
        assert follower.version == network.writer.version
        if beating or deltas:
            assert follower.age(network.now) == 0.0


def loaded(writer, now=0.0, **options):
    follower = MapFollower(**options)
    follower.on_snapshot(writer.snapshot(), now)
    return follower


def test_new_follower_wants_a_snapshot_and_knows_no_age():
    follower = MapFollower()
    assert follower.wants_snapshot(0.0)
    assert not follower.up_to_date
    assert follower.age(1e9) == math.inf
    assert follower.gap(1e9) == 0.0
    assert (follower.version, follower.replica.geometry, follower.replica.site) == (None, None, "")


def test_snapshot_alone_does_not_confirm_the_map_and_a_heartbeat_does():
    writer = master()
    follower = loaded(writer)
    assert follower.up_to_date
    assert follower.age(5.0) == math.inf
    follower.on_heartbeat(writer.heartbeat(0.0), 5.0)
    assert follower.age(5.5) == 0.5
    assert (follower.replica.site, follower.replica.geometry) == ("lab", writer.geometry)
    assert np.array_equal(follower.replica.static, writer.static)


def test_delta_does_not_confirm_the_map_when_a_heartbeat_named_a_newer_version():
    writer = master()
    follower = loaded(writer)
    follower.on_heartbeat(writer.heartbeat(0.0), 1.0)
    (first,), (second,) = write(writer, 1), write(writer, 2)
    follower.on_heartbeat(writer.heartbeat(0.0), 2.0)
    assert follower.on_delta(first, 2.1)
    assert not follower.up_to_date
    assert follower.age(2.1) == pytest.approx(1.1)
    assert follower.gap(2.1) == pytest.approx(0.1)
    assert follower.on_delta(second, 2.2)
    assert (follower.up_to_date, follower.age(2.2), follower.gap(2.2)) == (True, 0.0, 0.0)


def test_announced_delta_may_be_under_way_for_the_grace():
    writer = master()
    follower = loaded(writer, grace_s=0.5)
    write(writer, 1)
    for now in (1.0, 1.2, 1.4):
        follower.on_heartbeat(writer.heartbeat(0.0), now)
        assert not follower.wants_snapshot(now)
    assert follower.wants_snapshot(1.6)
    assert follower.gap(1.6) == pytest.approx(0.6)


def test_skipped_delta_wants_a_snapshot_at_once_and_none_if_it_comes_after_all():
    writer = master()
    follower = loaded(writer)
    (first,), (second,), (third,) = (write(writer, seed, name=f"z{seed}") for seed in (1, 2, 3))
    assert follower.on_delta(third, 1.0) is None
    assert follower.wants_snapshot(1.0)
    assert follower.on_delta(second, 1.1) is None
    applied = follower.on_delta(first, 1.2)
    assert applied
    assert applied.version == follower.version == writer.version
    assert [cause.id for cause in applied.causes] == [trace.area for trace in applied.traces] == ["z1", "z2", "z3"]
    assert len(applied.windows) == 3
    assert not follower.wants_snapshot(1.2)


def test_deltas_that_come_before_an_older_snapshot_are_applied_after_it():
    writer = master()
    follower = MapFollower()
    old = writer.snapshot()
    for seed in (1, 2):
        for delta in write(writer, seed, ("cost", "speed")):
            assert follower.on_delta(delta, 1.0) is None
    applied = follower.on_snapshot(old, 2.0)
    assert applied.version == writer.version
    assert len(applied.traces) == 2, "one per version, not per part"
    assert follower.up_to_date


def test_snapshot_that_lacks_a_lost_delta_is_taken_and_another_wanted():
    writer = master()
    follower = MapFollower()
    write(writer, 1)
    old = writer.snapshot()
    write(writer, 2)
    (third,) = write(writer, 3)
    follower.on_delta(third, 1.0)
    assert follower.on_snapshot(old, 1.1).version.seq == 1
    assert follower.wants_snapshot(1.1)
    follower.on_snapshot(writer.snapshot(), 1.2)
    assert follower.up_to_date


def test_held_deltas_are_bounded_and_the_latest_are_kept():
    writer = master()
    follower = MapFollower(max_held=3)
    snapshots = {}
    for seed in range(6):
        for delta in write(writer, seed):
            follower.on_delta(delta, 1.0)
        snapshots[writer.version.seq] = writer.snapshot()
    follower.on_snapshot(snapshots[2], 1.0)
    assert follower.version.seq == 2, "delta 3 had to make room"
    follower.on_snapshot(snapshots[3], 1.0)
    assert follower.version.seq == 6


def test_older_and_damaged_snapshots_are_refused_and_change_nothing():
    writer = master()
    older = writer.snapshot()
    write(writer, 1)
    follower = loaded(writer)
    follower.on_heartbeat(writer.heartbeat(0.0), 1.0)
    with pytest.raises(MapError, match="older"):
        follower.on_snapshot(older, 1.0)
    with pytest.raises(MapError, match="damaged"):
        follower.on_snapshot(replace(writer.snapshot(), hash=1), 1.0)
    assert follower.up_to_date
    with pytest.raises(MapError, match="epoch 9, but the map-service is at epoch 10"):
        follower.on_snapshot(master(epoch=9).snapshot(), 1.0)


def test_broken_copy_does_not_go_back_to_an_older_snapshot():
    writer = master()
    older = writer.snapshot()
    write(writer, 1)
    follower = loaded(writer)
    (delta,) = write(writer, 2)
    follower.on_delta(replace(delta, hash=delta.hash ^ 1), 1.0)
    assert follower.wants_snapshot(1.0)
    with pytest.raises(MapError, match="older"):
        follower.on_snapshot(older, 1.0)


def test_writer_with_a_higher_epoch_is_followed_at_once():
    follower = loaded(master(epoch=10))
    restarted = master(epoch=11, seed=5)
    follower.on_heartbeat(restarted.heartbeat(0.0), 1.0)
    assert follower.wants_snapshot(1.0)
    follower.on_snapshot(restarted.snapshot(), 1.1)
    follower.on_heartbeat(restarted.heartbeat(0.0), 1.2)
    assert follower.age(1.2) == 0.0


def test_late_heartbeat_of_a_writer_that_was_replaced_asks_for_nothing():
    old, new = master(epoch=10), master(epoch=11)
    follower = loaded(new)
    for now in (1.0, 1.1, 1.2):
        follower.on_heartbeat(old.heartbeat(0.0), now)
        assert not follower.wants_snapshot(now)
    follower.on_heartbeat(new.heartbeat(0.0), 1.3)
    assert not follower.wants_snapshot(9.9)


def test_late_heartbeat_long_ago_does_not_turn_the_next_late_one_into_a_restart():
    writer = master()
    follower = loaded(writer)
    for now in (1.0, 2.0):
        late = writer.heartbeat(0.0)
        write(writer, int(now))
        follower.on_snapshot(writer.snapshot(), now)
        follower.on_heartbeat(late, now)
        assert not follower.wants_snapshot(now)


@pytest.mark.parametrize("epoch", [3, 10])
def test_writer_that_starts_again_with_lower_numbers_is_followed_after_the_grace(epoch):
    writer = master(epoch=10)
    for seed in range(5):
        write(writer, seed)
    follower = loaded(writer)
    follower.on_heartbeat(writer.heartbeat(0.0), 0.0)
    restarted = master(epoch=epoch, seed=5)
    write(restarted, 7)
    for now in itertools.takewhile(lambda now: now < 1.0 + GRACE_S, itertools.count(1.0, 0.1)):
        follower.on_heartbeat(restarted.heartbeat(0.0), now)
        assert follower.age(now) == pytest.approx(now), "the copy is not the newest any more"
    follower.on_heartbeat(restarted.heartbeat(0.0), 2.0)
    assert follower.wants_snapshot(2.0)
    before = restarted.snapshot()
    (change,) = write(restarted, 8)
    follower.on_delta(change, 2.1)
    follower.on_snapshot(before, 2.2)
    assert follower.version == restarted.version
    follower.on_heartbeat(restarted.heartbeat(0.0), 2.3)
    assert (follower.age(2.3), follower.gap(2.3)) == (0.0, 0.0)


def test_deltas_that_keep_overtaking_heartbeats_are_no_sign_of_a_restart():
    writer = master()
    follower = loaded(writer)
    for step in range(20):
        late = writer.heartbeat(0.0)
        for delta in write(writer, step):
            follower.on_delta(delta, step * BEAT_S)
        follower.on_heartbeat(late, step * BEAT_S)
        assert follower.up_to_date
        assert follower.age(step * BEAT_S) == 0.0


def test_another_hash_for_the_same_version_wants_a_snapshot():
    writer = master()
    follower = loaded(writer)
    follower.on_heartbeat(replace(writer.heartbeat(0.0), hash=1), 1.0)
    assert follower.wants_snapshot(1.0)
    assert not follower.up_to_date
