"""Shortest paths by their definition, and costmaps to search them on."""

from __future__ import annotations

import heapq
from itertools import product
from typing import TYPE_CHECKING

import numpy as np
from hypothesis import strategies as st

from fog_kernels.steps import DIAGONAL, STRAIGHT

if TYPE_CHECKING:
    from numpy.typing import NDArray

Cell = tuple[int, int]


def dijkstra(costmap: NDArray[np.uint8], start: Cell, neutral: int = 50, factor: float = 0.8) -> dict[Cell, int]:
    """Integer costs from start to every reachable cell, by the definition."""
    height, width = costmap.shape
    weights = [round(neutral + factor * cost) if cost < 253 else 0 for cost in range(256)]

    def weight(x: int, y: int) -> int:
        return weights[costmap[y, x]] if 0 <= x < width and 0 <= y < height else 0

    if not weight(*start):
        return {}
    costs = {start: 0}
    queue = [(0, start)]
    while queue:
        cost, (x, y) = heapq.heappop(queue)
        if cost > costs[x, y]:
            continue
        for dx in (-1, 0, 1):
            for dy in (-1, 0, 1):
                if (dx, dy) == (0, 0) or not weight(x + dx, y + dy):
                    continue
                if dx and dy and not (weight(x + dx, y) and weight(x, y + dy)):
                    continue
                edge = (DIAGONAL if dx and dy else STRAIGHT) * (weight(x, y) + weight(x + dx, y + dy))
                reached = cost + edge
                if reached < costs.get((x + dx, y + dy), 1 << 60):
                    costs[x + dx, y + dy] = reached
                    heapq.heappush(queue, (reached, (x + dx, y + dy)))
    return costs


@st.composite
def costmaps(draw: st.DrawFn) -> NDArray[np.uint8]:
    height = draw(st.integers(1, 22))
    width = draw(st.integers(1, 22))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    graded = draw(st.booleans())
    costmap = rng.integers(0, 253, (height, width)).astype(np.uint8) if graded else np.zeros((height, width), np.uint8)
    share = draw(st.sampled_from([0.0, 0.1, 0.35, 0.5]))
    walls = rng.random((height, width)) < share
    costmap[walls] = rng.choice(np.array([253, 254, 255], np.uint8), int(walls.sum()))
    return costmap


@st.composite
def floors(draw: st.DrawFn) -> NDArray[np.uint8]:
    """Rooms of several sizes behind doors, or anything."""
    if draw(st.integers(0, 3)) == 0:
        return draw(costmaps())
    size = draw(st.integers(3, 8))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    costmap = np.full((3 * size + 1, 3 * size + 1), 254, np.uint8)
    costs = np.array(draw(st.sampled_from([[0], [0, 0, 0, 90], [0, 100, 252]])), np.uint8)
    for x, y in product(range(1, 3 * size, size), repeat=2):
        costmap[y : y + size - 1, x : x + size - 1] = rng.choice(costs, (size - 1, size - 1))
        along, wide = rng.integers(0, size - 1), rng.integers(1, 3)
        if x > 1 and rng.random() < 0.6:
            costmap[y + along : min(y + along + wide, y + size - 1), x - 1] = rng.choice(costs)
        if y > 1 and rng.random() < 0.6:
            costmap[y - 1, x + along : min(x + along + wide, x + size - 1)] = rng.choice(costs)
    return costmap


def cell_of(data: st.DataObject, costmap: NDArray[np.uint8]) -> Cell:
    height, width = costmap.shape
    return data.draw(st.integers(0, width - 1)), data.draw(st.integers(0, height - 1))
