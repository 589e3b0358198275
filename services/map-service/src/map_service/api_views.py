"""REST that reads the map: hazards, places, geometry, and pictures of the floor plan and the costmap."""

import asyncio
import io
from typing import Final

import numpy as np
from fastapi import Response
from PIL import Image

from fog_contracts.messages import HazardArea, MapGeometry, MapInfo
from fog_contracts.site import Site
from fog_runtime.concurrency import BusyError, Worker
from fog_runtime.http import Routes
from map_service.costmap import LayeredCostmap
from map_service.layers.base import Grid
from map_service.problems import ZONES_NOT_LOADED, add_busy_error, require_zones
from map_service.service import Service

Image.preinit()  # the first picture would load PIL's formats, while the map is served

_PNG: Final = "image/png"
_MAX_PICTURES: Final = 4
"""Most pictures that are being encoded or wait for it."""


class _Pictures:
    """PNGs whose pixel values are the cells', encoded on a thread of their own, once per version for all who ask."""

    def __init__(self, costmap: LayeredCostmap) -> None:
        self._costmap = costmap
        self._worker = Worker("pictures", limit=_MAX_PICTURES)
        self._latest: dict[str, tuple[object, asyncio.Future[bytes]]] = {}

    async def response(self, name: str, cells: Grid, palette: bytes) -> Response:
        """Return the picture of the current version; raises `BusyError` while too many are being encoded."""
        version, picture = self._latest.get(name, (None, None))
        if picture is None or version != self._costmap.version or (picture.done() and picture.exception()):
            # Copied before the event loop can change the map.
            picture = asyncio.ensure_future(self._worker.run(_png, cells.copy(), palette))
            self._latest[name] = self._costmap.version, picture
        return Response(await asyncio.shield(picture), media_type=_PNG, headers={"Cache-Control": "no-cache"})


def add_views(routes: Routes, service: Service, site: Site) -> None:
    """Add the routes."""
    add_busy_error(routes)
    core, costmap = service.core, service.core.costmap
    pictures = _Pictures(costmap)

    @routes.get("/api/v1/hazards")
    async def hazards() -> list[HazardArea]:
        """Return every area with its hazard as on the map."""
        return core.hazards()

    @routes.get("/api/v1/map")
    async def map_info() -> MapInfo:
        """Return the map's geometry and version."""
        g = costmap.geometry
        geometry = MapGeometry(
            width=g.width, height=g.height, resolution=g.resolution, origin_x=g.origin_x, origin_y=g.origin_y
        )
        return MapInfo(site=site.id, geometry=geometry, epoch=costmap.version.epoch, seq=costmap.version.seq)

    @routes.get("/api/v1/map.png", media_type=_PNG, raises=[BusyError])
    async def map_png() -> Response:
        """Return the floor plan: white is free, black occupied, grey unknown."""
        return await pictures.response("map", costmap.static, _PLAN)

    @routes.get("/api/v1/costmap.png", media_type=_PNG, raises=[BusyError], problems=ZONES_NOT_LOADED)
    async def costmap_png() -> Response:
        """Return the master costmap; a pixel's palette index is the cell's cost."""
        require_zones(service)
        return await pictures.response("cost", costmap.cost, _COSTS)


def _png(cells: Grid, palette: bytes) -> bytes:
    """Return a PNG whose palette indices are the cells; the image's first row is the grid's last."""
    image = Image.fromarray(np.ascontiguousarray(cells[::-1]))
    image.putpalette(palette)
    data = io.BytesIO()
    image.save(data, "PNG", compress_level=1)
    return data.getvalue()


def _palette(special: dict[int, tuple[int, int, int]]) -> bytes:
    """Return a palette of 256 colours: graded costs from near white to orange, other costs as in `special`."""
    colours = [(255, 250 - cost // 2, 240 - cost * 220 // 252) for cost in range(253)] + [(0, 0, 0)] * 3
    for cost, colour in special.items():
        colours[cost] = colour
    return bytes(channel for colour in colours for channel in colour)


_PLAN: Final = _palette({0: (255, 255, 255), 254: (0, 0, 0), 255: (205, 205, 205)})
_COSTS: Final = _palette({0: (255, 255, 255), 253: (90, 160, 220), 254: (150, 0, 40), 255: (205, 205, 205)})
