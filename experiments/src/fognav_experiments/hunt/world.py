"""What the file of a hunted world says: a floor, a robot and its sensors, and what happens on a drive.

It names no draw: the same file is the same drive, whatever the drawing of worlds has become. Lengths in m, angles in
rad, times in s.
"""

from __future__ import annotations

import math
from functools import cache
from typing import TYPE_CHECKING, Annotated, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta

from fog_contracts.grid import GridGeometry, StaticMap
from fog_contracts.messages import Id, Place, PointXY, Pose, Seconds
from fog_contracts.site import AreaSite, DemoPlan, NodeSite, RobotSite, Site, Sonar
from fog_kernels.components import Components
from fog_kernels.distance import squared_distance_capped
from fog_runtime.configuration.parts import DEFAULT_BASE, DEFAULT_LIDAR
from fog_runtime.configuration.robot_file import RobotFile, default_robot
from fognav_experiments.scenarios.description import AnyEvent, BadLine, Obstacle
from fognav_sim.floor import Floor
from fognav_sim.sensors import LidarFaults, Noise

if TYPE_CHECKING:
    from numpy.typing import NDArray

Box = tuple[float, float, float, float]
"""left, bottom, right, top (m)"""
_Wave = tuple[float, float, float, float]
"""Its number (1/m), cosine and sine of its direction, its phase (rad)."""
_FREE, _WALL = 0, 254
_WAVES = 3
_SPARE_M = 0.08
"""More than its radius that a robot needs to each side."""


