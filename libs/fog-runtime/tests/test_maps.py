import json
import math
import re
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from PIL import Image

from fog_contracts.grid import GridGeometry, StaticMap
from fog_runtime.configuration.maps import MapFileError, load_map, load_occupancy, save_map

KEYS = {
    "image": "m.png", "resolution": 0.05, "origin": "[1.0, -2.0, 0.0]", "negate": 0,
    "occupied_thresh": 0.65, "free_thresh": 0.196,
}  # fmt: skip


def write(folder, pixels, name="m.png", **keys):
    """Write a map whose top row of pixels is the first."""
    Image.fromarray(np.array(pixels, dtype=np.uint8)).save(folder / name)
    return describe(folder, image=name, **keys)


def describe(folder, **keys):
    path = folder / "m.yaml"
    lines = [f"{key}: {value}" for key, value in {**KEYS, **keys}.items() if value is not None]
    path.write_text("\n".join(lines))
    return path


@pytest.mark.data
@pytest.mark.parametrize("image", ["testmap.png", "testmap.bmp"])
def test_map_servers_test_map_has_its_expected_cells(maps_dir, tmp_path, image):
    expected = json.loads((maps_dir / "map_server" / "expected_cells.json").read_text())["testmap"]
    text = (maps_dir / "map_server" / "testmap.yaml").read_text()
    path = tmp_path / "testmap.yaml"
    path.write_text(text.replace("image: testmap.png", f"image: {maps_dir / 'map_server' / image}"))
    occupancy = load_occupancy(path)
    assert occupancy.geometry == GridGeometry(expected["width"], expected["height"], 0.1, 2.0, 3.0)
    assert occupancy.yaw == 1.0
    assert occupancy.values.ravel().tolist() == expected["data"]
    rotated = load_map(path)
    row, column = np.nonzero(occupancy.values == 100)
    for x, y in zip((column + 0.5) * 0.1, (row + 0.5) * 0.1, strict=True):
        column_row = rotated.geometry.cell(
            2.0 + x * math.cos(1.0) - y * math.sin(1.0), 3.0 + x * math.sin(1.0) + y * math.cos(1.0)
        )
        assert rotated.cells[column_row[1], column_row[0]] == 254


@pytest.mark.data
def test_every_recorded_map_has_free_and_occupied_cells(maps_dir):
    files = [path for path in sorted(maps_dir.glob("*/*.yaml")) if "image:" in path.read_text()]
    assert len(files) >= 11
    for path in files:
        static = load_map(path)
        assert static.cells.shape == static.geometry.shape, path
        counts = [(static.cells == value).mean() for value in (0, 254, 255)]
        assert sum(counts) == pytest.approx(1.0), path
        assert counts[0] > 0.02, path
        assert counts[1] > 0.0005, path


@pytest.mark.data
def test_grey_of_the_depot_map_is_free_by_its_threshold(maps_dir):
    with Image.open(maps_dir / "nav2" / "depot.pgm") as image:
        grey = np.asarray(image)[::-1] == 205
    assert grey.any()
    assert (load_map(maps_dir / "nav2" / "depot.yaml").cells[grey] == 0).all()


def test_row_0_is_the_bottom_of_the_image(tmp_path):
    static = load_map(write(tmp_path, [[0, 255, 255], [205, 205, 0]]))
    assert static.cells.tolist() == [[255, 255, 254], [254, 0, 0]]
    assert static.geometry == GridGeometry(3, 2, 0.05, 1.0, -2.0)


def test_dark_pixels_of_a_negated_map_are_free(tmp_path):
    assert load_map(write(tmp_path, [[0, 255, 128]], negate=1)).cells.tolist() == [[0, 254, 255]]


@pytest.mark.parametrize("name", ["m.png", "m.pgm", "m.bmp"])
def test_png_pgm_and_bmp_give_the_same_cells(tmp_path, name):
    assert load_map(write(tmp_path, [[0, 205, 254]], name)).cells.tolist() == [[254, 255, 0]]


def test_ascii_pgm_with_comment_and_small_maximum_is_read(tmp_path):
    (tmp_path / "m.pgm").write_text("P2\n# drawn by hand\n3 1\n15\n0 15 12\n")
    assert load_map(describe(tmp_path, image="m.pgm")).cells.tolist() == [[254, 0, 255]]


def test_colour_palette_and_16_bit_images_are_read(tmp_path):
    assert load_map(write(tmp_path, [[[0, 0, 0], [255, 255, 255], [255, 0, 0]]])).cells.tolist() == [[254, 0, 254]]
    Image.fromarray(np.array([[0, 255, 205]], dtype=np.uint8)).convert("P").save(tmp_path / "p.png")
    assert load_map(describe(tmp_path, image="p.png")).cells.tolist() == [[254, 0, 255]]
    Image.fromarray(np.array([[0, 65535, 52685]], dtype=np.uint16)).save(tmp_path / "d.png")
    assert load_map(describe(tmp_path, image="d.png")).cells.tolist() == [[254, 0, 255]]


