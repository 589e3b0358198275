"""`fognav map from-plan`: a map of the picture of a floor plan, by two of its points and their distance."""

from __future__ import annotations

import math
import warnings
from pathlib import Path  # noqa: TC003  # Typer reads annotations at run time
from typing import TYPE_CHECKING, Annotated, Final, Literal

import numpy as np
import typer
from PIL import Image, ImageOps, UnidentifiedImageError

from fog_runtime.configuration.maps import save_map
from fognav.map_files import described, provenance
from fognav.operate.options import JsonOption  # noqa: TC001  # Typer reads annotations at run time
from fognav.output import WrongUseError, check_writable, exit_codes, print_result, writing

if TYPE_CHECKING:
    from numpy.typing import NDArray

Pixel = tuple[float, float]

_PIXEL_M: Final = (0.0005, 0.1)
"""A pixel smaller than the first is a wrong distance; in one larger than the last walls can't be seen."""
_MOST_PIXELS: Final = 50_000_000


def map_from_plan(  # noqa: PLR0913  # each option is an argument
    context: typer.Context,
    plan: Annotated[Path, typer.Argument(metavar="PLAN", help="A picture of one floor: PNG, JPEG or TIFF.")],
    *,
    points: Annotated[
        tuple[str, str] | None,
        typer.Option("--points", metavar="X,Y X,Y", help="Two points in pixels, from the picture's upper left corner."),
    ] = None,
    metres: Annotated[float | None, typer.Option("--metres", metavar="M", help="How far they are apart (m).")] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="PREFIX", help="PREFIX.yaml and .pgm are written: PLAN.")
    ] = None,
    doors: Annotated[
        Literal["open", "closed"], typer.Option("--doors", help="What openings become that are no wider than doors.")
    ] = "open",
    inside: Annotated[
        str | None, typer.Option("--inside", metavar="X,Y", help="A pixel of the floor that is kept: drop the others.")
    ] = None,
    wall: Annotated[
        float | None,
        typer.Option("--wall", metavar="M", min=0.01, max=2.0, help="How thick (m) walls are at least; found if left."),
    ] = None,
    resolution: Annotated[
        float, typer.Option("--resolution", metavar="M", min=0.02, max=0.2, help="Size of a cell (m).")
    ] = 0.05,
    json: JsonOption = False,
) -> None:
    """Make a map of a floor plan: its walls, without texts, symbols, hatches and doors.

    (0, 0) is the lower left corner of the walls. A scan that lies askew is straightened. What walls don't enclose is
    unknown. Name two points that lie far apart.
    """
    from fog_mapping.plan import PIXELS_IN_CELL, PlanError, map_of_plan  # noqa: PLC0415  # keeps the others fast

    with exit_codes():
        picture = _picture(plan)
        pixel_m, ends = _scale(points, metres, picture.size)
        if context.args:
            raise WrongUseError(f"{' '.join(context.args)}: not expected here. See fognav map from-plan --help")
        prefix = plan.with_suffix("") if out is None else out
        for suffix in (".yaml", ".pgm"):
            file = prefix.with_name(f"{prefix.name}{suffix}")
            if file.resolve() == plan.resolve():
                raise WrongUseError(f"{file} would replace the plan. Name another --out")
            check_writable(file)
        size = resolution / PIXELS_IN_CELL
        place = None
        if inside is not None:
            x, y = _point("--inside", inside, picture.size)
            place = x * pixel_m, (picture.height - y) * pixel_m
        try:
            pixels = _sampled(picture, pixel_m / size)
            made = map_of_plan(pixels, size, finest=pixel_m, doors=doors, inside=place, wall=wall)
        except PlanError as error:
            raise WrongUseError(f"{plan}: {error}") from error
        x, y, theta = made.pose
        found = {
            "metres_per_pixel": round(pixel_m, 6),
            "picture_pose": [round(x, 4), round(y, 4), round(theta, 6)],
            "wall_m": None if made.wall is None else round(made.wall, 3),
            "doors_closed": made.doors,
            "floors_m2": [round(area, 1) for area in made.floors],
        }
        with writing(prefix, "Name another --out"):
            save_map(prefix, made.map, provenance(plan, points=[list(end) for end in ends], metres=metres, **found))
        values = {"file": f"{prefix}.yaml", **described(made.map), **found}
        print_result(values, *_lines(values, theta, inside), json=json)


