import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from fog_contracts import channels as ch
from fog_contracts.codec import decode, encode
from fog_contracts.grid import GridGeometry, Window
from fog_contracts.messages import Cause, MapDelta, MapSnapshot, Trace
from fog_contracts.replica import Applied, MapError, MasterMap, Replica, TileHashes

WIDTH, HEIGHT = 150, 90


def master(epoch=1, width=WIDTH, height=HEIGHT, seed=0):
    geometry = GridGeometry(width, height, 0.05, -1.0, 2.0)
    static = np.random.default_rng(seed).choice(np.array([0, 254, 255], dtype=np.uint8), geometry.shape)
    return MasterMap("lab", geometry, static, static, epoch)


def loaded_replica(writer):
    replica = Replica()
    replica.load(writer.snapshot())
    return replica


def change(seed, layer="cost", bounds=(WIDTH, HEIGHT), value=None):
    """Return a random window with random cells."""
    rng = np.random.default_rng(seed)
    w, h = int(rng.integers(1, bounds[0] // 2)), int(rng.integers(1, bounds[1] // 2))
    window = Window(int(rng.integers(0, bounds[0] - w + 1)), int(rng.integers(0, bounds[1] - h + 1)), w, h)
    cells = rng.integers(0, 256, (h, w), dtype=np.uint8) if value is None else np.full((h, w), value, dtype=np.uint8)
    return layer, window, cells


def state(writer):
    return {layer: grid.copy() for layer, grid in writer.layers.items()}


def has_cells(replica, layers):
    return all(np.array_equal(replica.layers[name], grid) for name, grid in layers.items())


def damaged(delta, position):
    raw = bytearray(delta.cells)
    raw[position % len(raw)] ^= 0x55
    return replace(delta, cells=bytes(raw))


network_steps = st.lists(
    st.one_of(
        st.tuples(st.just("write"), st.integers(0, 2**32), st.sampled_from(["cost", "speed", "both"])),
        st.tuples(st.just("restart"), st.integers(0, 2**32)),
        st.tuples(st.just("deliver"), st.integers(0, 50)),  # any of those in transit: any order
        st.tuples(st.just("lose"), st.integers(0, 50)),
        st.tuples(st.just("duplicate"), st.integers(0, 50)),
        st.tuples(st.just("damage"), st.integers(0, 50), st.integers(0, 10_000)),
        st.tuples(st.just("query")),
        st.tuples(st.just("reply"), st.integers(0, 50)),
    ),
    max_size=60,
)


@settings(max_examples=150, deadline=None)
@given(steps=network_steps)
def test_replica_is_always_exactly_one_of_the_writers_versions(steps):
    writer = master()
    replica = loaded_replica(writer)
    history = {writer.version: state(writer)}
    deltas, snapshots = [], []
    for step in steps:
        match step:
            case ("write", seed, layer):
                layers = ["cost", "speed"] if layer == "both" else [layer]
                deltas += writer.write([change(seed + n, name) for n, name in enumerate(layers)], [], [])
                history[writer.version] = state(writer)
            case ("restart", seed):
                writer = master(epoch=writer.version.epoch + 1, seed=seed)
                history[writer.version] = state(writer)
            case ("deliver", n) if deltas:
                replica.apply(deltas.pop(n % len(deltas)))
            case ("lose", n) if deltas:
                deltas.pop(n % len(deltas))
            case ("duplicate", n) if deltas:
                replica.apply(deltas[n % len(deltas)])
            case ("damage", n, position) if deltas:
                replica.apply(damaged(deltas.pop(n % len(deltas)), position))
            case ("query",):
                snapshots.append(writer.snapshot())
            case ("reply", n) if snapshots:
                replica.load(snapshots.pop(n % len(snapshots)))
        assert has_cells(replica, history[replica.version])
    replica.load(writer.snapshot())
    assert not replica.needs_snapshot
    assert has_cells(replica, state(writer))


@given(seeds=st.lists(st.integers(0, 2**32), min_size=1, max_size=8))
@settings(deadline=None)
def test_encoded_deltas_in_order_keep_the_replica_current(seeds):
    writer = master()
    replica = loaded_replica(decode_snapshot(writer))
    for seed in seeds:
        for delta in writer.write([change(seed)], [], []):
            replica.apply(decode(ch.MAP_DELTA, encode(ch.MAP_DELTA, delta), MapDelta))
        assert replica.version == writer.version
        assert has_cells(replica, state(writer))


def decode_snapshot(writer):
    data = encode(ch.MAP_SNAPSHOT, writer.snapshot(), reply=True)
    snapshot = decode(ch.MAP_SNAPSHOT, data, MapSnapshot, reply=True)

    class DecodedSnapshot:
        def snapshot(self):
            return snapshot

    return DecodedSnapshot()


def test_large_change_is_split_into_parts_that_arrive_in_any_order():
    writer = master(width=1200, height=700)
    replica = loaded_replica(writer)
    cause, trace = Cause(kind="zone", id="z", state="set"), Trace(area="a", epoch=1, seq=1)
    cells = np.random.default_rng(1).integers(0, 256, (700, 1200), dtype=np.uint8)
    deltas = writer.write([("cost", Window(0, 0, 1200, 700), cells)], [cause] * 30, [trace] * 10)
    assert len(deltas) > 12
    assert all(len(encode(ch.MAP_DELTA, delta)) <= ch.DELTA_LIMIT for delta in deltas)
    *others, last = [replica.apply(delta) for delta in reversed(deltas)]
    assert others == ["waiting"] * (len(deltas) - 1)
    assert isinstance(last, Applied)
    assert last.causes[0] == cause
    assert has_cells(replica, state(writer))


def test_delta_holds_only_the_changed_cells_and_none_is_made_without_any():
    writer = master()
    before = writer.version
    assert writer.write([("speed", Window(0, 0, 50, 50), np.zeros((50, 50), dtype=np.uint8))], [], []) == []
    assert writer.version == before
    cells = np.zeros((50, 50), dtype=np.uint8)
    cells[20, 30] = 9
    (delta,) = writer.write([("speed", Window(10, 5, 50, 50), cells)], [], [])
    assert (delta.x, delta.y, delta.w, delta.h) == (40, 25, 1, 1)


def test_delta_with_wrong_hash_is_rejected_and_leaves_the_old_cells():
    writer = master()
    replica = loaded_replica(writer)
    old, version = state(writer), replica.version
    (delta,) = writer.write([change(7)], [], [])
    assert replica.apply(replace(delta, hash=delta.hash ^ 1)) == "gap"
    assert replica.needs_snapshot
    assert has_cells(replica, old)
    assert replica.version == version
    assert replica.apply(delta) == "gap", "only a snapshot is accepted now"


@pytest.mark.parametrize(
    "wrong",
    [
        {"x": WIDTH},
        {"w": WIDTH + 1},
        {"part": 1},
        {"cells": b"\x00"},
        {"packing": "zlib", "cells": b"no zlib"},
        {"epoch": 2},
    ],
)
def test_invalid_delta_is_rejected_and_leaves_the_old_cells(wrong):
    writer = master()
    replica, old = loaded_replica(writer), state(writer)
    (delta,) = writer.write([change(3, value=77)], [], [])
    assert replica.apply(replace(delta, **wrong)) == "gap"
    assert replica.needs_snapshot
    assert has_cells(replica, old)


def test_gap_and_duplicate_are_distinguished():
    writer = master()
    replica = loaded_replica(writer)
    (first,) = writer.write([change(1)], [], [])
    (second,) = writer.write([change(2)], [], [])
    assert isinstance(replica.apply(first), Applied)
    assert replica.apply(first) == "old"
    (third,) = writer.write([change(3)], [], [])
    assert replica.apply(third) == "gap"
    assert replica.needs_snapshot
    replica.load(writer.snapshot())
    assert replica.apply(second) == "old"
    replica.invalidate()
    assert replica.needs_snapshot
    assert has_cells(replica, state(writer))


def test_damaged_snapshot_is_refused_and_changes_nothing():
    writer = master()
    older = writer.snapshot()
    writer.write([change(1)], [], [])
    newer = writer.snapshot()
    replica = Replica()
    for wrong in (
        replace(newer, hash=newer.hash ^ 1),
        replace(newer, cost=b"x"),
        replace(newer, static=older.cost[:9]),
    ):
        with pytest.raises(MapError):
            replica.load(wrong)
        assert replica.version is None
    replica.load(newer)
    assert has_cells(replica, state(writer))
    assert np.array_equal(replica.static, writer.static)


def test_snapshot_is_encoded_once_per_version():
    writer = master()
    assert writer.snapshot() is writer.snapshot()
    earlier = writer.snapshot()
    writer.write([change(1)], [], [])
    assert writer.snapshot() is not earlier


@given(seed=st.integers(0, 2**32), cell=st.tuples(st.integers(0, HEIGHT - 1), st.integers(0, WIDTH - 1)))
@settings(deadline=None, max_examples=50)
def test_incremental_hash_equals_the_full_one_and_changes_with_every_cell(seed, cell):
    writer = master()
    layer, window, cells = change(seed)
    layers = state(writer)
    hashes = TileHashes(layers)
    layers[layer][window.rows, window.columns] = cells
    hashes.update(layer, layers[layer], window)
    assert hashes.value == TileHashes(layers).value
    layers["speed"][cell] ^= 1
    assert TileHashes(layers).value != hashes.value


def test_equal_changes_of_two_tiles_or_layers_do_not_cancel_out():
    blank = {"cost": np.zeros((128, 128), dtype=np.uint8), "speed": np.zeros((128, 128), dtype=np.uint8)}
    values = {TileHashes(blank).value}
    for layer in blank:
        for row in (0, 64):
            for column in (0, 64):
                changed = {name: grid.copy() for name, grid in blank.items()}
                changed[layer][row, column] = 9
                values.add(TileHashes(changed).value)
    assert len(values) == 9
