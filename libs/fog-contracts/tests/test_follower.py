"""Following the map over a network that loses, duplicates, delays, reorders and damages, from writers that take over.

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
from fog_contracts.replica import MapError, MasterMap, TileHashes, Version, plan_hash

HISTORIES = int(os.environ.get("FOGNAV_HISTORIES", "200"))
WIDTH, HEIGHT = 70, 12  # two tiles
HEARTBEAT_S = 0.1


def master(epoch=10, seed=0, origin_x=-1.0):
    geometry = GridGeometry(WIDTH, HEIGHT, 0.05, origin_x, 2.0)
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
    return {layer: grid.copy() for layer, grid in [*writer.layers.items(), ("static", writer.static)]}


def replica_cells(follower):
    return {"cost": follower.replica.cost, "speed": follower.replica.speed}


def take_over(writer, epochs, seq):
    """Let another writer with the same map go on: it has counted the same changes from another number on."""
    writer._version = Version(writer.version.epoch, seq, writer.version.hash)
    writer.set_epoch(writer.version.epoch + epochs)


class Network:
    """A writer, a follower, and the messages in transit between them."""

    def __init__(self):
        self.now = 50.0
        self.writer = master(epoch=1000)
        self.follower = MapFollower()
        self.history = {}
        self.remember()
        self.deltas, self.heartbeats, self.snapshots = [], [], []

    def write(self, seed, layers):
        self.deltas += write(self.writer, seed, layers)
        self.remember()

    def remember(self):
        self.history[self.writer.version] = self.writer.geometry, cells(self.writer)

    def restart(self, epochs, seed, origin_x=-1.0):
        """Start another writer, which replaces the former one: its epoch is higher."""
        self.writer = master(max(version.epoch for version in self.history) + epochs, seed, origin_x)
        self.remember()

    def take_over(self, epochs, seq):
        """Let a writer with the same map replace the former one."""
        take_over(self.writer, epochs, seq)
        self.remember()

    def send_heartbeat(self):
        self.heartbeats.append((self.now, self.writer.heartbeat(self.now)))

    def deliver_heartbeat(self, n):
        """Deliver any of the heartbeats in transit; none is in transit for as long as the grace."""
        self.heartbeats = [(sent, heartbeat) for sent, heartbeat in self.heartbeats if self.now - sent < GRACE_S]
        if self.heartbeats:
            _, heartbeat = self.heartbeats.pop(n % len(self.heartbeats))
            self.follower.on_heartbeat(heartbeat, self.now)

    def deliver_snapshot(self, n):
        snapshot = self.snapshots.pop(n % len(self.snapshots))
        before = self.follower.version
        try:
            self.follower.on_snapshot(snapshot, self.now)
        except MapError:
            assert self.follower.version == before

    def run_step(self, step):
        match step:
            case ("write", seed, layers):
                self.write(seed, layers)
            case ("restart" | "take over" as kind, *change):
                (self.restart if kind == "restart" else self.take_over)(*change)
            case ("send heartbeat",):
                self.send_heartbeat()
            case ("deliver heartbeat", n):
                self.deliver_heartbeat(n)
            case ("deliver" | "duplicate" | "lose" | "damage" as fate, n, *position) if self.deltas:
                self.transmit_delta(fate, n % len(self.deltas), *position)
            case ("query snapshot",) if self.follower.wants_snapshot(self.now):
                self.snapshots.append(self.writer.snapshot())
            case ("deliver snapshot", n) if self.snapshots:
                self.deliver_snapshot(n)
            case ("fetch snapshot",) if self.follower.wants_snapshot(self.now):
                self.snapshots.append(self.writer.snapshot())
                self.deliver_snapshot(len(self.snapshots) - 1)
            case ("wait", seconds):
                self.wait(seconds)

    def transmit_delta(self, fate, index, position=0):
        """Deliver, duplicate, lose or damage a delta in transit."""
        delta = self.deltas[index] if fate == "duplicate" else self.deltas.pop(index)
        if fate == "damage":
            raw = bytearray(delta.cells)
            raw[position % len(raw)] ^= 0x55
            delta = replace(delta, cells=bytes(raw))
        if fate != "lose":
            self.follower.on_delta(delta, self.now)

    def wait(self, seconds):
        """Advance the time; age and gap may only grow, and the need for a snapshot may not vanish."""
        before = self.status()
        self.now += seconds
        after = self.status()
        assert all(early <= late for early, late in zip(before, after, strict=True))

    def status(self):
        follower, now = self.follower, self.now
        return follower.age(now), follower.gap(now), follower.wants_snapshot(now)

    def check(self):
        follower, now = self.follower, self.now
        if follower.version is None:
            assert not follower.up_to_date
            return
        assert follower.version in self.history
        geometry, layers = self.history[follower.version]
        found = {**replica_cells(follower), "static": follower.replica.static}
        assert follower.replica.geometry == geometry
        assert all(np.array_equal(found[layer], grid) for layer, grid in layers.items())
        if follower.up_to_date:
            plan = plan_hash(geometry, follower.replica.static)
            assert TileHashes(replica_cells(follower), plan).value == follower.version.hash
            assert follower.gap(now) == 0.0
        if follower.version == self.writer.version:
            assert not follower.wants_snapshot(now), "nothing is missing"

    def recover(self):
        """Deliver every new message from now on; messages in transit still arrive, late and in any order."""
        for _ in range(20):
            self.wait(HEARTBEAT_S)
            self.follower.on_heartbeat(self.writer.heartbeat(self.now), self.now)
            self.check()
            if self.follower.up_to_date and self.follower.age(self.now) == 0.0:
                assert self.follower.version == self.writer.version
            if self.follower.wants_snapshot(self.now):
                self.snapshots.append(self.writer.snapshot())
                self.deliver_snapshot(len(self.snapshots) - 1)
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
        st.tuples(st.just("restart"), st.sampled_from([1, 1, 3]), st.integers(0, 2**32)),
        st.tuples(st.just("restart"), st.just(1), st.sampled_from([0, 7]), st.just(-2.0)),
        st.tuples(st.just("take over"), st.sampled_from([1, 2]), st.sampled_from([0, 1, 2, 5])),
        st.tuples(st.just("send heartbeat")),
        st.tuples(st.just("deliver heartbeat"), POSITIONS),
        st.tuples(st.just("deliver"), POSITIONS),
        st.tuples(st.just("deliver"), st.just(0)),
        st.tuples(st.just("duplicate"), POSITIONS),
        st.tuples(st.just("lose"), POSITIONS),
        st.tuples(st.just("damage"), POSITIONS, st.integers(0, 10_000)),
        st.tuples(st.just("query snapshot")),
        st.tuples(st.just("fetch snapshot")),
        st.tuples(st.just("deliver snapshot"), POSITIONS),
        st.tuples(st.just("wait"), st.floats(0.0, 0.8)),
    ),
    min_size=10,
    max_size=60,
)


@settings(max_examples=HISTORIES, deadline=None)
@given(loaded=st.booleans(), steps=STEPS)
def test_replica_is_always_one_of_the_writers_versions_and_recovers(loaded, steps):
    network = Network()
    if loaded:
        network.run_step(("fetch snapshot",))
    for step in steps:
        network.run_step(step)
        network.check()
    network.recover()


@settings(max_examples=max(20, HISTORIES // 10), deadline=None)
@given(writes=st.lists(st.tuples(st.integers(0, 2**32), st.booleans(), st.booleans()), max_size=20))
def test_follower_that_receives_every_delta_never_wants_another_snapshot(writes):
    network = Network()
    follower = network.follower
    follower.on_snapshot(network.writer.snapshot(), network.now)
    for seed, overtaken, with_heartbeat in writes:
        network.write(seed, ("cost", "speed"))
        network.wait(HEARTBEAT_S)
        if overtaken:
            follower.on_heartbeat(network.writer.heartbeat(network.now), network.now)
        deltas, network.deltas = network.deltas, []
        for delta in deltas:
            assert not follower.wants_snapshot(network.now)
            follower.on_delta(delta, network.now)
        if with_heartbeat:
            follower.on_heartbeat(network.writer.heartbeat(network.now), network.now)
        assert follower.up_to_date
        assert follower.version == network.writer.version
        if with_heartbeat or deltas:
            assert follower.age(network.now) == 0.0


@settings(max_examples=max(20, HISTORIES // 10), deadline=None)
@given(steps=st.lists(st.one_of(st.integers(0, 2**32), st.tuples(st.integers(1, 3), st.integers(0, 9))), max_size=20))
def test_follower_goes_on_without_a_snapshot_at_takeovers_that_lose_no_change(steps):
    network = Network()
    follower = network.follower
    follower.on_snapshot(network.writer.snapshot(), network.now)
    for step in steps:
        network.wait(HEARTBEAT_S)
        if isinstance(step, tuple):
            network.take_over(*step)
        else:
            network.write(step, ("cost", "speed"))
            deltas, network.deltas = network.deltas, []
            for delta in deltas:
                follower.on_delta(delta, network.now)
        follower.on_heartbeat(network.writer.heartbeat(network.now), network.now)
        network.check()
        assert (follower.up_to_date, follower.version) == (True, network.writer.version)
        assert not follower.wants_snapshot(network.now)
        assert follower.age(network.now) == 0.0


def loaded_follower(writer, now=0.0, **options):
    follower = MapFollower(**options)
    follower.on_snapshot(writer.snapshot(), now)
    return follower


def test_new_follower_wants_a_snapshot_and_has_infinite_age():
    follower = MapFollower()
    assert follower.wants_snapshot(0.0)
    assert not follower.up_to_date
    assert follower.age(1e9) == math.inf
    assert follower.gap(1e9) == 0.0
    assert (follower.version, follower.replica.geometry, follower.replica.site) == (None, None, "")


def test_heartbeat_confirms_a_snapshot():
    writer = master()
    follower = loaded_follower(writer)
    assert follower.up_to_date
    assert follower.age(5.0) == math.inf
    follower.on_heartbeat(writer.heartbeat(5.0), 5.0)
    assert follower.age(5.5) == 0.5
    assert (follower.replica.site, follower.replica.geometry) == ("lab", writer.geometry)
    assert np.array_equal(follower.replica.static, writer.static)


def test_delta_does_not_confirm_the_map_while_a_newer_version_is_announced():
    writer = master()
    follower = loaded_follower(writer)
    follower.on_heartbeat(writer.heartbeat(1.0), 1.0)
    (first,), (second,) = write(writer, 1), write(writer, 2)
    follower.on_heartbeat(writer.heartbeat(2.0), 2.0)
    assert follower.on_delta(first, 2.1)
    assert not follower.up_to_date
    assert follower.age(2.1) == pytest.approx(1.1)
    assert follower.gap(2.1) == pytest.approx(0.1)
    assert follower.on_delta(second, 2.2)
    assert (follower.up_to_date, follower.age(2.2), follower.gap(2.2)) == (True, 0.0, 0.0)


def test_snapshot_is_wanted_when_an_announced_delta_is_missing_after_the_grace():
    writer = master()
    follower = loaded_follower(writer, grace_s=0.5)
    write(writer, 1)
    for now in (1.0, 1.2, 1.4):
        follower.on_heartbeat(writer.heartbeat(now), now)
        assert not follower.wants_snapshot(now)
    assert follower.wants_snapshot(1.6)
    assert follower.gap(1.6) == pytest.approx(0.6)


def test_skipped_delta_wants_a_snapshot_until_it_arrives():
    writer = master()
    follower = loaded_follower(writer)
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


def test_deltas_received_before_an_older_snapshot_are_applied_after_it():
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


def test_snapshot_without_a_lost_delta_is_loaded_and_another_wanted():
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


def test_number_of_held_deltas_is_limited_to_the_latest():
    writer = master()
    follower = MapFollower(max_held=3)
    snapshots = {}
    for seed in range(6):
        for delta in write(writer, seed):
            follower.on_delta(delta, 1.0)
        snapshots[writer.version.seq] = writer.snapshot()
    follower.on_snapshot(snapshots[2], 1.0)
    assert follower.version.seq == 2, "delta 3 was dropped"
    follower.on_snapshot(snapshots[3], 1.0)
    assert follower.version.seq == 6


def test_older_or_damaged_snapshot_is_refused_and_changes_nothing():
    writer = master()
    older = writer.snapshot()
    write(writer, 1)
    follower = loaded_follower(writer)
    follower.on_heartbeat(writer.heartbeat(1.0), 1.0)
    with pytest.raises(MapError, match="older"):
        follower.on_snapshot(older, 1.0)
    with pytest.raises(MapError, match="damaged"):
        follower.on_snapshot(replace(writer.snapshot(), hash=1), 1.0)
    assert follower.up_to_date
    with pytest.raises(MapError, match="epoch 9, but the map-service is at epoch 10"):
        follower.on_snapshot(master(epoch=9).snapshot(), 1.0)


def test_older_snapshot_is_refused_after_a_rejected_delta():
    writer = master()
    older = writer.snapshot()
    write(writer, 1)
    follower = loaded_follower(writer)
    (delta,) = write(writer, 2)
    follower.on_delta(replace(delta, hash=delta.hash ^ 1), 1.0)
    assert follower.wants_snapshot(1.0)
    with pytest.raises(MapError, match="older"):
        follower.on_snapshot(older, 1.0)


def test_writer_with_a_higher_epoch_is_followed_at_once():
    follower = loaded_follower(master(epoch=10))
    restarted = master(epoch=11, seed=5)
    follower.on_heartbeat(restarted.heartbeat(1.0), 1.0)
    assert follower.wants_snapshot(1.0)
    follower.on_snapshot(restarted.snapshot(), 1.1)
    follower.on_heartbeat(restarted.heartbeat(1.2), 1.2)
    assert follower.age(1.2) == 0.0


def test_writer_that_takes_over_with_another_floor_plan_or_place_has_another_map():
    writer = master(epoch=10)
    for other in (master(epoch=11, origin_x=-1.05), master(epoch=11, seed=3)):
        same_cells = MasterMap("lab", other.geometry, other.static, writer.layers["cost"], 11)
        follower = loaded_follower(writer)
        follower.on_heartbeat(same_cells.heartbeat(1.0), 1.0)
        assert follower.wants_snapshot(1.0)


def test_copy_is_renamed_only_to_a_version_with_its_hash():
    follower = loaded_follower(master(epoch=10))
    with pytest.raises(ValueError, match="under another name"):
        follower.replica.rename(Version(11, 0, 1))


def test_late_heartbeat_of_a_replaced_writer_is_ignored():
    old, new = master(epoch=10), master(epoch=11)
    follower = loaded_follower(new)
    for now in (1.0, 1.1, 1.2):
        follower.on_heartbeat(old.heartbeat(now), now)
        assert not follower.wants_snapshot(now)
    follower.on_heartbeat(new.heartbeat(1.3), 1.3)
    assert not follower.wants_snapshot(9.9)


def test_writer_that_was_replaced_is_not_followed_however_long_it_goes_on():
    writer = master(epoch=10)
    follower = loaded_follower(writer)
    follower.on_heartbeat(writer.heartbeat(0.0), 0.0)
    replaced = master(epoch=3, seed=5)
    for now in itertools.takewhile(lambda now: now < 5.0, itertools.count(0.1, 0.1)):
        for delta in write(replaced, 7):
            follower.on_delta(delta, now)
        follower.on_heartbeat(replaced.heartbeat(now), now)
        with pytest.raises(MapError):
            follower.on_snapshot(replaced.snapshot(), now)
        assert not follower.wants_snapshot(now)
        assert follower.age(now) == pytest.approx(now), "nothing confirms the copy"
    assert follower.version == writer.version


def test_heartbeats_overtaken_by_deltas_do_not_mean_a_restart():
    writer = master()
    follower = loaded_follower(writer)
    for step in range(20):
        late = writer.heartbeat(step * HEARTBEAT_S)
        for delta in write(writer, step):
            follower.on_delta(delta, step * HEARTBEAT_S)
        follower.on_heartbeat(late, step * HEARTBEAT_S)
        assert follower.up_to_date
        assert follower.age(step * HEARTBEAT_S) == 0.0


def test_different_hash_for_the_same_version_wants_a_snapshot():
    writer = master()
    follower = loaded_follower(writer)
    follower.on_heartbeat(replace(writer.heartbeat(0.0), hash=1), 1.0)
    assert follower.wants_snapshot(1.0)
    assert not follower.up_to_date


def test_late_heartbeats_and_the_deltas_beside_them_confirm_the_copy_as_of_when_they_were_sent():
    writer = master()
    follower = loaded_follower(writer)
    follower.on_heartbeat(writer.heartbeat(1000.0), 1.0)
    assert (follower.age(1.0), follower.delay_s) == (0.0, 0.0)
    for i in range(100):  # at the usual rate, sent 10 s before they arrive
        follower.on_heartbeat(writer.heartbeat(1001.0 + 0.1 * i), 12.0 + 0.1 * i)
    assert follower.delay_s == pytest.approx(10.0, abs=0.02)
    assert follower.age(21.9) == pytest.approx(10.0, abs=0.02)
    (delta,) = write(writer, 2)
    follower.on_delta(delta, 22.0)
    assert follower.version == writer.version
    assert follower.age(22.0) == pytest.approx(10.0, abs=0.02)
    follower.on_heartbeat(writer.heartbeat(1022.0), 23.0)
    assert follower.age(23.0) == pytest.approx(0.0, abs=0.02)
