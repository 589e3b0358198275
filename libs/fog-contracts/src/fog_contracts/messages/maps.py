"""The versioned map and the reasons for its costs (zenoh, msgpack)."""

from typing import Annotated, Final, Literal

from msgspec import Meta

from fog_contracts.messages.basics import Cells, Count, Hash, Id, Message, Metres, Ring, Sent, Trace
from fog_contracts.messages.hazards import AreaHazard

MAX_CELLS: Final = 100_000_000
"""Limit of a map (500 m x 500 m at 5 cm), so that a damaged or hostile snapshot can't exhaust the memory."""


class MapGeometry(Message, frozen=True, kw_only=True):
    """Size in cells, resolution in m per cell, lower-left corner in the frame `map`."""

    width: Annotated[int, Meta(ge=1, le=65_535, extra={"unit": "cells"})]
    height: Annotated[int, Meta(ge=1, le=65_535, extra={"unit": "cells"})]
    resolution: Annotated[float, Meta(gt=0.0, le=10.0, extra={"unit": "m/cell"})]
    origin_x: Metres
    origin_y: Metres

    def __post_init__(self) -> None:
        if self.width * self.height > MAX_CELLS:
            raise ValueError(f"{self.width} x {self.height} cells are more than {MAX_CELLS}")


class Cause(Message, frozen=True, kw_only=True):
    """Why cells changed: the hazard, zone, obstacle or map that changed, and its new state."""

    kind: Literal["hazard", "zone", "obstacle", "map"]
    id: Annotated[str, Meta(max_length=64)]
    state: Annotated[str, Meta(max_length=32)]


Layer = Literal["cost", "speed"]
Packing = Literal["raw", "zlib"]


class MapDelta(Message, frozen=True, kw_only=True):
    """One window of one layer of a new map version; a version is applied when all its `parts` have arrived.

    `cells` is uint8, row-major, row 0 at the bottom, `w * h` values after unpacking. `hash` is the hash of the whole
    map (`fog_contracts.replica`) after the version.
    """

    epoch: Count
    seq: Count
    part: Annotated[int, Meta(ge=0, le=65_535)]
    parts: Annotated[int, Meta(ge=1, le=65_535)]
    layer: Layer
    x: Cells
    y: Cells
    w: Annotated[int, Meta(ge=1, le=65_535, extra={"unit": "cells"})]
    h: Annotated[int, Meta(ge=1, le=65_535, extra={"unit": "cells"})]
    packing: Packing
    cells: bytes
    hash: Hash
    causes: list[Cause] = []
    traces: list[Trace] = []


class MapHeartbeat(Message, frozen=True, kw_only=True):
    """The map-service's current version, 10 times a second."""

    epoch: Count
    seq: Count
    hash: Hash
    sent: Sent


class MapSnapshot(Message, frozen=True, kw_only=True):
    """The whole map at one version; the layers are zlib-packed uint8 grids of the same geometry.

    `static` is the floor plan for localization (0 free, 254 occupied, 255 unknown), without hazards and zones.
    """

    site: Id
    epoch: Count
    seq: Count
    hash: Hash
    geometry: MapGeometry
    cost: bytes
    speed: bytes
    static: bytes


class HazardArea(Message, frozen=True, kw_only=True):
    """A hazard with its area's polygon: the reason for costs inside it; `epoch` is the map-service's.

    `confirmed`: the aggregator lives and confirms the hazard; if not, the area may have changed since.
    """

    hazard: AreaHazard
    polygon: Ring
    label: str = ""
    confirmed: bool = True
    epoch: Count = 0
