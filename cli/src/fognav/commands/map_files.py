"""`fognav map check, info, convert`: files of maps, as map_server and others read them."""

from __future__ import annotations

from pathlib import Path  # Typer reads annotations at run time
from typing import TYPE_CHECKING, Annotated, Final

import numpy as np
import typer
from PIL import Image

from fog_contracts.costs import UNKNOWN
from fog_contracts.grid import GridGeometry, StaticMap
from fog_contracts.resampling import resampled
from fog_runtime.configuration.maps import (
    MapFileError,
    MapTextError,
    load_occupancy,
    read_keys,
    read_map_text,
    read_provenance,
    save_map,
    save_occupancy,
    unknown_keys,
    write_map_text,
)
from fognav.commands import installed
from fognav.map_files import described, loaded, provenance
from fognav.operate.options import JsonOption  # noqa: TC001  # Typer reads annotations at run time
from fognav.output import NOT_TRUE, WrongUseError, check_writable, exit_codes, print_result, writing

if TYPE_CHECKING:
    from collections.abc import Iterator

    from fog_mapping.checking import Finding
    from fog_runtime.configuration.maps import ImageFormat

map_app = typer.Typer(
    cls=installed.Commands, help="Make maps of buildings; show the hazards on the fog's map.", no_args_is_help=True
)

MapArgument = Annotated[Path, typer.Argument(metavar="MAP.yaml", help="File of map_server, which names an image.")]

_UNKNOWN_SHADE: Final = 205
"""The grey by which map_server writes unknown cells."""


def map_check(
    map_file: MapArgument,
    *,
    radius: Annotated[
        float, typer.Option("--radius", metavar="M", min=0.01, max=5.0, help="Radius (m) of the robot.")
    ] = 0.17,
    json: JsonOption = False,
) -> None:
    """List everything in a map that a robot would trip over, with its place (m) and remedy.

    The exit code is 1 if there is something.
    """
    from fog_mapping.checking import check_cells  # noqa: PLC0415  # keeps the other commands fast

    with exit_codes():
        if not map_file.is_file():
            raise WrongUseError(f"{map_file} is not a file. Name the YAML file of a map")
        found: list[Finding] = []
        try:
            found.extend(_check_file(map_file))
            found.extend(check_cells(loaded(map_file), radius))
        except (MapFileError, WrongUseError) as error:
            found.append(_finding("file", str(error), "A robot can't read this map"))
    views = [{**one._asdict(), "places": [list(place) for place in one.places]} for one in found]
    lines = (_as_line(one) for one in found)
    print_result({"map": str(map_file), "findings": views}, *(lines if found else ["nothing found"]), json=json)
    if found:
        raise typer.Exit(NOT_TRUE)


def _finding(kind: str, text: str, remedy: str) -> Finding:
    from fog_mapping.checking import Finding  # noqa: PLC0415  # keeps the other commands fast

    return Finding(kind, text, remedy)


def _as_line(one: Finding) -> str:
    places = f" at {', '.join(f'({x:.2f}, {y:.2f})' for x, y in one.places)}" if one.places else ""
    return f"{one.kind}: {one.text}{places}. {one.remedy}"


def _check_file(file: Path) -> Iterator[Finding]:
    """Yield what is wrong with the keys of a map's file, and with what they make of the image."""
    from fog_mapping.checking import odd_resolution  # noqa: PLC0415  # keeps the other commands fast

    keys, occupancy = read_keys(file), load_occupancy(file)
    for key in unknown_keys(file):
        yield _finding("key", f"{file}: {key}: no reader knows this key", "Is it misspelt? Correct or remove it")
    if occupancy.yaw != 0.0:
        yield _finding(
            "yaw",
            f"{file}: origin: the map is turned by {occupancy.yaw:g} rad, which many readers ignore",
            "Write it without: fognav map clean MAP.yaml straighten",
        )
    odd = odd_resolution(occupancy.geometry.resolution)
    if odd is not None:
        yield _finding("resolution", f"{file}: resolution: {odd}", "Correct it, or use fognav map convert --resolution")
    size, (height, width) = read_provenance(file).get("image_size"), occupancy.values.shape
    if size is not None and size != [width, height]:
        yield _finding(
            "image-size",
            f"{file}: image: has {width} x {height} pixels, but was written with {size[0]} x {size[1]}",
            "The origin is wrong for a cropped image: cut it by fognav map clean MAP.yaml crop, or write it again",
        )
    with Image.open(file.parent / str(keys["image"])) as picture:
        grey = np.asarray(picture.convert("L"))
    if occupancy.mode != "raw" and bool((occupancy.values[::-1][grey == _UNKNOWN_SHADE] == 0).any()):
        yield _finding(
            "thresholds",
            f"{file}: free_thresh {occupancy.free_thresh:g} makes the grey of unknown cells ({_UNKNOWN_SHADE}) free",
            "Write 0.196 with negate: 0",
        )
    edge = np.concatenate((occupancy.values[[0, -1]].ravel(), occupancy.values[:, [0, -1]].ravel()))
    if keys.get("negate") and (edge == 0).mean() > 0.5:
        yield _finding(
            "negate", f"{file}: negate: 1 makes the map's edge free and what is bright occupied", "Write `negate: 0`"
        )


