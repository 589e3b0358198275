"""Measures the map-service's core: full and partial updates, the costliest zones, thousands of zones, a snapshot."""

from __future__ import annotations

import math
import time
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from fog_contracts import channels as ch
from fog_contracts.handlers import Moment
from fog_contracts.messages import (
    VIEW_SECTORS,
    CorridorShape,
    PolygonShape,
    RectangleShape,
    RobotObstacles,
    RobotPose,
    Shape,
    View,
    Zone,
)
from map_service.core import MapCore
from map_service.registry import make_layers
from map_service.zone_times import StoredState
from map_service.zones import prepare_zone, zones_spans

if TYPE_CHECKING:
    from collections.abc import Callable

    from fog_contracts.grid import StaticMap

_AT: Final = Moment(0.0, 0.0)
_OBSTACLES: Final = 4_000
"""As many obstacle cells as one robot may hold."""


def worst_shapes(floor: StaticMap) -> list[Shape]:
    """Return legal shapes that take longest to check and rasterize: long outlines, many corners."""
    left, bottom, right, top = floor.geometry.bounds
    lines = min(500, int(95_000 / floor.geometry.height))
    step = (right - left - 1.0) / lines
    zigzag = [(left + 0.5 + step * i, top - 0.5 if i % 2 else bottom + 0.5) for i in range(lines)]
    radius, x, y = 0.45 * min(right - left, top - bottom), (left + right) / 2, (bottom + top) / 2
    star = [
        (x + r * math.cos(a), y + r * math.sin(a))
        for a, r in ((2 * math.pi * i / 500, radius if i % 2 else radius / 2) for i in range(500))
    ]
    whole = RectangleShape(corner=(left, bottom), opposite=(right, top))
    return [CorridorShape(line=zigzag, width=0.4), PolygonShape(points=star), whole]


def measure(floor: StaticMap, zones: int, repeats: int) -> dict[str, float | int]:
    """Return the figures, in ms, medians of `repeats` unless they are named worst."""
    core = MapCore("bench", floor, 1, layers=make_layers(floor))
    stored = random_zones(floor, zones)

    def load() -> None:
        spans, _ = zones_spans(stored, floor.geometry)
        core.load_zones(stored, _AT, StoredState(spans=spans))

    load_ms = _timed(load)
    core.tick(_AT)
    full = [_timed(core.costmap.recompute) for _ in range(repeats)]
    shapes = worst_shapes(floor)
    zone = Zone(id="worst", kind="BLOCKED", shape=shapes[-1])
    prepared = [min(_timed(partial(_prepare, shape, floor)) for _ in range(repeats)) for shape in shapes]
    portions = _commits(core, partial(core.put_zone, zone, _AT)) + _commits(
        core, partial(core.remove_zone, zone.id, _AT)
    )
    return {
        "cells": floor.geometry.width * floor.geometry.height,
        "zones": zones,
        "full_ms": round(float(np.median(full)), 3),
        "window_ms": round(float(np.median(_small_changes(core, floor, repeats))), 3),
        "worst_zone_ms": round(max(prepared), 3),
        "worst_portion_ms": round(max(portions), 3),
        "portions": len(portions),
        "load_zones_ms": round(load_ms, 1),
        "snapshot_ms": round(_timed(core.costmap.snapshot), 3),
        "worst_obstacles_ms": round(_worst_obstacles(floor), 3),
    }


def _prepare(shape: Shape, floor: StaticMap) -> None:
    prepare_zone(Zone(id="worst", kind="BLOCKED", shape=shape), floor.geometry, 0.0)


def _commits(core: MapCore, change: Callable[[], object]) -> list[float]:
    """Return the times (ms) of the portions in which a change reaches the map."""
    times = [_timed(change)]
    while core.pending:
        times.append(_timed(partial(core.continue_commit, _AT)))
    return times


def _small_changes(core: MapCore, floor: StaticMap, repeats: int) -> list[float]:
    """Return the times (ms) in which a no-go zone of 2 x 2 m becomes a delta, and so does its end."""
    left, bottom, right, top = floor.geometry.bounds
    x, y = (left + right) / 2, (bottom + top) / 2
    prepared = prepare_zone(
        Zone(id="small", kind="BLOCKED", shape=RectangleShape(corner=(x, y), opposite=(x + 2.0, y + 2.0))),
        floor.geometry,
        0.0,
    )
    put, remove = partial(core.put_zone, prepared.zone, _AT, prepared.spans), partial(core.remove_zone, "small", _AT)
    return [_timed(change) for _ in range(repeats) for change in (put, remove)]


def _worst_obstacles(floor: StaticMap) -> float:
    """Return the longest time (ms) of a robot's report beside as many obstacles as it may hold, seen and cleared."""
    core = MapCore("bench", floor, 1, layers=make_layers(floor))
    core.load_zones([], _AT)
    core.tick(_AT)
    handlers, (left, bottom, *_) = core.handlers(), floor.geometry.bounds
    step, columns = floor.geometry.resolution, min(100, floor.geometry.width)
    cells = [divmod(number, columns) for number in range(min(_OBSTACLES, columns * min(100, floor.geometry.height)))]
    points = [(left + step * (column + 0.5), bottom + step * (row + 0.5)) for row, column in cells]
    middle = points[len(points) // 2 + columns // 2]
    reports = [
        RobotObstacles(points=points[first : first + 2000], stamp=0.0, ttl=600.0)
        for first in range(0, len(points), 2000)
    ] + [
        RobotObstacles(
            points=[], stamp=0.0, ttl=600.0, view=View(x=middle[0], y=middle[1], reach=bytes([255]) * VIEW_SECTORS)
        )
        for _ in range(2)
    ]
    pose = RobotPose(
        x=middle[0], y=middle[1], theta=0.0, covariance=[0.0] * 9, v=0.0, w=0.0, radius=0.17, height=0.35, stamp=0.0
    )
    robot = {"robot": "r1"}
    handlers[ch.ROBOT_POSE](robot, pose, _AT)
    return max(_timed(partial(handlers[ch.ROBOT_OBSTACLES], robot, report, _AT)) for report in reports)


def random_zones(floor: StaticMap, count: int) -> list[Zone]:
    """Return zones of 5 x 5 m, anywhere on the floor, the same at each call."""
    rng = np.random.default_rng(1)
    left, bottom, right, top = floor.geometry.bounds
    corners = rng.uniform((left, bottom), (right - 5.0, top - 5.0), (count, 2)).tolist()
    shapes = [RectangleShape(corner=(x, y), opposite=(x + 5.0, y + 5.0)) for x, y in corners]
    return [
        Zone(id=f"z{number}", kind="PENALTY", factor=1.0 + number % 400 / 100, shape=shape)
        for number, shape in enumerate(shapes)
    ]


def _timed(function: Callable[[], object]) -> float:
    begun = time.perf_counter()
    function()
    return (time.perf_counter() - begun) * 1000.0
