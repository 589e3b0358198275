"""What the events say, where no other service's type says it: as JSON, in the words of the services' REST."""

from __future__ import annotations

import math
from typing import Any

from fog_contracts.messages import (
    REACH_UNIT_M,
    VIEW_SECTORS,
    Message,
    Mode,
    View,
    Zone,
)


class Hello(Message, frozen=True, kw_only=True):
    """The first event of a connection: which run of the service it is; `fresh`: drop what you have."""

    run: str
    fresh: bool
    site: str


class Thing(Message, frozen=True, kw_only=True):
    """A thing by its id; null when there is none any more."""

    id: str
    value: Any


class ZoneView(Zone, frozen=True, kw_only=True):
    """A zone, and whether it is in force."""

    active: bool


class PathView(Message, frozen=True, kw_only=True):
    """A path: corners (m, frame `map`), its plan's number, and how much of it (m) was released with it."""

    plan_id: int
    points: list[tuple[float, float]]
    released_length: float


class VitalsView(Message, frozen=True, kw_only=True):
    """How a robot did at a time (s since the epoch): CPU of its processes in percent of a core, Wi-Fi in dBm.

    `battery` is its charge, 0 to 1. Null: it does not measure that.
    """

    stamp: float
    cpu: dict[str, float]
    wifi_dbm: float | None
    battery: float | None


class FloorRobot(Message, frozen=True, kw_only=True):
    """A robot of a floor: how long ago it was heard (null: never), its mode, whether it may drive, and why not."""

    id: str
    age_s: float | None
    mode: Mode | None
    enabled: bool | None
    codes: list[str]


class ScanView(Message, frozen=True, kw_only=True):
    """What a robot's lidar sees: the nearest point (m, frame `map`) in each sector of 2 degrees that has one."""

    points: list[tuple[float, float]]
    stamp: float


def scan_view(view: View, stamp: float) -> ScanView:
    """Return the points of a robot's view, in the middle of their sectors."""
    width = math.tau / VIEW_SECTORS
    points = [
        (
            round(view.x + reach * REACH_UNIT_M * math.cos((sector + 0.5) * width), 3),
            round(view.y + reach * REACH_UNIT_M * math.sin((sector + 0.5) * width), 3),
        )
        for sector, reach in enumerate(view.reach)
        if reach
    ]
    return ScanView(points=points, stamp=stamp)
