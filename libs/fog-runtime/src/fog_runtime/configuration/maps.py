"""Reading and writing map files of ROS's map_server (a YAML file beside an image).

Pixels are interpreted as by Nav2's `nav2_map_server/map_io` since 1.5: the shade is a pixel's brightness, what is
not opaque is unknown (before, and in ROS 1, alpha was one more colour); the occupancy is 1 - shade, or the shade when
negated.

An image may have up to MAX_CELLS pixels. Reading a greyscale image of 8 bits takes at most 4 bytes of memory per cell,
a coloured one 7: it is decoded as a whole, but converted band by band.
"""

import io
import math
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, get_args

import numpy as np
import yaml  # type: ignore[import-untyped]  # PyYAML ships no types
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from fog_contracts.costs import FREE, LETHAL, UNKNOWN
from fog_contracts.grid import GridGeometry, StaticMap
from fog_contracts.messages import MAX_CELLS
from fog_contracts.resampling import resampled
from fog_runtime.files import SHARED, atomic_write

Mode = Literal["trinary", "scale", "raw"]
ImageFormat = Literal["pgm", "png"]

PROVENANCE_KEY: Final = "fognav"
"""The key of a map's file that says where it came from."""
_KEYS: Final = {
    "image", "resolution", "origin", "negate", "mode", "occupied_thresh", "free_thresh", PROVENANCE_KEY,
}  # fmt: skip

OCCUPIED_PERCENT: Final = 100
UNKNOWN_PERCENT: Final = -1
_BAND_CELLS: Final = 128 * 1024
"""About how many cells are converted at a time."""

_EXAMPLES: Final = {"resolution": 0.05, "occupied_thresh": 0.65, "free_thresh": 0.196}
_WRITTEN_OCCUPIED: Final = 0.65
_WRITTEN_FREE: Final = 0.196
_SHADES: Final = {FREE: 254, LETHAL: 0, UNKNOWN: 205}


class MapFileError(ValueError):
    """A map file is missing or invalid; the message names the file, the key and the remedy.

    The key `file` means the file as a whole.
    """

    def __init__(self, file: Path, key: str, problem: str, remedy: str) -> None:
        where = f"{file}" if key == "file" else f"{file}: {key}:"
        super().__init__(f"{where} {problem}. {remedy}")
        self.file = file
        self.key = key


@dataclass(frozen=True)
class Occupancy:
    """The grid that map_server publishes: int8 (height, width), 0..100 percent or -1 unknown, row 0 at the bottom.

    `yaw` (rad) rotates the grid about its lower-left corner (`geometry.origin_x`, `origin_y`).
    """

    geometry: GridGeometry
    yaw: float
    values: NDArray[np.int8]
    mode: Mode
    occupied_thresh: float
    free_thresh: float


@dataclass(frozen=True)
class _Metadata:
    image: Path
    resolution: float
    origin: tuple[float, float, float]
    negate: bool
    occupied_thresh: float
    free_thresh: float
    mode: Mode


def _as_number(value: object) -> float:
    """Return a YAML value as a number, else NaN; YAML 1.1 reads `1e-05`, as C++ writes it, as text."""
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return math.nan
    try:
        return float(value)
    except ValueError:
        return math.nan


def _number(file: Path, data: dict[str, Any], key: str, low: float, high: float) -> float:
    value = _as_number(data.get(key))
    if not low <= value <= high:
        shown = "missing" if key not in data else f"{data[key]!r} is not a number from {low:g} to {high:g}"
        raise MapFileError(file, key, shown, f"Write e.g. `{key}: {_EXAMPLES[key]}`")
    return value


def _yaml_problem(error: yaml.YAMLError | UnicodeDecodeError) -> tuple[str, str]:
    """Return why a file can't be read as YAML, in one line, and the remedy."""
    if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark is not None:
        where = f"line {error.problem_mark.line + 1}, column {error.problem_mark.column + 1}"
        return f"is not valid YAML ({where}: {error.problem})", "Correct that line"
    return "is not a text file", "A map is a YAML file that names an image: name that file, not the image"


def read_keys(file: Path) -> dict[str, Any]:
    """Return the keys and values of a map's file, whatever they are; raises `MapFileError`."""
    try:
        data = yaml.safe_load(file.read_text("utf-8"))
    except OSError as error:
        remedy = "A map is a YAML file that names an image; check the path"
        raise MapFileError(file, "file", f"can't be read ({error.strerror})", remedy) from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise MapFileError(file, "file", *_yaml_problem(error)) from error
    if not isinstance(data, dict):
        raise MapFileError(
            file, "file", "is not a mapping of keys to values", "Write `image: ...`, `resolution: ...` and so on"
        )
    return data