def test_transparent_pixels_are_unknown_and_alpha_says_nothing_of_opaque_ones(tmp_path):
    """Alpha counted as a fourth colour, as in ROS 1: opaque dark grey became unknown, and a robot saw no wall there."""
    pixels = [[[0, 255], [80, 255], [255, 255], [0, 0], [255, 254]]]
    assert load_occupancy(write(tmp_path, pixels)).values.tolist() == [[100, 100, 0, -1, -1]]
    rgba = [[[v, v, v, a] for v, a in pixels[0]]]
    assert load_occupancy(write(tmp_path, rgba)).values.tolist() == [[100, 100, 0, -1, -1]]


def test_colours_count_by_their_brightness(tmp_path):
    """Of 255: red 76, green 150, blue 29; by the mean of the three all were 85."""
    pixels = [[[255, 0, 0], [0, 255, 0], [0, 0, 255], [150, 255, 120]]]
    write(tmp_path, pixels)
    shown = load_occupancy(describe(tmp_path, occupied_thresh=0.65, free_thresh=0.42))
    assert shown.values.tolist() == [[100, 0, 100, 0]]


@pytest.mark.data
def test_dark_grey_of_a_recorded_floor_with_alpha_is_occupied(maps_dir):
    with Image.open(maps_dir / "ipa" / "lab_intel.png") as image:
        pixels = np.asarray(image)[::-1]
    dark = (pixels[:, :, 0] < 89) & (pixels[:, :, 1] == 255)
    assert dark.any()
    assert (load_map(maps_dir / "ipa" / "lab_intel.yaml").cells[dark] == 254).all()


def test_scale_mode_interpolates_between_thresholds_and_transparent_is_unknown(tmp_path):
    path = write(tmp_path, [[0, 255, 128]], mode_=None, mode=None)
    path = describe(tmp_path, mode="scale", occupied_thresh=0.9, free_thresh=0.1)
    assert load_occupancy(path).values.tolist() == [[100, 0, 50]]
    assert load_map(path).cells.tolist() == [[254, 0, 255]]
    Image.fromarray(np.array([[[0, 255], [255, 254]]], dtype=np.uint8)).save(tmp_path / "m.png")
    assert load_occupancy(path).values.tolist() == [[100, -1]]


def test_raw_mode_reads_pixels_as_percent(tmp_path):
    write(tmp_path, [[0, 100, 101, 255, 50, 70, 10]])
    path = describe(tmp_path, mode="raw")
    assert load_occupancy(path).values.tolist() == [[0, 100, -1, -1, 50, 70, 10]]
    assert load_map(path).cells.tolist() == [[0, 254, 255, 255, 255, 254, 0]]


@pytest.mark.parametrize(
    ("keys", "texts"),
    [
        ({"image": "gone.png"}, ["image", "gone.png", "does not exist"]),
        ({"image": None}, ["image: missing"]),
        ({"resolution": 0}, ["resolution", "0 is not a number"]),
        ({"resolution": None}, ["resolution: missing"]),
        ({"resolution": ".nan"}, ["resolution", "nan"]),
        ({"origin": "[0, 0]"}, ["origin", "[x, y, yaw]"]),
        ({"origin": "[0, 0, .inf]"}, ["origin"]),
        ({"negate": 2}, ["negate", "neither 0 nor 1"]),
        ({"occupied_thresh": 1.5}, ["occupied_thresh"]),
        ({"free_thresh": 0.7}, ["free_thresh", "not below"]),
        ({"mode": "quaternary"}, ["mode", "trinary, scale, raw"]),
        ({"origin": "[1, 2"}, ["YAML"]),
    ],
)
def test_invalid_map_file_is_refused_by_file_and_key(tmp_path, keys, texts):
    write(tmp_path, [[0]])
    path = describe(tmp_path, **keys)
    with pytest.raises(MapFileError) as refused:
        load_map(path)
    assert all(text in str(refused.value) for text in [str(path), *texts]), refused.value


