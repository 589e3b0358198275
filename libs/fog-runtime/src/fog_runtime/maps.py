"""Map files of ROS's map_server (a YAML beside an image), read into grids and written.

The meaning of pixels is that of Nav2's `nav2_map_server/map_io` (and map_server before it): shade is the mean of the
colour channels, in trinary mode with alpha counted as one more; `occ` is 1 - shade, or shade when negated.
"""

import io
import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np
import yaml  # type: ignore[import-untyped]  # PyYAML ships no types
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from fog_contracts.costs import FREE, LETHAL, UNKNOWN
from fog_contracts.grid import GridGeometry
from fog_runtime.files import atomic_write

Mode = Literal["trinary", "scale", "raw"]

OCCUPIED_PERCENT: Final = 100
UNKNOWN_PERCENT: Final = -1
MAX_PIXELS: Final = 50_000_000
"""Larger images are refused: 350 m x 350 m at 5 cm, and no decompression bomb."""

_EXAMPLES: Final = {"resolution": 0.05, "occupied_thresh": 0.65, "free_thresh": 0.196}
_WRITTEN_OCCUPIED: Final = 0.65
_WRITTEN_FREE: Final = 0.196
_SHADES: Final = {FREE: 254, LETHAL: 0, UNKNOWN: 205}


class MapFileError(ValueError):
    """A map file that can't be used; the message names the file, the key and the remedy.

    The key `file` stands for the file as a whole.
    """

    def __init__(self, file: Path, key: str, problem: str, remedy: str) -> None:
        where = f"{file}" if key == "file" else f"{file}: {key}:"
        super().__init__(f"{where} {problem}. {remedy}")
        self.file = file
        self.key = key


@dataclass(frozen=True)
class Occupancy:
    """What map_server would publish: int8 (height, width), 0..100 percent or -1 unknown, row 0 at the bottom.

    `yaw` (rad) turns the grid about its lower-left corner (`geometry.origin_x`, `origin_y`).
    """

    geometry: GridGeometry
    yaw: float
    values: NDArray[np.int8]
    mode: Mode
    occupied_thresh: float
    free_thresh: float


@dataclass(frozen=True)
class StaticMap:
    """The plain map of a site, aligned with `map`: uint8 (height, width), 0 free, 254 occupied, 255 unknown."""

    geometry: GridGeometry
    cells: NDArray[np.uint8]


@dataclass(frozen=True)
class _Description:
    image: Path
    resolution: float
    origin: tuple[float, float, float]
    negate: bool
    occupied_thresh: float
    free_thresh: float
    mode: Mode


def _as_number(value: object) -> float:
    """Return a number as YAML means it, NaN when it is none; `1e-05`, as C++ writes it, is a text in YAML 1.1."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return math.nan
    try:
        return float(value)
    except ValueError:
        return math.nan


def _number(file: Path, data: dict[str, Any], key: str, low: float, high: float) -> float:
    value = _as_number(data.get(key))
    if not low <= value <= high:
        shown = "missing" if key not in data else f"{data[key]!r} is no number from {low:g} to {high:g}"
        raise MapFileError(file, key, shown, f"Write e.g. `{key}: {_EXAMPLES[key]}`")
    return value


def _no_yaml(error: yaml.YAMLError | UnicodeDecodeError) -> tuple[str, str]:
    """Return what is wrong with a file that can't be read as YAML, in one line, and what to do."""
    if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark is not None:
        where = f"line {error.problem_mark.line + 1}, column {error.problem_mark.column + 1}"
        return f"is no valid YAML ({where}: {error.problem})", "Correct that place"
    return "is no text", "A map is a YAML file that names an image: name that file, not the image"