def _read_metadata(file: Path) -> _Metadata:
    data = read_keys(file)
    name = data.get("image")
    if not isinstance(name, str) or not name:
        raise MapFileError(file, "image", "missing", "Name the image file, relative to this file")
    image = file.parent / name
    if not image.is_file():
        problem = f"{image} {'is not a file' if image.exists() else 'does not exist'}"
        raise MapFileError(file, "image", problem, "Put the image there or name another")
    origin_value = data.get("origin")
    origin = [_as_number(value) for value in origin_value] if isinstance(origin_value, list) else []
    if len(origin) != 3 or not all(math.isfinite(value) for value in origin):
        raise MapFileError(
            file, "origin", f"{origin_value!r} is not [x, y, yaw]", "Write e.g. `origin: [0.0, 0.0, 0.0]`"
        )
    negate = data.get("negate")
    if negate not in (0, 1):
        raise MapFileError(file, "negate", f"{negate!r} is neither 0 nor 1", "Write `negate: 0` when dark is occupied")
    mode = str(data.get("mode", "trinary")).lower()
    if mode not in get_args(Mode):
        raise MapFileError(file, "mode", f"{mode!r} is unknown", f"Use one of {', '.join(get_args(Mode))}")
    occupied, free = (_number(file, data, key, 0.0, 1.0) for key in ("occupied_thresh", "free_thresh"))
    if free >= occupied:
        raise MapFileError(file, "free_thresh", f"{free} is not below occupied_thresh {occupied}", "Lower it")
    return _Metadata(
        image=image,
        resolution=_number(file, data, "resolution", 1e-3, 10.0),
        origin=(origin[0], origin[1], origin[2]),
        negate=bool(negate),
        occupied_thresh=occupied,
        free_thresh=free,
        mode=mode,  # type: ignore[arg-type]  # checked against the literals above
    )


_BRIGHTNESS: Final = np.array([306.0, 601.0, 117.0]) / 1024.0
"""What red, green and blue add to a pixel's brightness, in GraphicsMagick, by which Nav2 reads images."""


@contextmanager
def _opened(file: Path, image: Path) -> Iterator[Image.Image]:
    """Open an image of at most MAX_CELLS pixels; whatever goes wrong with it becomes a `MapFileError`."""
    try:
        with warnings.catch_warnings():
            # The limit below is the one that counts.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            picture = Image.open(image)
        with picture:
            if picture.width * picture.height > MAX_CELLS:
                size = f"{image} has {picture.width} x {picture.height} pixels, more than {MAX_CELLS}"
                raise MapFileError(file, "image", size, "Use a coarser resolution")
            yield picture
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        if isinstance(error, MapFileError):
            raise
        raise MapFileError(
            file, "image", f"{image} can't be decoded ({error})", "Save it again as PGM or PNG"
        ) from error


def _channels(file: Path, image: Path, band: Image.Image) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Return colours (h, w, n) and alpha (h, w) or None, 0..1, of a part of an image."""
    if band.mode in {"I", "I;16", "I;16B", "I;16L"}:
        return (np.asarray(band, dtype=np.float64) / 65_535.0)[:, :, None], None
    mode = _plain_mode(band)
    if mode is None:
        raise MapFileError(file, "image", f"{image} has pixels of mode {band.mode}", "Save it as a greyscale PNG")
    return _split_alpha(np.asarray(band.convert(mode), dtype=np.float64) / 255.0, mode)


def _plain_mode(image: Image.Image) -> str | None:
    """Return the mode of Pillow (L, LA, RGB or RGBA) to which an image converts without loss; None for none."""
    transparent = "transparency" in image.info
    if image.mode in {"1", "L"}:
        return "LA" if transparent else "L"
    if image.mode == "P":
        return "RGBA" if transparent else "RGB"
    return image.mode if image.mode in {"LA", "RGB", "RGBA"} else None


def _split_alpha(pixels: NDArray[np.float64], mode: str) -> tuple[NDArray[np.float64], NDArray[np.float64] | None]:
    """Split the pixels of an image in one of the plain modes into colours (h, w, n) and alpha (h, w) or None."""
    if mode in {"LA", "RGBA"}:
        return pixels[:, :, :-1], pixels[:, :, -1]
    return pixels[:, :, None] if pixels.ndim == 2 else pixels, None


def load_occupancy(yaml_path: Path) -> Occupancy:
    """Read a map file as Nav2's map_server does, without applying the yaw; raises `MapFileError`."""
    metadata = _read_metadata(yaml_path)
    with _opened(yaml_path, metadata.image) as picture:
        width, height = picture.size
        values = np.empty((height, width), dtype=np.int8)
        # Whole images of floating-point numbers would take 50 bytes per cell.
        for rows in _bands(height, width):
            band = picture.crop((0, rows.start, width, rows.stop))
            # Row 0 of the image is the top, of the grid the bottom.
            below, above = height - rows.stop, height - rows.start
            values[below:above] = _occupancy(*_channels(yaml_path, metadata.image, band), metadata)[::-1]
    geometry = GridGeometry(width, height, metadata.resolution, metadata.origin[0], metadata.origin[1])
    return Occupancy(
        geometry, metadata.origin[2], values, metadata.mode, metadata.occupied_thresh, metadata.free_thresh
    )


