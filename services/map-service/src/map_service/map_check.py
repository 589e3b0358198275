"""Looks at a map before it is in force: `python -m map_service.map_check`, in a process of its own for each map.

A picture that needs more memory or time than there is ends this process, and never the one that robots wait for. It
reads a `Task` (msgpack) from standard input; the last line of its standard output is an `Outcome` (JSON). The map is
stored under its fingerprint, beside a picture of what changes.
"""

from __future__ import annotations

import contextlib
import io
import os
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

import msgspec
import numpy as np
import yaml  # type: ignore[import-untyped]  # PyYAML ships no types
from PIL import Image, UnidentifiedImageError

from fog_contracts.costs import FREE, LETHAL, UNKNOWN
from fog_contracts.messages import MapGeometry, Message, Place, PointXY, Zone
from fog_mapping.another_map import ChangedArea, Finding, agreement, changed_area, findings
from fog_runtime.configuration.maps import PROVENANCE_KEY, MapFileError, load_map, save_map
from fog_runtime.configuration.site import SiteError, load_site
from fog_runtime.configuration.uploaded_maps import MapName, UploadedMaps, fingerprint
from fog_runtime.files import SHARED, atomic_write

if TYPE_CHECKING:
    from fog_contracts.grid import StaticMap

MAX_CELLS: Final = 16_000_000
"""Of an uploaded map: 200 m x 200 m at 5 cm."""
_BAND_CELLS: Final = 1024 * 1024
_SIDES: Final = 65_535
_COLOURS: Final = {
    FREE: (255, 255, 255), LETHAL: (70, 78, 88), UNKNOWN: (205, 210, 216), 1: (200, 30, 40), 2: (20, 120, 190),
}  # fmt: skip
"""As on the plan; red are walls that come, blue those that go."""


class MapUpload(Message, frozen=True, kw_only=True):
    """A map as map_server writes it: the text of its YAML file, and its picture (PGM or PNG) in base64.

    The picture's name in the file does not matter.
    """

    yaml: Annotated[str, msgspec.Meta(max_length=16_384)]
    image: bytes


class Task(Message, frozen=True, kw_only=True):
    """An upload, or a map that is known by its name (None: that of `site.toml`); and what stands on the map now."""

    root: str
    site_dir: str
    site: str
    upload: MapUpload | None = None
    name: MapName | None = None
    zones: list[Zone]
    places: dict[str, Place]
    poses: dict[str, PointXY]
    goals: dict[str, PointXY]


class MapReport(Message, frozen=True, kw_only=True):
    """What a map would change. `name` is null for that of `site.toml`, `over` is the fingerprint of that one.

    `agreement`: which share of the walls of both maps lie on each other; below 0.7 it is another floor, or has another
    frame. `findings`: what would lie in a wall or off the map, and did not before. `trouble`: why services would not
    start with it, empty if they would.
    """

    name: MapName | None
    over: MapName
    geometry: MapGeometry
    before: MapGeometry
    area: ChangedArea
    agreement: float
    findings: list[Finding]
    trouble: str = ""


class BadMap(Message, frozen=True, kw_only=True):
    """Why an upload is no map."""

    field: Literal["yaml", "image"]
    problem: str


class Outcome(Message, frozen=True, kw_only=True):
    """One of the two."""

    report: MapReport | None = None
    bad: BadMap | None = None


class BadMapError(Exception):
    """An upload is no map."""

    def __init__(self, field: Literal["yaml", "image"], problem: str) -> None:
        super().__init__(problem)
        self.bad = BadMap(field=field, problem=problem)


def read_upload(upload: MapUpload) -> StaticMap:
    """Return the map in an upload; raises `BadMapError`."""
    try:
        with Image.open(io.BytesIO(upload.image), formats=("PPM", "PNG")) as picture:
            (width, height), kind = picture.size, str(picture.format).lower()
    except Image.DecompressionBombError as error:
        raise BadMapError("image", f"the picture has more than {MAX_CELLS} pixels: use a coarser resolution") from error
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError) as error:
        raise BadMapError("image", "the picture can't be read: save it as PGM or PNG") from error
    if width * height > MAX_CELLS or max(width, height) > _SIDES:
        raise BadMapError(
            "image", f"the picture has {width} x {height} pixels, more than {MAX_CELLS}: use a coarser resolution"
        )
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "map.yaml"
        file.with_suffix(f".{kind}").write_bytes(upload.image)
        file.write_text(_yaml_with(upload.yaml, f"map.{kind}", width, height), "utf-8")
        try:
            static = load_map(file)
        except MapFileError as error:
            problem = str(error).replace(f"{folder}/", "")
            raise BadMapError("image" if error.key == "image" else "yaml", problem) from error
    if static.cells.size > MAX_CELLS:
        raise BadMapError("yaml", "turned by its yaw the map has too many cells: save it with the yaw 0")
    _geometry(static)
    if not (static.cells == FREE).any():
        raise BadMapError("yaml", "no cell of the map is free: check negate, mode and the thresholds")
    return static


