"""Draw the site's map from its vector description, and check that site.toml matches it.

`python sites/estig/generate.py` reads floor.toml and writes map.pgm and map.yaml (map_server's format, trinary) beside
it; the same description always gives the same bytes. `--check` writes nothing and fails if the files differ.
"""

import argparse
import math
import sys
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from fog_contracts.geometry import normalized_polygon
from fog_contracts.grid import GridGeometry
from fog_contracts.shapes import rasterize
from fog_contracts.site import NodeSite, Site, Sonar

HERE = Path(__file__).parent
FREE, OCCUPIED, UNKNOWN = 254, 0, 205
"""Grey values of map_server: white, black, and a grey between its two thresholds."""

HALF_CONE = math.radians(7.5)
"""Half the opening of an HC-SR04's cone."""
LIMIT_GAP = (0.2, 0.5)
"""Range (m) of the distance from a sonar's range limit to the nearest permanent echo behind it."""

Positive = Annotated[float, Meta(gt=0.0)]
Point = tuple[float, float]


class FloorError(ValueError):
    """The description or site.toml is wrong; the message names the place and the error."""


class Building(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Outer size (m), margin of unknown space, resolution (m per cell) and thickness of drawn walls."""

    size: tuple[Positive, Positive]
    margin: float
    resolution: Positive
    wall: Positive


class StackUsers(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Size (m) of the recess of a closed door."""

    width: Positive
    depth: Positive


class Box(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """An axis-aligned rectangle, given by two opposite corners (m)."""

    id: str
    corners: tuple[Point, Point]


class Corridor(msgspec.Struct, frozen=True, forbid_unknown_fields=True, rename={"start": "from", "end": "to"}):
    """An axis-aligned corridor, given by its middle line; doors by their distance (m) from the start."""

    id: str
    start: Point
    end: Point
    width: Positive
    doors_left: list[float] = []
    doors_right: list[float] = []

    def boxes(self, doors: StackUsers) -> list[tuple[Point, Point]]:
        """Return the corridor (it ends half a width beyond the line) and its recesses as rectangles."""
        (x0, y0), (x1, y1) = self.start, self.end
        length = math.hypot(x1 - x0, y1 - y0)
        if length == 0.0 or (x0 != x1 and y0 != y1):
            raise FloorError(f"floor.toml: corridor {self.id} must run along x or y")
        ux, uy = (x1 - x0) / length, (y1 - y0) / length
        half = self.width / 2

        def box(along0: float, along1: float, left0: float, left1: float) -> tuple[Point, Point]:
            return (
                (x0 + along0 * ux - left0 * uy, y0 + along0 * uy + left0 * ux),
                (x0 + along1 * ux - left1 * uy, y0 + along1 * uy + left1 * ux),
            )

        boxes = [box(-half, length + half, -half, half)]
        for side, distances in ((1.0, self.doors_left), (-1.0, self.doors_right)):
            for distance in distances:
                if not 0.0 <= distance <= length:
                    raise FloorError(f"floor.toml: corridor {self.id} is {length} m long; no door can be at {distance}")
                edge = side * half
                along0, along1 = distance - doors.width / 2, distance + doors.width / 2
                boxes.append(box(along0, along1, edge, edge + side * doors.depth))
        return boxes


class Floor(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The description of the floor (floor.toml)."""

    building: Building
    doors: StackUsers
    corridors: list[Corridor]
    halls: list[Box]
    obstacles: list[Box]

    @property
    def geometry(self) -> GridGeometry:
        """Grid over the building and its margin."""
        b = self.building
        width, height = (round((side + 2 * b.margin) / b.resolution) for side in b.size)
        return GridGeometry(width, height, b.resolution, -b.margin, -b.margin)


Image = NDArray[np.uint8]


def _fill(image: Image, geometry: GridGeometry, corners: tuple[Point, Point], value: int) -> None:
    """Set all cells whose centre is in the rectangle."""
    (xa, ya), (xb, yb) = corners

    def line(value: float, origin: float) -> int:
        # A corner on the boundary of two cells must not depend on rounding errors.
        return math.ceil((value - origin) / geometry.resolution - 0.5 - 1e-6)

    left, right = line(min(xa, xb), geometry.origin_x), line(max(xa, xb), geometry.origin_x)
    bottom, top = line(min(ya, yb), geometry.origin_y), line(max(ya, yb), geometry.origin_y)
    if left < 0 or bottom < 0 or right > geometry.width or top > geometry.height:
        raise FloorError(f"floor.toml: the rectangle {corners} reaches beyond the map")
    image[bottom:top, left:right] = value


def draw(floor: Floor) -> Image:
    """Return the map as grey values (height, width), row 0 at the bottom."""
    geometry = floor.geometry
    image = np.full(geometry.shape, UNKNOWN, dtype=np.uint8)
    for corridor in floor.corridors:
        for box in corridor.boxes(floor.doors):
            _fill(image, geometry, box, FREE)
    for hall in floor.halls:
        _fill(image, geometry, hall.corners, FREE)
    walls = _dilate(image == FREE, round(floor.building.wall / geometry.resolution)) & (image != FREE)
    image[walls] = OCCUPIED
    _outer_walls(image, floor)
    for obstacle in floor.obstacles:
        _fill(image, geometry, obstacle.corners, OCCUPIED)
    return image


def _outer_walls(image: Image, floor: Floor) -> None:
    width, height = floor.building.size
    wall = floor.building.wall
    sides: list[tuple[Point, Point]] = [
        ((0.0, 0.0), (width, wall)),
        ((0.0, height - wall), (width, height)),
        ((0.0, 0.0), (wall, height)),
        ((width - wall, 0.0), (width, height)),
    ]
    for side in sides:
        _fill(image, floor.geometry, side, OCCUPIED)


def _dilate(mask: NDArray[np.bool_], cells: int) -> NDArray[np.bool_]:
    """Dilate a mask by a number of cells along both axes."""
    grown = mask.copy()
    for axis in (0, 1):
        source = grown.copy()
        for shift in range(1, cells + 1):
            for sign in (shift, -shift):
                grown |= np.roll(source, sign, axis=axis)
    return grown


def pgm(image: Image) -> bytes:
    """Encode as PGM (P5); its first row is the map's top."""
    height, width = image.shape
    return f"P5\n{width} {height}\n255\n".encode() + image[::-1].tobytes()


def yaml(geometry: GridGeometry) -> bytes:
    """Return map_server's description; 205 lies between the thresholds: (255 - 205) / 255 = 0.19608."""
    return (
        "image: map.pgm\n"
        "mode: trinary\n"
        f"resolution: {geometry.resolution}\n"
        f"origin: [{geometry.origin_x}, {geometry.origin_y}, 0.0]\n"
        "negate: 0\n"
        "occupied_thresh: 0.65\n"
        "free_thresh: 0.196\n"
    ).encode()


def ray(image: Image, geometry: GridGeometry, x: float, y: float, angle: float, reach: float = 6.0) -> float:
    """Distance (m) from a point to the first cell that is not free, in steps of a fifth of a cell."""
    step = geometry.resolution / 5
    for count in range(math.ceil(reach / step)):
        column, row = geometry.cell(x + count * step * math.cos(angle), y + count * step * math.sin(angle))
        if not geometry.contains_cell(column, row) or image[row, column] != FREE:
            return count * step
    return reach


def check_site(site: Site, image: Image, geometry: GridGeometry) -> None:
    """Raise `FloorError` if a place, robot, area or node of site.toml does not match the map."""
    clear = ~_dilate(image != FREE, round(0.2 / geometry.resolution))
    positions = {f"places.{name}": (place.x, place.y) for name, place in site.places.items()}
    positions |= {f"robots {robot.id}": (robot.start.x, robot.start.y) for robot in site.robots}
    for name, (x, y) in positions.items():
        column, row = geometry.cell(x, y)
        if not geometry.contains_cell(column, row) or not clear[row, column]:
            raise FloorError(f"site.toml: {name} at ({x}, {y}) has no 0.2 m of free floor around it")
    areas = {area.id: area for area in site.areas}
    for area in site.areas:
        window, mask = rasterize(normalized_polygon(area.polygon), geometry)
        free = float(np.mean(image[window.rows, window.columns][mask] == FREE))
        if free < 0.9:
            raise FloorError(f"site.toml: only {free:.0%} of area {area.id} is free floor")
        if not any(node.area == area.id for node in site.nodes):
            raise FloorError(f"site.toml: no node watches area {area.id}; add one with area = {area.id!r}")
    for node in site.nodes:
        if node.area not in areas:
            raise FloorError(
                f"site.toml: node {node.id} watches {node.area!r}, which is not an area; add it to [[areas]]"
            )
        for sonar in node.sonars:
            _check_sonar(node, sonar, image, geometry)


def _check_sonar(node: NodeSite, sonar: Sonar, image: Image, geometry: GridGeometry) -> None:
    axis = node.theta + sonar.angle
    cone = np.linspace(axis - HALF_CONE, axis + HALF_CONE, 31)
    wall = min(ray(image, geometry, node.x, node.y, float(angle)) for angle in cone)
    gap = wall - sonar.range_limit
    if not LIMIT_GAP[0] <= gap <= LIMIT_GAP[1]:
        raise FloorError(
            f"site.toml: node {node.id}, sonar at {sonar.angle} rad: the nearest echo of the empty corridor is at"
            f" {wall:.2f} m, so range_limit should be about {wall - 0.3:.2f} m, not {sonar.range_limit}"
        )


def load_floor(path: Path) -> Floor:
    """Read a description; raises `FloorError` that names the field."""
    try:
        return msgspec.convert(tomllib.loads(path.read_text("utf-8")), Floor)
    except (tomllib.TOMLDecodeError, msgspec.ValidationError) as error:
        raise FloorError(f"{path.name}: {error}") from error


def load_site_file(path: Path) -> Site:
    """Read site.toml; raises `FloorError` that names the field."""
    try:
        raw: dict[str, Any] = tomllib.loads(path.read_text("utf-8"))
        return msgspec.convert(raw, Site)
    except (tomllib.TOMLDecodeError, msgspec.ValidationError) as error:
        raise FloorError(f"{path.name}: {error}") from error


def generate(directory: Path = HERE) -> dict[Literal["map.pgm", "map.yaml"], bytes]:
    """Return the generated files of a site's directory; raises `FloorError` if the description is inconsistent."""
    floor = load_floor(directory / "floor.toml")
    image = draw(floor)
    check_site(load_site_file(directory / "site.toml"), image, floor.geometry)
    return {"map.pgm": pgm(image), "map.yaml": yaml(floor.geometry)}


def main() -> int:
    """Write the files, or with --check compare them with the existing ones."""
    parser = argparse.ArgumentParser(description="Draw map.pgm and map.yaml from floor.toml")
    parser.add_argument("--check", action="store_true", help="write nothing; fail if a file differs")
    check = parser.parse_args().check
    try:
        files = generate()
    except FloorError as error:
        print(error, file=sys.stderr)
        return 1
    for name, data in files.items():
        path = HERE / name
        if not check:
            path.write_bytes(data)
            print(f"wrote {path.name}, {len(data)} bytes")
        elif not path.exists() or path.read_bytes() != data:
            print(f"{path.name} does not match floor.toml: run {Path(__file__).name}", file=sys.stderr)
            return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
