"""`fognav map diff`: drives against a map, and what has stood for several of them into the map's commands."""

from __future__ import annotations

from pathlib import Path  # noqa: TC003  # Typer reads annotations at run time
from typing import TYPE_CHECKING, Annotated, Final

import msgspec
import numpy as np
import typer
from PIL import Image, ImageDraw

from fog_contracts.costs import FREE, LETHAL, UNKNOWN
from fog_runtime.configuration.maps import read_provenance
from fog_runtime.files import SHARED, atomic_write
from fognav import kernels
from fognav.commands.map_clean import begun, commands_file, read_commands, save_commands, with_lines
from fognav.commands.map_files import MapArgument  # noqa: TC001  # Typer reads annotations at run time
from fognav.map_files import file_hash, loaded
from fognav.operate.options import JsonOption  # noqa: TC001  # same
from fognav.output import FailedError, WrongUseError, check_writable, console, exit_codes, print_result, writing
from fognav_experiments.lidar_logs import LogFormat, RangeMax  # noqa: TC001  # same

if TYPE_CHECKING:
    from fog_contracts.grid import StaticMap
    from fog_mapping.changes import Change, Drive, Standing

_COLOURS: Final = {FREE: (255, 255, 255), LETHAL: (0, 0, 0), UNKNOWN: (205, 205, 205)}
_NEW: Final = (220, 40, 40)
_GONE: Final = (40, 90, 230)
_UNSEEN: Final = (250, 235, 170)
_WAY: Final = (60, 160, 80)


def add_diff(app: typer.Typer) -> None:
    """Add the command to `fognav map`."""
    app.command("diff", epilog="Example: fognav map diff floor-clean.yaml monday.mcap --png changes.png")(map_diff)


def map_diff(  # noqa: PLR0913  # each option is an argument
    map_file: MapArgument,
    logs: Annotated[list[Path], typer.Argument(metavar="LOG...", help="Logs of drives, as map from-log reads them.")],
    *,
    log_format: LogFormat = "auto",
    range_max: RangeMax = 30.0,
    png: Annotated[Path | None, typer.Option("--png", metavar="FILE", help="Draw the last drive's changes.")] = None,
    take_over: Annotated[
        bool, typer.Option("--take-over", help="Add what has stood for --drives drives to the map's commands.")
    ] = False,
    drives: Annotated[int, typer.Option("--drives", metavar="N", min=1, help="So many drives must agree.")] = 3,
    json: JsonOption = False,
) -> None:
    """Compare drives with a map: what is new (red), what is gone (blue), what was not seen (yellow).

    Drives are counted in MAP.changes.json. What moves is no change. A drive that does not fit the map is refused, with
    exit code 1.
    """
    from fog_mapping.alignment import MisfitError  # noqa: PLC0415  # keeps the other commands fast
    from fog_mapping.changes import commands_of, compare  # noqa: PLC0415  # same
    from fognav_experiments.lidar_logs.logs import read_log  # noqa: PLC0415  # same
    from fognav_experiments.lidar_logs.mapping import progress_bar, scans_of  # noqa: PLC0415  # same

    with exit_codes():
        check_writable(png)
        static, file = loaded(map_file), map_file.with_suffix(".changes.json")
        standing = _standing(file, static)
        commands, text = _commands(map_file, static) if take_over else (None, "")
        kernels.warm_cache(lambda line: console.print(line, markup=False))
        lines, drive = [], None
        for log in logs:
            try:
                with progress_bar() as show:
                    drive = compare(static, scans_of(read_log(log, log_format).scans, range_max), show)
            except (MisfitError, ValueError) as error:
                if isinstance(error, WrongUseError):
                    raise
                raise FailedError(f"{log} can't be compared with {map_file}: {error}") from error
            name = file_hash(log) or log.name
            counted = standing.add(name, drive)
            lines.append(f"{log}: {_summary(drive, static)}{'' if counted else ' (counted before)'}")
        assert drive is not None
        if png is not None:
            _write_png(png, static, drive)
        found = [_view(one) for one in standing.changes]
        lines += [_as_line(one) for one in standing.changes]
        taken = commands_of(standing.take(drives)) if take_over else []
        if commands is not None and taken:
            save_commands(commands, with_lines(text, taken))
            lines.append(f"added {len(taken)} lines to {commands}: run fognav map clean to have them in the map")
        with writing(file, "The drives are counted there"):
            atomic_write(file, msgspec.json.format(msgspec.json.encode(standing)) + b"\n", mode=SHARED)
        share = float(drive.unseen.sum() / max(1, int((static.cells == FREE).sum())))
        values = {"map": str(map_file), "changes": found, "unseen_share": round(share, 3), "taken_over": taken}
        print_result({**values, "alignment": drive.alignment._asdict()}, *lines, json=json)