def _yaml_with(text: str, image: str, width: int, height: int) -> str:
    """Return a map's file with another picture; raises `BadMapError` where it is not what map_server reads."""
    try:
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text)):  # few bytes may stand for gigabytes
            raise BadMapError("yaml", "aliases (*name) are not accepted: write the values themselves")
        data = yaml.safe_load(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise BadMapError("yaml", f"it is not valid YAML: {' '.join(str(error).split())[:200]}") from error
    if not isinstance(data, dict):
        raise BadMapError("yaml", "it has no keys: take the YAML file that map_server writes beside the picture")
    own = data.pop(PROVENANCE_KEY, None)
    size = own.get("image_size") if isinstance(own, dict) else None
    if size is not None and size != [width, height]:
        raise BadMapError("image", f"the picture has {width} x {height} pixels, and the YAML file is of one of {size}")
    return str(yaml.safe_dump({**data, "image": image}))


def _geometry(static: StaticMap) -> MapGeometry:
    g = static.geometry
    values = {"width": g.width, "height": g.height, "resolution": g.resolution}
    try:
        return msgspec.convert({**values, "origin_x": g.origin_x, "origin_y": g.origin_y}, MapGeometry)
    except msgspec.ValidationError as error:
        raise BadMapError("yaml", f"the map's place or size is impossible: {error}") from error


def picture(before: StaticMap, after: StaticMap) -> bytes:
    """Return a PNG of the new map, with the walls that come and go; its first row is the grid's last."""
    g, cells = after.geometry, after.cells.copy()
    step = max(1, _BAND_CELLS // g.width)
    columns = np.arange(g.width)
    for first in range(0, g.height, step):
        rows = np.arange(first, min(first + step, g.height))
        at = np.column_stack((np.tile(columns, rows.size), np.repeat(rows, g.width)))
        was = before.geometry.sample(before.cells, g.centres(at), UNKNOWN).reshape(rows.size, g.width)
        band = cells[first : first + rows.size]
        band[(band == LETHAL) & (was == FREE)] = 1
        band[(band == FREE) & (was == LETHAL)] = 2
    image = Image.fromarray(np.ascontiguousarray(cells[::-1]))
    image.putpalette([channel for shade in range(256) for channel in _COLOURS.get(shade, (0, 0, 0))])
    data = io.BytesIO()
    image.save(data, "PNG", compress_level=4)
    return data.getvalue()


def picture_file(maps: UploadedMaps, name: MapName | None) -> Path:
    """Return the file with the picture of what a map would change."""
    return maps.folder / f"{name or 'site'}-changes.png"


def check(task: Task) -> MapReport:
    """Return what a map would change, and store it; raises `BadMapError`, and `SiteError` if the site is invalid."""
    loaded, maps = UploadedMaps.load(Path(task.root), Path(task.site_dir), task.site)
    own = load_site(Path(task.site_dir))
    name = task.name
    if task.upload is not None:
        after = read_upload(task.upload)
        name = fingerprint(after)
        maps.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        save_map(maps.folder / name, after, image="png")
    else:
        after = own.map if name is None else load_map(maps.file(name))
    over = fingerprint(own.map)
    atomic_write(picture_file(maps, None if name == over else name), picture(loaded.map, after), mode=SHARED)
    return MapReport(
        name=None if name == over else name,
        over=over,
        geometry=_geometry(after),
        before=_geometry(loaded.map),
        area=changed_area(loaded.map, after),
        agreement=round(agreement(loaded.map, after), 3),
        findings=findings(loaded.site, loaded.map, after, task.zones, task.poses, task.places, task.goals),
        trouble="" if name is None else _trouble(Path(task.site_dir), maps.file(name)),
    )


def _trouble(site_dir: Path, file: Path) -> str:
    """Return why a service would not start with a map; empty if it would."""
    try:
        load_site(site_dir, map_file=file)
    except SiteError as error:
        return str(error).replace(f"{site_dir}/", "")
    return ""


def main() -> None:
    """Carry out the task."""
    with contextlib.suppress(OSError):  # where memory ends, this is what ends
        Path("/proc/self/oom_score_adj").write_text("1000", "ascii")
    os.nice(10)
    task = msgspec.msgpack.decode(sys.stdin.buffer.read(), type=Task)
    try:
        outcome = Outcome(report=check(task))
    except BadMapError as error:
        outcome = Outcome(bad=error.bad)
    sys.stdout.buffer.write(b"\n" + msgspec.json.encode(outcome) + b"\n")


if __name__ == "__main__":
    main()
