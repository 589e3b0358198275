"""`fognav map export`, `fognav zone import`: map and masks as files of Nav2's map_server, and masks back as zones."""

import base64
import io
import tempfile
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import typer
from PIL import Image

from fog_runtime.configuration.maps import MapFileError, load_map, read_keys, save_map
from fog_runtime.files import SHARED, atomic_write
from fognav.operate.fog import find_fog
from fognav.operate.options import FogOption, JsonOption, checked_id, duration
from fognav.output import WrongUseError, exit_codes, print_result, writing
from fognav.programs import MAP_SERVICE

_MASKS: Final = ("keepout", "speed")
MaskKind = Literal["keepout", "speed"]


def map_export(
    folder: Annotated[Path, typer.Argument(metavar="DIR", help="Where the files are written; made if missing.")],
    *,
    fog: FogOption = None,
    json: JsonOption = False,
) -> None:
    """Write the floor plan and the masks of the zones in force as Nav2's map_server reads them.

    DIR gets map.yaml and map.pgm, keepout.yaml and .png for Nav2's KeepoutFilter, speed.yaml and .png for its
    SpeedFilter; comments in them name the filters' settings.
    """
    with exit_codes():
        found = find_fog(fog)
        with writing(folder):
            folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory() as scratch:
            for ending in ("yaml", "png"):
                (Path(scratch) / f"map.{ending}").write_bytes(found.fetch(MAP_SERVICE, f"/api/v1/map.{ending}"))
            plan = load_map(Path(scratch) / "map.yaml")
        masks = {
            f"{kind}.{ending}": found.fetch(MAP_SERVICE, f"/api/v1/masks/{kind}.{ending}")
            for kind in _MASKS
            for ending in ("png", "yaml")
        }
        with writing(folder):
            save_map(folder / "map", plan)
            for name, data in masks.items():
                atomic_write(folder / name, data, mode=SHARED)
        files = sorted(["map.yaml", "map.pgm", *masks])
        print_result({"folder": str(folder), "files": files}, f"wrote {', '.join(files)} to {folder}", json=json)


def zone_import(  # noqa: PLR0913  # each option is an argument
    mask: Annotated[Path, typer.Argument(metavar="MASK.yaml", help="File of map_server, which names an image.")],
    *,
    kind: Annotated[MaskKind, typer.Option("--kind", help="Of Nav2's KeepoutFilter, or of its SpeedFilter.")] = (
        "keepout"
    ),
    multiplier: Annotated[
        float, typer.Option("--multiplier", metavar="M/S", help="Of the speed filter's info: m/s per unit.")
    ] = 0.01,
    save: Annotated[bool, typer.Option("--save", help="Store the zones; else they are only told.")] = False,
    reason: Annotated[str, typer.Option("--reason", help="Why, for other people.")] = "",
    length: Annotated[str | None, typer.Option("--for", metavar="TIME", help="How long, such as 15m or 3d.")] = None,
    identifier: Annotated[
        str | None, typer.Option("--id", metavar="ID", help="Begin of the zones' ids; default: a new one.")
    ] = None,
    fog: FogOption = None,
    json: JsonOption = False,
) -> None:
    """Make zones of a mask of Nav2: a polygon for each connected part.

    In a keepout mask 99 and 100 are no-go, lower values a penalty; in a speed mask each value is a limit. Cells are
    read as map_server does, in each of its modes.
    """
    with exit_codes():
        body: dict[str, Any] = {"kind": kind, "multiplier": multiplier, "save": save, "reason": reason, **_files(mask)}
        if identifier is not None:
            body["id"] = checked_id(identifier)
        if length is not None:
            body["ttl_s"] = duration(length, "--for")
        told = find_fog(fog).send("POST", MAP_SERVICE, "/api/v1/masks", body)
        lines = [f"{each['zone']['id']}: {each['zone']['kind']}, {each['cells']} cells" for each in told["zones"]]
        end = "stored, and on the map" if told["saved"] else "nothing was stored: repeat it with --save"
        print_result(told, *lines, f"{len(lines)} zones: {end}", json=json)


def _files(mask: Path) -> dict[str, str]:
    """Return a mask's YAML and its image, as PNG in base64; raises `WrongUseError`."""
    try:
        name = read_keys(mask).get("image")
    except MapFileError as error:
        raise WrongUseError(str(error)) from error
    image = mask.parent / str(name)
    try:
        data = io.BytesIO()
        with Image.open(image) as picture:
            picture.save(data, "PNG")
    except (OSError, ValueError) as error:
        raise WrongUseError(f"{mask}: image: {image} can't be read ({error}). Name a PGM or PNG beside it") from error
    return {"yaml": mask.read_text("utf-8"), "png": base64.b64encode(data.getvalue()).decode("ascii")}