def test_missing_file_and_damaged_image_are_refused(tmp_path):
    with pytest.raises(MapFileError, match="can't be read"):
        load_map(tmp_path / "none.yaml")
    (tmp_path / "m.png").write_bytes(b"\x89PNG but not really")
    with pytest.raises(MapFileError, match=re.escape("m.png can't be decoded")):
        load_map(describe(tmp_path))
    write(tmp_path, [[0, 255]] * 50)
    data = (tmp_path / "m.png").read_bytes()
    (tmp_path / "m.png").write_bytes(data[: len(data) // 2])
    with pytest.raises(MapFileError, match="can't be decoded"):
        load_map(describe(tmp_path))


cell_grids = hnp.arrays(
    np.uint8, hnp.array_shapes(min_dims=2, max_dims=2, max_side=12), elements=st.sampled_from([0, 254, 255])
)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=50)
@given(cells=cell_grids, x=st.floats(-1e3, 1e3), y=st.floats(-1e3, 1e3))
def test_loading_a_saved_map_returns_the_same_cells(tmp_path, cells, x, y):
    static = StaticMap(GridGeometry(cells.shape[1], cells.shape[0], 0.05, x, y), cells)
    save_map(tmp_path / "saved", static)
    loaded = load_map(tmp_path / "saved.yaml")
    assert loaded.geometry == static.geometry
    assert np.array_equal(loaded.cells, cells)


def saved_with_yaw(folder, cells, yaw):
    save_map(folder / "t", StaticMap(GridGeometry(cells.shape[1], cells.shape[0], 0.1, 5.0, 7.0), cells))
    path = folder / "t.yaml"
    path.write_text(path.read_text().replace(", 0.0]", f", {yaw!r}]"))
    return path


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=30)
@given(cells=cell_grids, quarter_turns=st.integers(-4, 4))
def test_rotating_by_quarter_turns_moves_cells_and_changes_none(tmp_path, cells, quarter_turns):
    rotated = load_map(saved_with_yaw(tmp_path, cells, quarter_turns * math.pi / 2))
    # numpy rotates towards the first axis, which points up here: in the opposite direction.
    assert np.array_equal(rotated.cells, np.rot90(cells, -quarter_turns))
    left = {0: 0.0, 1: -0.1 * cells.shape[0], 2: -0.1 * cells.shape[1], 3: 0.0}[quarter_turns % 4]
    assert rotated.geometry.origin_x == pytest.approx(5.0 + left)


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=50)
@given(cells=cell_grids, yaw=st.floats(-7, 7))
def test_rotating_loses_no_occupied_cell_and_adds_no_free_area(tmp_path, cells, yaw):
    rotated = load_map(saved_with_yaw(tmp_path, cells, yaw))
    cos, sin = math.cos(yaw), math.sin(yaw)
    for row, column in zip(*np.nonzero(cells == 254), strict=True):
        x, y = 0.1 * (column + 0.5), 0.1 * (row + 0.5)
        c, r = rotated.geometry.cell(5.0 + x * cos - y * sin, 7.0 + x * sin + y * cos)
        near = rotated.cells[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2]
        assert (near == 254).any()
    for row, column in zip(*np.nonzero(rotated.cells == 0), strict=True):
        x, y = rotated.geometry.centre(column, row)
        x, y = x - 5.0, y - 7.0
        c, r = round((x * cos + y * sin) / 0.1 - 0.5), round((-x * sin + y * cos) / 0.1 - 0.5)
        near = cells[max(r - 1, 0) : r + 2, max(c - 1, 0) : c + 2]
        assert (near == 0).any()


LARGE = """
image: map.pgm
resolution: 0.05
origin: [0.0, 0.0, 0.0]
negate: 0
occupied_thresh: 0.65
free_thresh: 0.196
"""
LOAD = """
import resource, sys
from pathlib import Path
from fog_runtime.configuration.maps import load_map, Image
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
static = load_map(Path(sys.argv[1]))
used = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
print(used / static.cells.size, *(int((static.cells == value).sum()) for value in (0, 254, 255)))
"""


def test_loading_a_large_map_takes_at_most_four_bytes_per_cell(tmp_path):
    side = 4_000
    rows = np.full((side, side), 254, dtype=np.uint8)
    rows[: side // 4] = 0
    rows[-side // 4 :] = 205
    (tmp_path / "map.pgm").write_bytes(b"P5 %d %d 255\n" % (side, side) + rows.tobytes())
    (tmp_path / "map.yaml").write_text(LARGE)
    command = [sys.executable, "-c", LOAD, str(tmp_path / "map.yaml")]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    assert float(printed[0]) <= 4.0
    assert [int(count) for count in printed[1:]] == [side * side // 2, side * side // 4, side * side // 4]


def test_map_over_the_limit_of_cells_is_refused_before_it_is_decoded(tmp_path):
    (tmp_path / "map.pgm").write_bytes(b"P5 10000 10001 255\n")
    (tmp_path / "map.yaml").write_text(LARGE)
    with pytest.raises(MapFileError, match="10000 x 10001 pixels, more than 100000000"):
        load_map(tmp_path / "map.yaml")