def _bands(height: int, width: int) -> Iterator[slice]:
    """Return slices of consecutive rows of about _BAND_CELLS cells each."""
    rows = max(1, _BAND_CELLS // width)
    return (slice(first, min(first + rows, height)) for first in range(0, height, rows))


def _occupancy(
    colours: NDArray[np.float64], alpha: NDArray[np.float64] | None, metadata: _Metadata
) -> NDArray[np.float64]:
    """Return the occupancy (0..100, or -1 unknown) of pixels, in their order, by the rules of Nav2 since 1.5.

    Transparent pixels are unknown; of opaque ones alpha says nothing.
    """
    shade: NDArray[np.float64] = colours[:, :, 0]
    if colours.shape[2] > 1:
        shade = np.rint(colours @ _BRIGHTNESS * 255.0) / 255.0
    if metadata.mode == "raw":
        percent = np.rint(shade * 255.0)
        return np.where(percent <= OCCUPIED_PERCENT, percent, UNKNOWN_PERCENT)
    occ = shade if metadata.negate else 1.0 - shade
    if metadata.mode == "scale":
        between = np.rint((occ - metadata.free_thresh) / (metadata.occupied_thresh - metadata.free_thresh) * 100.0)
    else:
        between = np.full(occ.shape, float(UNKNOWN_PERCENT))
    values = np.where(
        occ >= metadata.occupied_thresh, OCCUPIED_PERCENT, np.where(occ <= metadata.free_thresh, 0.0, between)
    )
    if alpha is not None:
        values = np.where(alpha < 1.0, UNKNOWN_PERCENT, values)
    return values


def load_map(yaml_path: Path) -> StaticMap:
    """Read a map file into a grid aligned with the frame `map`; raises `MapFileError`.

    Occupancies between free and occupied (modes scale and raw) are classified by the file's thresholds; between them a
    cell is unknown, and so impassable. A yaw is applied by rotating the grid: no occupied cell is lost, walls may grow
    by half a cell, and cells outside the original grid are unknown. Yaw 0 keeps every cell.
    """
    occupancy = load_occupancy(yaml_path)
    # In the modes trinary and scale the thresholds were applied: only the extreme values are free or occupied.
    raw = occupancy.mode == "raw"
    percent = np.arange(256, dtype=np.uint8).view(np.int8)
    table = np.full(256, UNKNOWN, dtype=np.uint8)
    table[(percent >= 0) & (percent < max(1.0, 100.0 * occupancy.free_thresh if raw else 1.0))] = FREE
    table[percent > (100.0 * occupancy.occupied_thresh if raw else 99.0)] = LETHAL
    cells = occupancy.values.view(np.uint8)
    for rows in _bands(*cells.shape):
        cells[rows] = table[cells[rows]]
    if occupancy.yaw == 0.0:
        return StaticMap(occupancy.geometry, cells)
    return resampled(StaticMap(occupancy.geometry, cells), occupancy.yaw)


def save_map(
    path_prefix: Path, static: StaticMap, provenance: Mapping[str, object] | None = None, image: ImageFormat = "pgm"
) -> None:
    """Write PREFIX.pgm (or .png) and PREFIX.yaml so that `load_map` returns the same cells, each file atomically.

    provenance: see `read_provenance`.
    """
    percents = np.full(256, UNKNOWN_PERCENT, dtype=np.int8)
    percents[[FREE, LETHAL]] = 0, OCCUPIED_PERCENT
    plain = Occupancy(static.geometry, 0.0, percents[static.cells], "trinary", _WRITTEN_OCCUPIED, _WRITTEN_FREE)
    save_occupancy(path_prefix, plain, provenance, image)


def save_occupancy(
    path_prefix: Path, occupancy: Occupancy, provenance: Mapping[str, object] | None = None, image: ImageFormat = "pgm"
) -> None:
    """Write PREFIX.pgm (or .png) and PREFIX.yaml so that `load_occupancy` returns the same values, each atomically.

    Grades between free and occupied are written in the mode raw, with thresholds by which `load_map` returns the same.
    """
    percents = np.arange(256, dtype=np.uint8).view(np.int8)
    graded = bool(((occupancy.values > 0) & (occupancy.values < OCCUPIED_PERCENT)).any()) or occupancy.mode == "raw"
    if graded:
        shades = np.where(percents < 0, 255, percents).astype(np.uint8)
        only = occupancy.mode == "scale"
        occupied, free = (0.99, 0.01) if only else (occupancy.occupied_thresh, occupancy.free_thresh)
    else:
        shades = np.full(256, _SHADES[UNKNOWN], dtype=np.uint8)
        shades[percents == 0], shades[percents == OCCUPIED_PERCENT] = _SHADES[FREE], _SHADES[LETHAL]
        occupied, free = _WRITTEN_OCCUPIED, _WRITTEN_FREE
    pixels = np.ascontiguousarray(shades[occupancy.values.view(np.uint8)][::-1])
    data = io.BytesIO()
    Image.fromarray(pixels).save(data, format="PNG" if image == "png" else "PPM")
    image_file = path_prefix.with_name(f"{path_prefix.name}.{image}")
    atomic_write(image_file, data.getvalue(), mode=SHARED)
    g = occupancy.geometry
    text = (
        f"image: {image_file.name}\nmode: {'raw' if graded else 'trinary'}\nresolution: {g.resolution!r}\n"
        f"origin: [{g.origin_x!r}, {g.origin_y!r}, {occupancy.yaw!r}]\nnegate: 0\n"
        f"occupied_thresh: {occupied}\nfree_thresh: {free}\n"
    )
    if provenance:
        size = {"image_size": [g.width, g.height]}
        text += yaml.safe_dump({PROVENANCE_KEY: {**provenance, **size}}, sort_keys=False, allow_unicode=True)
    atomic_write(path_prefix.with_name(f"{path_prefix.name}.yaml"), text.encode(), mode=SHARED)


def read_provenance(yaml_path: Path) -> dict[str, Any]:
    """Return where a map came from, as it was given to `save_map`; empty for a map that doesn't say so.

    It stands in the map's file under PROVENANCE_KEY. Nav2 and ROS 1 ask for their keys by name and see no others.
    Raises `MapFileError`.
    """
    found = read_keys(yaml_path).get(PROVENANCE_KEY)
    return found if isinstance(found, dict) else {}


def unknown_keys(yaml_path: Path) -> list[str]:
    """Return the keys of a map's file that nobody reads, such as misspelt ones; raises `MapFileError`."""
    return [str(key) for key in read_keys(yaml_path) if key not in _KEYS]


# --- maps of the MovingAI benchmarks (Sturtevant 2012): lines of characters, without metres and unknown ---------------


class MapTextError(ValueError):
    """A file is no map or scenario of the MovingAI benchmarks; the text names file and remedy."""


def read_map_text(path: Path) -> NDArray[np.uint8]:
    """Return the cells of a `.map`, FREE or LETHAL (height, width), its first line first.

    Raises `MapTextError` and `OSError`.
    """
    lines = path.read_text("utf-8", errors="replace").splitlines()
    rows = [row for row in lines[lines.index("map") + 1 :] if row] if "map" in lines else []
    if not rows or len({len(row) for row in rows}) != 1:
        raise MapTextError(f"{path}: needs a line `map` and rows of equal length after it, as MovingAI's maps have")
    return np.array([[FREE if cell in ".GS" else LETHAL for cell in row] for row in rows], np.uint8)


def write_map_text(path: Path, cells: NDArray[np.uint8]) -> None:
    """Write cells (height, width), the first row first; what is not free is an obstacle. Raises `OSError`."""
    height, width = cells.shape
    rows = np.where(cells == FREE, ".", "@")
    text = f"type octile\nheight {height}\nwidth {width}\nmap\n" + "".join(f"{''.join(row)}\n" for row in rows)
    atomic_write(path, text.encode("ascii"), mode=SHARED)