def _describe(file: Path) -> _Description:
    try:
        data = yaml.safe_load(file.read_text("utf-8"))
    except OSError as error:
        remedy = "A map is a YAML file that names an image; check the path"
        raise MapFileError(file, "file", f"can't be read ({error.strerror})", remedy) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise MapFileError(file, "file", *_no_yaml(error)) from error
    if not isinstance(data, dict):
        raise MapFileError(file, "file", "is no table of keys", "Write `image: ...`, `resolution: ...` and so on")
    name = data.get("image")
    if not isinstance(name, str) or not name:
        raise MapFileError(file, "image", "missing", "Name the image file, relative to this file")
    image = file.parent / name
    if not image.is_file():
        problem = f"{image} {'is no file' if image.exists() else 'does not exist'}"
        raise MapFileError(file, "image", problem, "Put the image there or name another")
    given = data.get("origin")
    origin = [_as_number(value) for value in given] if isinstance(given, list) else []
    if len(origin) != 3 or not all(math.isfinite(value) for value in origin):
        raise MapFileError(file, "origin", f"{given!r} is no [x, y, yaw]", "Write e.g. `origin: [0.0, 0.0, 0.0]`")
    negate = data.get("negate")
    if negate not in (0, 1):
        raise MapFileError(file, "negate", f"{negate!r} is neither 0 nor 1", "Write `negate: 0` when dark is occupied")
    mode = str(data.get("mode", "trinary")).lower()
    if mode not in get_args(Mode):
        raise MapFileError(file, "mode", f"{mode!r} is unknown", f"Use one of {', '.join(get_args(Mode))}")
    occupied, free = (_number(file, data, key, 0.0, 1.0) for key in ("occupied_thresh", "free_thresh"))
    if free >= occupied:
        raise MapFileError(file, "free_thresh", f"{free} is not below occupied_thresh {occupied}", "Lower it")
    return _Description(
        image=image,
        resolution=_number(file, data, "resolution", 1e-3, 10.0),
        origin=(origin[0], origin[1], origin[2]),
        negate=bool(negate),
        occupied_thresh=occupied,
        free_thresh=free,
        mode=mode,  # type: ignore[arg-type]  # checked against the literals above
    )


def _channels(file: Path, image: Path) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Return colours (h, w, n) and alpha (h, w) or None, 0..1, row 0 at the top as in the file."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            opened = Image.open(image)
        with opened:
            if opened.width * opened.height > MAX_PIXELS:
                size = f"{image} has {opened.width} x {opened.height} pixels, more than {MAX_PIXELS}"
                raise MapFileError(file, "image", size, "Use a coarser resolution")
            if opened.mode in {"I", "I;16", "I;16B", "I;16L"}:
                return (np.asarray(opened, dtype=np.float64) / 65_535.0)[:, :, None], None
            mode = _plain_mode(opened)
            if mode is None:
                raise MapFileError(file, "image", f"{image} has pixels of kind {opened.mode}", "Save it as PNG in grey")
            pixels = np.asarray(opened.convert(mode), dtype=np.float64) / 255.0
    except (
        UnidentifiedImageError, OSError, SyntaxError, ValueError, Image.DecompressionBombWarning,
        Image.DecompressionBombError,
    ) as error:  # fmt: skip
        if isinstance(error, MapFileError):
            raise
        raise MapFileError(
            file, "image", f"{image} can't be decoded ({error})", "Save it anew, as PGM or PNG"
        ) from error
    return _without_alpha(pixels, mode)


def _plain_mode(image: Image.Image) -> str | None:
    """Return the mode of Pillow (L, LA, RGB or RGBA) that holds all that an image says; None for none of them."""
    transparent = "transparency" in image.info
    if image.mode in {"1", "L"}:
        return "LA" if transparent else "L"
    if image.mode == "P":
        return "RGBA" if transparent else "RGB"
    return image.mode if image.mode in {"LA", "RGB", "RGBA"} else None


