"""What the sonars of a sensor node hear of a map's walls, and what the node makes of it, as its firmware does. Pure.

A sonar's cone is a fan of rays. Walls echo only below a maximum angle of incidence. Metres, radians, frame `map`.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from fog_contracts.cones import SONAR_HALF_CONE
from fog_contracts.costs import LETHAL
from fog_contracts.messages import AreaState, NodeConfig
from fog_kernels.raycast import cast

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from numpy.typing import NDArray

    from fog_contracts.grid import StaticMap
    from fog_contracts.site import NodeSite

SONAR_MIN_M: Final = 0.02
SONAR_MAX_M: Final = 4.0
SONAR_RAYS: Final = 16
SONAR_MAX_INCIDENCE: Final = math.radians(45.0)
"""Smooth surfaces reflect ultrasound like a mirror: beyond this angle of incidence no echo returns."""

Beam = tuple[float, float, float, float]
"""A sonar's node (x, y, theta) and its own angle on it: m and rad."""


class Fan(NamedTuple):
    """The rays of a sonar's cone from (x, y), the ranges (m) of the walls that they meet, and those that echo."""

    x: float
    y: float
    directions: NDArray[np.float64]
    walls: NDArray[np.float64]
    echoes: NDArray[np.float64]


def wall_fan(
    beam: Beam, ahead: float, ranges: Callable[[float, float, NDArray[np.float64], float], NDArray[np.float64]]
) -> Fan:
    """Return the fan of a sonar that begins so far `ahead` (m) of its node, whose own cell may be part of its wall.

    `ranges(x, y, directions, reach)` are those of rays to the first wall, infinite for none.
    """
    node_x, node_y, theta, angle = beam
    directions = theta + angle + np.linspace(-SONAR_HALF_CONE, SONAR_HALF_CONE, SONAR_RAYS)
    x, y = node_x + ahead * math.cos(theta), node_y + ahead * math.sin(theta)
    walls = ranges(x, y, directions, SONAR_MAX_M)
    return Fan(x, y, directions, walls, _echo_ranges(walls, directions))


def _echo_ranges(ranges: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Keep the ranges of a fan where the angle of incidence, estimated from neighbouring rays, gives an echo."""
    finite = np.where(np.isfinite(ranges), ranges, 1e3)
    x, y = finite * np.cos(directions), finite * np.sin(directions)
    dx, dy = np.gradient(x), np.gradient(y)
    # The surface runs along (dx, dy); the incidence is zero where the ray is at a right angle to it.
    along = np.abs(dx * np.cos(directions) + dy * np.sin(directions)) / np.maximum(np.hypot(dx, dy), 1e-9)
    return np.where(np.isfinite(ranges) & (along <= math.sin(SONAR_MAX_INCIDENCE)), ranges, np.inf)


def heard_on_map(static: StaticMap, node: NodeSite) -> list[float | None]:
    """Return what each sonar of a node hears (m) of a map with nothing else on it, without noise; None: nothing."""
    g, walls = static.geometry, (static.cells == LETHAL).astype(np.uint8)
    found: list[float | None] = []
    for sonar in node.sonars:
        fan = wall_fan(
            (node.x, node.y, node.theta, sonar.angle), g.resolution,
            lambda *ray: cast(walls, g.resolution, g.origin_x, g.origin_y, *ray),
        )  # fmt: skip
        nearest = float(fan.echoes.min()) + g.resolution
        found.append(nearest if SONAR_MIN_M <= nearest <= SONAR_MAX_M else None)
    return found


def default_config(node: NodeSite) -> NodeConfig:
    """Return the configuration that a node is flashed with: the calibration of its site."""
    return NodeConfig(
        version=0,
        range_limit_m=[sonar.range_limit for sonar in node.sonars],
        range_max_m=[sonar.range_max or 0.0 for sonar in node.sonars],
        no_echo_is_clear=[sonar.no_echo_is_clear for sonar in node.sonars],
    )


def classify_sonars(ranges: Sequence[float | None], config: NodeConfig) -> list[AreaState]:
    """Classify the range (m; None for no echo) of each sonar, without the firmware's hysteresis."""
    states: list[AreaState] = []
    farthest = config.range_max_m or [0.0] * len(ranges)
    limits = zip(ranges, config.range_limit_m, farthest, config.no_echo_is_clear, strict=True)
    for measured, limit, most, silent in limits:
        if measured is None:
            states.append("clear" if silent else "unknown")
        elif measured < limit:
            states.append("blocked")
        else:
            states.append("unknown" if most and measured > most else "clear")
    return states


def classify(ranges: Sequence[float | None], config: NodeConfig) -> AreaState:
    """Classify ranges (m) as the firmware does: one near echo means blocked; clear takes every sonar, and an echo."""
    states = classify_sonars(ranges, config)
    if "blocked" in states:
        return "blocked"
    return "clear" if set(states) == {"clear"} and any(measured is not None for measured in ranges) else "unknown"
