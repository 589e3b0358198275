"""Maps of the MovingAI benchmarks (Sturtevant 2012): lines of characters, from the top, without metres and unknown."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fog_contracts.costs import FREE, LETHAL
from fog_runtime.files import SHARED, atomic_write


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