class Watched(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A watched area, a box, and its one node on the wall, at (x, y) and looking along theta; `limit` of its sonars."""

    id: Id
    box: Box
    node: tuple[float, float, float]
    limit: Annotated[float, Meta(gt=0.02, le=4.0)]


class Patch(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Surfaces within `radius` of (x, y) return a beam of the lidar with this probability."""

    x: float
    y: float
    radius: float
    returned: Annotated[float, Meta(ge=0.0, le=1.0)]


class Sensors(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How wheels and sensors err.

    `recorded`: the lidar errs as recorded ones do, with `patches` and `dead` sectors. `scale`: travel on the ground for
    what the encoders count, `gain`: speed for what is commanded, both left and right, `wander`: of the gain.
    `grip` (m/s2): what wheels hold on the floor, 0: everything.
    """

    recorded: bool = False
    patches: list[Patch] = []
    dead: list[tuple[float, float]] = []
    scale: tuple[float, float] = (1.0, 1.0)
    gain: tuple[float, float] = (1.0, 1.0)
    wander: float = 0.0
    slip: Annotated[float, Meta(ge=0.0, le=0.1)] = 0.01
    grip: Annotated[float, Meta(ge=0.0)] = 0.0
    sonar_miss: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.0
    sonar_spike: Annotated[float, Meta(ge=0.0, le=1.0)] = 0.004

    def noise(self) -> Noise:
        """Return it as the simulator takes it."""
        patches = tuple((patch.x, patch.y, patch.radius, patch.returned) for patch in self.patches)
        lidar = LidarFaults(patches=patches, dead=tuple(self.dead)) if self.recorded or patches or self.dead else None
        return Noise(
            wheel_scale=self.scale, wheel_gain=self.gain, wheel_wander=self.wander,
            slip=self.slip, grip=self.grip or math.inf, sonar_miss=self.sonar_miss, sonar_spike=self.sonar_spike,
            lidar=lidar,
        )  # fmt: skip


class Mounting(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """How the lidar is mounted, as in a robot's settings; in its `masks` it sees the robot."""

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0
    mirrored: bool = False
    masks: list[tuple[float, float]] = []


class HuntWorld(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A drive from `start` (x, y, theta) to `goal` on a floor of free boxes in solid wall, of `size` (x, y).

    Or on that of a `map`, the file of a map_server map in one of the folders that the hunter is given.

    `pillars`: walls in free boxes. `opened`: walls of the map that are not there (doors that were closed when it was
    made); `placed`: things that are there and not on the map. `warp_m`: by how much the map is off at most, smoothly,
    over `warp_length_m`. `quirks`: what the base does otherwise than others of its kind. `demo`: a barrier closes a
    watched area on the way, as in a demonstration. `seed`: of the sensors' noise, and of that barrier.
    """

    title: str
    start: tuple[float, float, float]
    goal: PointXY
    size: tuple[float, float] = (1.0, 1.0)
    free: list[Box] = []
    map: str = ""
    pillars: list[Box] = []
    opened: list[Box] = []
    placed: list[Box] = []
    resolution: Annotated[float, Meta(ge=0.02, le=0.2)] = 0.05
    warp_m: Annotated[float, Meta(ge=0.0, le=0.3)] = 0.0
    warp_length_m: Annotated[float, Meta(ge=2.0)] = 10.0
    radius: Annotated[float, Meta(gt=0.05, le=0.5)] = 0.17
    base: Id = DEFAULT_BASE
    lidar: Id = DEFAULT_LIDAR
    mounting: Mounting = Mounting()
    quirks: dict[str, int | float | bool] = {}
    watched: list[Watched] = []
    sensors: Sensors = Sensors()
    events: list[AnyEvent] = []
    demo: bool = False
    seconds: Seconds = 240.0
    seed: int = 1

    def mounted(self) -> RobotFile:
        """Return the robot's settings."""
        plain, at = default_robot(self.base, self.lidar), self.mounting
        lidar = msgspec.structs.replace(
            plain.settings.lidar, x_m=at.x, y_m=at.y, yaw_rad=at.yaw, mirrored=at.mirrored, masks=at.masks
        )
        return RobotFile(settings=msgspec.structs.replace(plain.settings, lidar=lidar))

    @property
    def busy(self) -> bool:
        """Whether messages may be late."""
        return any(event.__struct_config__.tag in {"slow-link", "busy-radio"} for event in self.events)

    @property
    def garbled(self) -> float:
        """Share of the bytes to and from the base that are lost or wrong at worst."""
        lines = [event for event in self.events if isinstance(event, BadLine) and event.device == "base"]
        return max((line.lost + line.flipped for line in lines), default=0.0)


class Built(NamedTuple):
    """A world as the system takes it: the site, its map, and the floor as it truly is."""

    site: Site
    map: StaticMap
    floor: Floor
    truth: NDArray[np.uint8]
    """The cells of the floor."""

    def connects(self, world: HuntWorld) -> bool:
        """Whether the robot fits through from start to goal, both on the map and on the floor."""
        geometry, reach = self.map.geometry, world.radius + _SPARE_M
        cap = math.ceil(reach / geometry.resolution) + 1
        for cells in (self.map.cells, self.truth):
            squared = squared_distance_capped(np.ascontiguousarray(cells != _FREE, np.uint8), cap)
            near = np.sqrt(squared.astype(np.float64)) * geometry.resolution < reach
            parts = Components(np.where(near, _WALL, _FREE).astype(np.uint8))
            if not parts.connected(geometry.cell(*world.start[:2]), geometry.cell(*world.goal)):
                return False
        return True


def build(world: HuntWorld, recorded: StaticMap | None = None) -> Built:
    """Return a world's map and floor; raises `ValueError` for a start or goal that is not free on it.

    `recorded`: what the file of its `map` holds, if it has one.
    """
    width, height = (math.ceil(side / world.resolution) for side in world.size)
    geometry = GridGeometry(width, height, world.resolution, 0.0, 0.0) if recorded is None else recorded.geometry
    plain = np.full(geometry.shape, _WALL, np.uint8) if recorded is None else recorded.cells
    mapped = _cells(geometry, plain, world.free, [*world.pillars, *world.opened])
    truth = _cells(geometry, plain, world.free, [*world.pillars, *world.placed])
    site = Site(
        id="hunt",
        places={"a": Place(x=world.start[0], y=world.start[1]), "b": Place(x=world.goal[0], y=world.goal[1])},
        demo=DemoPlan(start="a", goal="b", areas=[area.id for area in world.watched]),
        areas=[
            AreaSite(id=area.id, label=area.id, polygon=_ring(area.box), number=number)
            for number, area in enumerate(world.watched, start=1)
        ],
        nodes=[
            NodeSite(
                id=f"n-{area.id}", area=area.id, x=area.node[0], y=area.node[1], theta=area.node[2],
                sonars=[Sonar(angle=angle, range_limit=area.limit) for angle in (-0.22, 0.22)],
            )
            for area in world.watched
        ],
        robots=[RobotSite(id="r1", start=_pose(world.start), radius=world.radius)],
    )  # fmt: skip
    watched = {area.id for area in world.watched}
    for event in world.events:
        if isinstance(event, Obstacle) and event.area is not None and event.area not in watched:
            raise ValueError(f"{world.title}: an obstacle stands in area {event.area}, which is not watched: add it")
    floor = Floor(geometry, truth)
    for name, (x, y) in (("start", world.start[:2]), ("goal", world.goal)):
        if floor.nearest(x, y)[0] < world.radius:
            raise ValueError(f"{world.title}: its {name} ({x:g}, {y:g}) is not free: choose another one")
    return Built(site, StaticMap(geometry, _warped(world, geometry, mapped)), floor, truth)


def displacement(world: HuntWorld, x: float, y: float) -> tuple[float, float]:
    """Return how far (m) what is drawn at (x, y) of the map truly is from there."""
    if world.warp_m == 0.0:
        return 0.0, 0.0
    dx, dy = (
        world.warp_m / _WAVES * sum(math.sin(number * (cos * x + sin * y) + phase) for number, cos, sin, phase in waves)
        for waves in _waves(world.seed, world.warp_length_m)
    )
    return dx, dy


def to_map(world: HuntWorld, x: float, y: float) -> tuple[float, float]:
    """Return where the map draws what truly is at (x, y)."""
    mx, my = x, y
    for _ in range(3):
        dx, dy = displacement(world, mx, my)
        mx, my = x - dx, y - dy
    return mx, my


def _displaced(
    world: HuntWorld, x: NDArray[np.float64], y: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sum a few waves."""

    def moved(waves: list[_Wave]) -> NDArray[np.float64]:
        total = np.zeros_like(x)
        for number, cos, sin, phase in waves:
            total += np.sin(number * (cos * x + sin * y) + phase)
        return total * (world.warp_m / _WAVES)

    along_x, along_y = _waves(world.seed, world.warp_length_m)
    return moved(along_x), moved(along_y)


@cache
def _waves(seed: int, length_m: float) -> tuple[list[_Wave], list[_Wave]]:
    """Return the waves along x and y, whose phases the seed gives."""
    random = np.random.default_rng(seed)

    def wave() -> _Wave:
        direction, phase = (float(drawn) for drawn in random.uniform(0.0, math.tau, 2))
        number = math.tau / length_m * random.uniform(0.6, 1.4)
        return number, math.cos(direction), math.sin(direction), phase

    return [wave() for _ in range(_WAVES)], [wave() for _ in range(_WAVES)]


def _warped(world: HuntWorld, geometry: GridGeometry, cells: NDArray[np.uint8]) -> NDArray[np.uint8]:
    if world.warp_m == 0.0:
        return cells
    columns, rows = np.meshgrid(np.arange(geometry.width), np.arange(geometry.height))
    x, y = (
        geometry.origin_x + (columns + 0.5) * geometry.resolution,
        geometry.origin_y + (rows + 0.5) * geometry.resolution,
    )
    dx, dy = _displaced(world, x.astype(np.float64), y.astype(np.float64))
    from_column = np.clip(
        np.floor((x + dx - geometry.origin_x) / geometry.resolution).astype(np.int64), 0, geometry.width - 1
    )
    from_row = np.clip(
        np.floor((y + dy - geometry.origin_y) / geometry.resolution).astype(np.int64), 0, geometry.height - 1
    )
    return np.ascontiguousarray(cells[from_row, from_column])


def _cells(geometry: GridGeometry, plain: NDArray[np.uint8], free: list[Box], walls: list[Box]) -> NDArray[np.uint8]:
    cells = plain.copy()
    for boxes, value in ((free, _FREE), (walls, _WALL)):
        for box in boxes:
            left, right = (max(0, round((x - geometry.origin_x) / geometry.resolution)) for x in box[::2])
            bottom, top = (max(0, round((y - geometry.origin_y) / geometry.resolution)) for y in box[1::2])
            cells[bottom:top, left:right] = value
    return cells


def _ring(box: Box) -> list[PointXY]:
    left, bottom, right, top = box
    return [(left, bottom), (right, bottom), (right, top), (left, top)]


def _pose(start: tuple[float, float, float]) -> Pose:
    return Pose(x=start[0], y=start[1], theta=start[2])
