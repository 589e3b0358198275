"""The costmap's tiles: put together they are the map, and only those whose cells changed are encoded anew."""

import base64
import io

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from console_service.core import ConsoleCore
from console_service.tiles import TileView
from fog_contracts import channels as ch
from fog_contracts.grid import GridGeometry, Window
from fog_contracts.handlers import Moment
from fog_contracts.replica import MasterMap, decode_map

WIDTH, HEIGHT = 300, 200
AT = Moment(1.0, 1.0)
WRITES = st.lists(
    st.tuples(st.integers(0, WIDTH - 1), st.integers(0, HEIGHT - 1), st.integers(1, 60), st.integers(1, 60),
              st.sampled_from([0, 100, 254])),
    max_size=6,
)  # fmt: skip


def new_map(width: int = WIDTH, height: int = HEIGHT) -> MasterMap:
    cells = np.zeros((height, width), dtype=np.uint8)
    return MasterMap("test", GridGeometry(width, height, 0.05, 0.0, 0.0), cells, cells, epoch=1)


def encode_all(core: ConsoleCore) -> int:
    """Encode what is to be encoded; return how many tiles were told anew."""
    before = core.log.revision
    while jobs := core.tile_jobs(3):
        for job in jobs:
            job.run()
            core.add_tile(job)
    return core.log.revision - before


def shown(core: ConsoleCore, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    """Return the costmap as a page puts it together from the tiles that it has got."""
    cells = np.full((height, width), 77, dtype=np.uint8)
    for thing in core.log.things("costmap"):
        tile = msgspec.json.decode(core.log.data("costmap", thing), type=TileView)
        picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(tile.png))))[::-1]
        cells[tile.row : tile.row + tile.height, tile.column : tile.column + tile.width] = picture
    return cells


@settings(max_examples=40, deadline=None)
@given(writes=WRITES)
def test_tiles_are_the_map_after_any_changes_and_only_changed_ones_are_told(writes):
    master, core = new_map(), ConsoleCore("test", "r")
    core.load(decode_map(master.snapshot()), 0.0)
    assert encode_all(core) == 3 * 2
    on_delta = core.handlers()[ch.MAP_DELTA]
    for x, y, width, height, value in writes:
        window = master.geometry.clip(Window(x, y, width, height))
        before = master.layers["cost"].copy()
        changed = (("cost", window, np.full((window.height, window.width), value, dtype=np.uint8)),)
        for delta in master.write(list(changed), [], []):
            on_delta({}, delta, AT)
        differs = np.argwhere(master.layers["cost"] != before)
        assert encode_all(core) == len({(int(row) // 128, int(column) // 128) for row, column in differs})
        np.testing.assert_array_equal(shown(core), master.layers["cost"])


def test_same_map_again_tells_nothing_and_another_one_begins_anew():
    core = ConsoleCore("test", "r")
    core.load(decode_map(new_map().snapshot()), 0.0)
    encode_all(core)
    position = f"r.{core.log.revision}"
    core.load(decode_map(new_map().snapshot()), 1.0)
    assert encode_all(core) == 0
    assert core.log.resume(position) is not None
    other = new_map(150, 140)
    other.set_epoch(2)
    core.load(decode_map(other.snapshot()), 2.0)
    assert core.log.resume(position) is None
    encode_all(core)
    assert sorted(core.log.things("costmap")) == ["0,0", "0,128", "128,0", "128,128"]
    np.testing.assert_array_equal(shown(core, 150, 140), other.layers["cost"])


@pytest.mark.parametrize("jobs_run_late", [False, True])
def test_tile_that_changes_while_it_is_encoded_is_encoded_again(jobs_run_late):
    master, core = new_map(), ConsoleCore("test", "r")
    core.load(decode_map(master.snapshot()), 0.0)
    (job,) = core.tile_jobs(1)
    if not jobs_run_late:
        job.run()
    (delta,) = master.write([("cost", Window(0, 0, 1, 1), np.full((1, 1), 254, dtype=np.uint8))], [], [])
    core.handlers()[ch.MAP_DELTA]({}, delta, AT)
    job.run()
    core.add_tile(job)
    encode_all(core)
    assert shown(core)[0, 0] == 254