def _picture(file: Path) -> Image.Image:
    """Return a picture on white, as viewers show it; raises `WrongUseError`."""
    remedy = "Export the plan as PNG, one page and floor"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(file) as opened:
                picture = ImageOps.exif_transpose(opened)
                if picture.mode.startswith("I"):
                    picture = picture.point(lambda value: value / 256.0).convert("L")
                picture = picture.convert("RGBA")
    except UnidentifiedImageError as error:
        raise WrongUseError(f"{file} is no picture that can be read. {remedy}") from error
    except (Image.DecompressionBombWarning, Image.DecompressionBombError) as error:
        raise WrongUseError(f"{file} has too many pixels. Export it at 40 pixels per metre or so") from error
    except (OSError, SyntaxError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise WrongUseError(f"{file} can't be read: {reason}. {remedy}") from error
    white = Image.new("RGBA", picture.size, "white")
    return Image.alpha_composite(white, picture).convert("RGB")


def _scale(points: tuple[str, str] | None, metres: float | None, size: tuple[int, int]) -> tuple[float, list[Pixel]]:
    """Return a pixel's side (m) and the two points that tell it; raises `WrongUseError`."""
    if points is None:
        raise WrongUseError("--points is missing. Give two points in pixels and their distance: --points 120,80 980,80")
    ends = [_point("--points", text, size) for text in points]
    apart = math.dist(*ends)
    if apart < 1.0:
        raise WrongUseError(f"--points {' '.join(points)}: both are the same pixel. Give two that lie far apart")
    if metres is None or not math.isfinite(metres) or metres <= 0.0:
        shown = "is missing" if metres is None else f"{metres:g} is no distance"
        raise WrongUseError(f"--metres {shown}. Say how many metres apart the two --points are, such as --metres 12.5")
    pixel_m = metres / apart
    if not _PIXEL_M[0] <= pixel_m <= _PIXEL_M[1]:
        odd = "no building is drawn so finely" if pixel_m < _PIXEL_M[0] else "its walls can't be seen"
        raise WrongUseError(
            f"--metres {metres:g}: a metre of the plan has {1.0 / pixel_m:.3g} pixels: {odd}. Correct --metres or "
            f"--points, or export the plan at 20 to 100 pixels per metre"
        )
    return pixel_m, ends


def _point(option: str, text: str, size: tuple[int, int]) -> Pixel:
    try:
        x, y = (float(part) for part in text.split(","))
    except ValueError:
        raise WrongUseError(
            f"{option}: {text!r} is no point. Give pixels as X,Y from the upper left corner, such as 120,80"
        ) from None
    if not (0.0 <= x <= size[0] and 0.0 <= y <= size[1]):
        raise WrongUseError(f"{option}: {text} lies outside of the picture, which has {size[0]} x {size[1]} pixels")
    return x, y


def _sampled(picture: Image.Image, scale: float) -> NDArray[np.uint8]:
    """Return a picture's pixels at another scale, from its lower left corner on; raises `WrongUseError`."""
    width, height = (int(length * scale + 1e-6) for length in picture.size)
    if width * height > _MOST_PIXELS:
        raise WrongUseError(
            f"the plan would become {width} x {height} pixels. Crop it to one floor, or name a coarser --resolution; "
            "is --metres right?"
        )
    if min(width, height) < 2:
        raise WrongUseError("the plan is smaller than two cells. Are --points and --metres right?")
    top = max(0.0, picture.height - height / scale)
    box = (0.0, top, min(float(picture.width), width / scale), float(picture.height))
    how = Image.Resampling.BOX if scale < 1.0 else Image.Resampling.BICUBIC
    return np.asarray(picture.resize((width, height), how, box))


def _lines(values: dict[str, object], theta: float, inside: str | None) -> list[str]:
    width, height = (float(values[key]) * float(values["resolution"]) for key in ("width", "height"))  # type: ignore[arg-type]  # both are numbers
    found = [f"wrote {values['file']}: {width:.1f} x {height:.1f} m"]
    if theta:
        found.append(f"turned the plan by {math.degrees(theta):.2f} degrees, so that its walls run along the axes")
    least = values["wall_m"]
    found.append(
        "all is drawn with one pen: straight lines are walls" if least is None else f"walls: thicker than {least} m"
    )
    if values["doors_closed"]:
        found.append(f"closed {values['doors_closed']} doors")
    floors: list[float] = values["floors_m2"]  # type: ignore[assignment]  # made above
    if len(floors) > 1 and inside is None:
        areas = ", ".join(f"{area:g}" for area in floors[:4])
        found.append(
            f"{len(floors)} floors that no way joins (m2: {areas}{', ...' if len(floors) > 4 else ''}): name a pixel "
            "of the robot's by --inside X,Y to keep that alone"
        )
    return found
