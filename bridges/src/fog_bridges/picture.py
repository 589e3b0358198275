"""The map as a picture: what is blocked and the robots on it, and where its pixels lie on the floor."""

from __future__ import annotations

import base64
import io
from typing import TYPE_CHECKING, Any, Final

import msgspec
import numpy as np
from PIL import Image, ImageDraw

from fog_contracts.channels import MAP_PICTURE
from fog_contracts.costs import FREE, INSCRIBED, LETHAL, UNKNOWN

if TYPE_CHECKING:
    from collections.abc import Mapping

    from numpy.typing import NDArray

_MOST_PX: Final = 1200
"""Width or height of a picture at most: a message has to stay small."""
_ROBOT_M: Final = 0.25
_ROBOT: Final = (30, 90, 200)
_UNKNOWN: Final = (205, 205, 205)
_WALL: Final = (40, 40, 40)


def _colours() -> NDArray[np.uint8]:
    """Return the colour (256, 3) of each cost: white to orange with the cost, dark where nothing may drive."""
    share = np.clip(np.arange(256) / INSCRIBED, 0.0, 1.0)[:, None]
    found = (255 - share * np.array((10, 90, 190))).astype(np.uint8)
    found[FREE] = 255
    found[LETHAL], found[UNKNOWN] = _WALL, _UNKNOWN
    return np.asarray(found, np.uint8)


class Picture:
    """The newest costmap and the robots on it, from the console's events `hello`, `map`, `costmap` and `pose`."""

    def __init__(self) -> None:
        self._geometry: dict[str, Any] = {}
        self._cost = np.zeros((0, 0), np.uint8)
        self._early: dict[tuple[int, int], NDArray[np.uint8]] | None = {}
        """Tiles that were told before the map that they are of, by row and column: no more than it has.

        None once the map is known.
        """
        self._poses: dict[str, Mapping[str, float]] = {}
        self.changed = False
        """Whether something is to be seen that was not drawn yet."""

    def on_event(self, name: str, data: dict[str, Any]) -> None:
        """Take in an event of the floor."""
        if name == "hello":
            if data["fresh"]:
                self._early, self._poses = {}, {}
        elif name == "map":
            size = data["geometry"]["height"], data["geometry"]["width"]
            if data["geometry"] != self._geometry:
                self._geometry, self._cost = data["geometry"], np.full(size, UNKNOWN, np.uint8)
            early, self._early = self._early or {}, None
            for (row, column), cells in early.items():
                self._paste(row, column, cells)
        elif name == "costmap":
            with Image.open(io.BytesIO(base64.b64decode(data["png"]))) as tile:
                cells = np.asarray(tile, np.uint8)[::-1]
            self._take(data["row"], data["column"], cells)
        elif name == "pose":
            if data["value"] is None:
                self._poses.pop(data["id"], None)
            else:
                self._poses[data["id"]] = data["value"]
        else:
            return
        self.changed = True

    def _take(self, row: int, column: int, cells: NDArray[np.uint8]) -> None:
        """Paste a tile, now or once its map is told.

        The console tells things in the order of their last changes: the map, whose version each change raises, comes
        after nearly all of its tiles.
        """
        if self._early is None:
            self._paste(row, column, cells)
        else:
            self._early[row, column] = cells

    def _paste(self, row: int, column: int, cells: NDArray[np.uint8]) -> None:
        into = self._cost[row : row + len(cells), column : column + cells.shape[1]]
        into[:] = cells[: into.shape[0], : into.shape[1]]

    def draw(self) -> tuple[str, str] | None:
        """Return the picture (PNG in base64), and the attributes (JSON) that place it; None without a map."""
        if not self._cost.size:
            return None
        self.changed = False
        step = -(-max(self._cost.shape) // _MOST_PX)
        while len((drawn := self._drawn(step))[0]) > MAP_PICTURE.limit:
            step += 1
        return drawn

    def _drawn(self, step: int) -> tuple[str, str]:
        """Draw with so many cells in a row and in a column of a pixel."""
        cell = self._geometry["resolution"] * step
        # The dearest of the cells that become a pixel: a wall must not vanish. What is unknown is no cost.
        rows, columns = (size // step for size in self._cost.shape)
        cells = self._cost[: rows * step, : columns * step]
        shown = np.where(cells == UNKNOWN, 0, cells).reshape(rows, step, columns, step).max(axis=(1, 3))
        unknown = (cells == UNKNOWN).reshape(rows, step, columns, step).all(axis=(1, 3))
        shown[unknown] = UNKNOWN
        picture = Image.fromarray(_colours()[shown][::-1])
        pen, radius = ImageDraw.Draw(picture), max(3.0, _ROBOT_M / cell)
        for robot, pose in sorted(self._poses.items()):
            x = (pose["x"] - self._geometry["origin_x"]) / cell
            y = rows - (pose["y"] - self._geometry["origin_y"]) / cell
            pen.ellipse((x - radius, y - radius, x + radius, y + radius), fill=_ROBOT)
            pen.text((x + radius, y - radius), robot, fill=_ROBOT)
        buffer = io.BytesIO()
        picture.quantize(64).save(buffer, "PNG")
        return base64.b64encode(buffer.getvalue()).decode(), self._placed(rows, columns, cell)

    def _placed(self, rows: int, columns: int, cell: float) -> str:
        """Return three corners, in m on the floor and in pixels, in the words that cards for vacuums have for these."""
        left, bottom = self._geometry["origin_x"], self._geometry["origin_y"]
        points = [
            {"vacuum": {"x": left + cell * x, "y": bottom + cell * (rows - y)}, "map": {"x": x, "y": y}}
            for x, y in ((0, 0), (columns, 0), (0, rows))
        ]
        return msgspec.json.encode({"calibration_points": points}).decode()