def map_info(map_file: MapArgument, *, json: JsonOption = False) -> None:
    """Show a map's size, resolution, origin and cells, and where it came from."""
    with exit_codes():
        values = described(loaded(map_file))
        origin, yaw = read_provenance(map_file), load_occupancy(map_file).yaw
        lines = [f"{name:12} {value}" for name, value in values.items()]
        if yaw:
            lines.append(f"{'yaw':12} {yaw:g} rad in the file; what is above is of the cells after that turn")
            values["yaw"] = yaw
        lines += [f"{name:12} {value}" for name, value in origin.items()] or ["provenance   not said in this file"]
        print_result({"map": str(map_file), **values, "provenance": origin or None}, *lines, json=json)


def map_convert(
    source: Annotated[
        Path, typer.Argument(metavar="FROM", help="A map's .yaml, or a .map of the MovingAI benchmarks.")
    ],
    target: Annotated[
        Path, typer.Argument(metavar="TO", help="A .pgm, .png (its .yaml is written beside it), .yaml or .map.")
    ],
    *,
    resolution: Annotated[
        float | None,
        typer.Option("--resolution", metavar="M", min=0.001, max=10.0, help="Size (m) of a cell of the new map."),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Write a map in another format or resolution, and say what the new one can't hold.

    A coarser cell is occupied if any of its cells is. The cells of a .map have no size: with --resolution they get it.
    """
    kinds = {".pgm": "pgm", ".yaml": "pgm", ".png": "png", ".map": "map"}
    with exit_codes():
        kind = kinds.get(target.suffix)
        if kind is None or target.resolve() == source.resolve():
            raise WrongUseError(f"{target} must be another file that ends in one of {', '.join(kinds)}")
        check_writable(target)
        check_writable(target.with_suffix(".yaml"))
        with writing(target):
            lost = (_to_text if kind == "map" else _to_image)(source, target, resolution)
        print_result(
            {"file": str(target), "lost": lost}, f"wrote {target}", *(f"lost: {line}" for line in lost), json=json
        )


def _to_text(source: Path, target: Path, resolution: float | None) -> list[str]:
    static = _at_resolution(_read(source, None), resolution)
    write_map_text(target, static.cells[::-1])
    g = static.geometry
    unknown = int((static.cells == UNKNOWN).sum())
    lost = [f"{g.resolution:g} m per cell, the origin ({g.origin_x:g}, {g.origin_y:g}) and where the map came from"]
    return ([f"{unknown} unknown cells are obstacles now"] if unknown else []) + lost


def _to_image(source: Path, target: Path, resolution: float | None) -> list[str]:
    image: ImageFormat = "png" if target.suffix == ".png" else "pgm"
    prefix = target.with_suffix("")
    if prefix.with_suffix(".yaml").resolve() == source.resolve():
        raise WrongUseError(f"{target} would replace {source}, which describes another image. Name another file")
    if source.suffix == ".map":
        save_map(prefix, _read(source, resolution), provenance(source), image)
        text = source.read_text("utf-8", errors="replace").partition("\nmap\n")[2]
        kinds = sorted(set("".join(text.split())) - set(".@"))
        return [f"kinds of terrain, which are free or occupied now: {' '.join(kinds)}"] if kinds else []
    try:
        occupancy = load_occupancy(source)
        made = {**read_provenance(source), "converted": provenance(source)}
    except MapFileError as error:
        raise WrongUseError(str(error)) from error
    if resolution is None or resolution == occupancy.geometry.resolution:
        save_occupancy(prefix, occupancy, made, image)
        return []
    static = loaded(source)
    save_map(prefix, _at_resolution(static, resolution), made, image)
    lost = [] if occupancy.yaw == 0.0 else [f"the yaw of {occupancy.yaw:g} rad: the cells are turned instead"]
    graded = int(((occupancy.values > 0) & (occupancy.values < 100)).sum())
    lost += [f"the grades of {graded} cells, which are free, occupied or unknown now"] if graded else []
    coarser = resolution > static.geometry.resolution
    return lost + ([f"what is smaller than {resolution:g} m; walls are up to a cell thicker"] if coarser else [])


def _read(source: Path, resolution: float | None) -> StaticMap:
    if source.suffix != ".map":
        return loaded(source)
    try:
        cells = read_map_text(source)[::-1]
    except (MapTextError, OSError) as error:
        raise WrongUseError(f"{error}. Name a .yaml, or a .map of the MovingAI benchmarks") from error
    return StaticMap(GridGeometry(cells.shape[1], cells.shape[0], resolution or 1.0, 0.0, 0.0), cells)


def _at_resolution(static: StaticMap, resolution: float | None) -> StaticMap:
    return static if resolution is None else resampled(static, resolution=resolution)