def _standing(file: Path, static: StaticMap) -> Standing:
    """Return what earlier drives have shown; nothing if that was of another map. Raises `WrongUseError`."""
    from fog_mapping.changes import Standing  # noqa: PLC0415  # keeps the other commands fast

    # A cleaned map has other cells and the same frame; where the frame is another, its cells lie elsewhere.
    fresh = Standing(frame=static.geometry)
    if not file.exists():
        return fresh
    try:
        kept = msgspec.json.decode(file.read_bytes(), type=Standing)
    except (OSError, msgspec.DecodeError) as error:
        raise WrongUseError(
            f"{file} can't be read: {error}. Delete it: drives are counted from the start then"
        ) from error
    return kept if kept.frame == fresh.frame else fresh


def _commands(map_file: Path, static: StaticMap) -> tuple[Path, str]:
    """Return the file of commands that made a map, or begins for it, and its text; raises `WrongUseError`."""
    made = read_provenance(map_file).get("cleaned")
    if isinstance(made, dict):
        file = map_file.parent / str(made["sources"][-1]["file"])
        if not file.is_file():
            raise WrongUseError(f"{map_file} was cleaned by {file}, which is not there. Put it there again")
    else:
        file = commands_file(map_file)
        # One without commands names the map that others were laid onto.
        if file.exists() and read_commands(file, begun(file, map_file, static)).commands:
            raise WrongUseError(
                f"{file} has commands, which {map_file} does not show. Compare with the cleaned map: fognav map clean "
                f"{map_file} writes it"
            )
    return file, begun(file, map_file, static)


def _summary(drive: Drive, static: StaticMap) -> str:
    cell = static.geometry.resolution**2
    new, gone, unseen = (mask.sum() * cell for mask in (drive.new, drive.gone, drive.unseen))
    fit = f"{drive.alignment.share:.0%} of the walls agree"
    return f"{fit}; {new:.2f} m2 new, {gone:.2f} m2 gone, {unseen:.1f} m2 not seen"


def _view(change: Change) -> dict[str, object]:
    return {"kind": change.kind, "box": list(change.box), "drives": len(change.drives)}


def _as_line(change: Change) -> str:
    left, bottom, right, top = change.box
    times = len(change.drives)
    return f"{change.kind}: ({left:.2f}, {bottom:.2f}) to ({right:.2f}, {top:.2f}), drives in a row: {times}"


def _write_png(file: Path, static: StaticMap, drive: Drive) -> None:
    pixels = np.empty((*static.cells.shape, 3), np.uint8)
    for value, colour in _COLOURS.items():
        pixels[static.cells == value] = colour
    pixels[drive.unseen] = _UNSEEN
    pixels[drive.new], pixels[drive.gone] = _NEW, _GONE
    picture = Image.fromarray(pixels[::-1])
    at = static.geometry.grid_coordinates(drive.poses[:, :2])
    ImageDraw.Draw(picture).line([(float(x), static.geometry.height - 1.0 - float(y)) for x, y in at], fill=_WAY)
    with writing(file, "Name another .png"):
        picture.save(file, format="PNG")