def _without_alpha(pixels: NDArray[np.float64], mode: str) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Split the pixels of an image in one of the plain modes into colours (h, w, n) and alpha (h, w) or None."""
    if mode == "LA":
        # Alpha weighs as one of four channels, as if grey had been spread to red, green and blue.
        return np.repeat(pixels[:, :, :1], 3, axis=2), pixels[:, :, 1]
    if mode == "RGBA":
        return pixels[:, :, :3], pixels[:, :, 3]
    return pixels[:, :, None] if pixels.ndim == 2 else pixels, None


def load_occupancy(yaml_path: Path) -> Occupancy:
    """Read a map file as map_server would, yaw unresolved; raises `MapFileError`."""
    about = _describe(yaml_path)
    colours, alpha = _channels(yaml_path, about.image)
    if about.mode == "trinary" and alpha is not None:
        colours = np.concatenate([colours, alpha[:, :, None]], axis=2)
    shade = colours.mean(axis=2)
    occ = shade if about.negate else 1.0 - shade
    if about.mode == "raw":
        percent = np.rint(shade * 255.0)
        values = np.where(percent <= OCCUPIED_PERCENT, percent, UNKNOWN_PERCENT)
    else:
        if about.mode == "scale":
            between = np.rint((occ - about.free_thresh) / (about.occupied_thresh - about.free_thresh) * 100.0)
        else:
            between = np.full(occ.shape, float(UNKNOWN_PERCENT))
        values = np.where(
            occ > about.occupied_thresh, OCCUPIED_PERCENT, np.where(occ < about.free_thresh, 0.0, between)
        )
        if about.mode == "scale" and alpha is not None:
            values = np.where(alpha < 1.0, UNKNOWN_PERCENT, values)
    height, width = values.shape
    geometry = GridGeometry(width, height, about.resolution, about.origin[0], about.origin[1])
    bottom_up = np.ascontiguousarray(values[::-1].astype(np.int8))
    return Occupancy(geometry, about.origin[2], bottom_up, about.mode, about.occupied_thresh, about.free_thresh)


def load_map(yaml_path: Path) -> StaticMap:
    """Read a map file into a grid aligned with the frame `map`; raises `MapFileError`.

    Grades between free and occupied (modes scale and raw) are judged by the file's thresholds; what lies between
    them is unknown, and so impassable: a grade is no promise. A yaw is resolved by turning the grid: no occupied cell
    is lost, walls may grow by half a cell, and cells off the old grid are unknown. Yaw 0 keeps every cell.
    """
    occupancy = load_occupancy(yaml_path)
    values = occupancy.values
    cells = np.full(values.shape, UNKNOWN, dtype=np.uint8)
    # In the modes trinary and scale the thresholds are in the values already: only the ends are certain.
    raw = occupancy.mode == "raw"
    cells[(values >= 0) & (values < max(1.0, 100.0 * occupancy.free_thresh if raw else 1.0))] = FREE
    cells[values > (100.0 * occupancy.occupied_thresh if raw else 99.0)] = LETHAL
    if occupancy.yaw == 0.0:
        return StaticMap(occupancy.geometry, cells)
    return _turned(StaticMap(occupancy.geometry, cells), occupancy.yaw)


def _turned(flat: StaticMap, yaw: float) -> StaticMap:
    """Turn a grid counter-clockwise about its origin onto the axes of the frame, by nearest neighbour both ways."""
    old = flat.geometry
    cos, sin = math.cos(yaw), math.sin(yaw)
    wide, high = old.width * old.resolution, old.height * old.resolution
    corners = [(x * cos - y * sin, x * sin + y * cos) for x, y in ((0.0, 0.0), (wide, 0.0), (0.0, high), (wide, high))]
    left, bottom = min(x for x, _ in corners), min(y for _, y in corners)
    right, top = max(x for x, _ in corners), max(y for _, y in corners)
    # The small slack keeps quarter turns exact: rounding must not add an empty row.
    width = max(1, math.ceil((right - left) / old.resolution - 1e-6))
    height = max(1, math.ceil((top - bottom) / old.resolution - 1e-6))
    new = GridGeometry(width, height, old.resolution, old.origin_x + left, old.origin_y + bottom)

    x, y = np.meshgrid(
        left + (np.arange(width) + 0.5) * old.resolution, bottom + (np.arange(height) + 0.5) * old.resolution
    )
    column = np.floor((x * cos + y * sin) / old.resolution).astype(np.int64)
    row = np.floor((-x * sin + y * cos) / old.resolution).astype(np.int64)
    inside = (column >= 0) & (column < old.width) & (row >= 0) & (row < old.height)
    cells = np.full((height, width), UNKNOWN, dtype=np.uint8)
    cells[inside] = flat.cells[row[inside], column[inside]]

    # A single occupied cell may lie between all the new centres: draw each where its centre falls, too.
    rows, columns = np.nonzero(flat.cells == LETHAL)
    px, py = (columns + 0.5) * old.resolution, (rows + 0.5) * old.resolution
    new_column = np.floor((px * cos - py * sin - left) / old.resolution).astype(np.int64)
    new_row = np.floor((px * sin + py * cos - bottom) / old.resolution).astype(np.int64)
    cells[np.clip(new_row, 0, height - 1), np.clip(new_column, 0, width - 1)] = LETHAL
    return StaticMap(new, cells)


def save_map(path_prefix: Path, static: StaticMap) -> None:
    """Write PREFIX.pgm and PREFIX.yaml so that `load_map` gives the same cells; each file is replaced as a whole."""
    shades = np.full(256, _SHADES[UNKNOWN], dtype=np.uint8)
    for cost, shade in _SHADES.items():
        shades[cost] = shade
    image = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(shades[static.cells][::-1])).save(image, format="PPM")
    picture = path_prefix.with_name(f"{path_prefix.name}.pgm")
    atomic_write(picture, image.getvalue())
    g = static.geometry
    text = (
        f"image: {picture.name}\nmode: trinary\nresolution: {g.resolution!r}\n"
        f"origin: [{g.origin_x!r}, {g.origin_y!r}, 0.0]\nnegate: 0\n"
        f"occupied_thresh: {_WRITTEN_OCCUPIED}\nfree_thresh: {_WRITTEN_FREE}\n"
    )
    atomic_write(path_prefix.with_name(f"{path_prefix.name}.yaml"), text.encode())
