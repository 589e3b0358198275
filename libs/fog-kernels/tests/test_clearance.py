"""Distances around the robot, discs that cover its outline, and the promise that both keep: no arc comes too near."""

from __future__ import annotations

import math

import numpy as np
import pytest
from compiler import compiled_only, examples
from hypothesis import given, settings
from hypothesis import strategies as st

from fog_contracts.costs import DEFAULT_INFLATION, Inflation
from fog_kernels.clearance import NEAR, clearance
from fog_kernels.dwa import DwaLimits, DwaSettings, dwa
from fog_kernels.robot import Body, cover

LIMITS = DwaLimits(axle=0.235, wheel_max=0.5)
SETTINGS = DwaSettings()
ROUND = [(0.17 * math.cos(a), 0.17 * math.sin(a)) for a in np.arange(64) * math.tau / 64]
LONG = [(0.25, -0.15), (0.25, 0.15), (-0.12, 0.15), (-0.12, -0.15)]
WEDGE = [(0.3, 0.0), (-0.1, 0.2), (-0.2, 0.1), (-0.2, -0.1), (-0.1, -0.2)]
RESOLUTION = 0.05
SIDE = 60
ORIGIN = (-1.0, 2.0)
seeds = st.integers(0, 2**32 - 1)


def world(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return a costmap with blocks of lethal cells, and points of a lidar; the robot stands near its middle."""
    cost = np.zeros((SIDE, SIDE), np.uint8)
    for _ in range(int(rng.integers(0, 6))):
        row, column = rng.integers(0, SIDE - 4, 2)
        cost[row : row + rng.integers(1, 5), column : column + rng.integers(1, 5)] = 254
    points = rng.uniform(0.6, 2.4, (int(rng.integers(0, 12)), 2)) + ORIGIN
    return cost, points


def distances(cost: np.ndarray, points: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the exact distance (m) from each place to the nearest lethal square or point."""
    rows, columns = np.nonzero(cost == 254)
    centres = np.column_stack((columns, rows)) * RESOLUTION + RESOLUTION / 2 + ORIGIN
    nearest = np.full(np.shape(x), math.inf)
    for half, things in ((RESOLUTION / 2, centres), (0.0, points)):
        for thing in things:
            off = np.hypot(np.maximum(np.abs(x - thing[0]) - half, 0.0), np.maximum(np.abs(y - thing[1]) - half, 0.0))
            nearest = np.minimum(nearest, off)
    return nearest


def around(cost, points, x, y, body):
    return clearance(cost, RESOLUTION, *ORIGIN, points, x, y, body, DEFAULT_INFLATION, LIMITS, SETTINGS)


@settings(max_examples=examples(60), deadline=None)
@given(seeds, st.sampled_from([ROUND, LONG]))
def test_distances_are_exact_at_the_centres_of_cells(seed, outline):
    rng = np.random.default_rng(seed)
    cost, points = world(rng)
    x, y = rng.uniform(0.2, 2.8, 2) + ORIGIN
    found = around(cost, points, x, y, cover(outline))
    size = found.distance.shape[0]
    places = (np.arange(size) + 0.5) * found.resolution
    xs, ys = np.meshgrid(found.origin_x + places, found.origin_y + places)
    cap = float(found.distance.max())
    expected = distances(cost, points, xs, ys)
    assert found.distance == pytest.approx(np.minimum(expected, max(cap, 0.55)), abs=1e-5)


def test_places_are_graded_by_distance_and_the_map_decides():
    cost = np.zeros((SIDE, SIDE), np.uint8)
    cost[30, 39], cost[24, 24], cost[25, 25], cost[36, 24] = 254, 255, 253, 200
    found = around(cost, [], ORIGIN[0] + 1.5, ORIGIN[1] + 1.5, cover(ROUND))

    def at(column, row):
        x, y = ORIGIN[0] + (column + 0.4) * RESOLUTION, ORIGIN[1] + (row + 0.4) * RESOLUTION
        i, j = round((x - found.origin_x) / 0.025 - 0.5), round((y - found.origin_y) / 0.025 - 0.5)
        return int(found.cost[j, i])

    assert (at(24, 24), at(25, 25), at(24, 36)) == (255, 253, 200)
    assert at(22, 30) == 0
    graded = [at(column, 30) for column in range(30, 40)]
    assert graded == sorted(graded)
    assert 0 < graded[0] < NEAR - 20
    assert (graded[-2], graded[-1]) == (253, 254)


def test_cell_beyond_the_map_is_unknown():
    found = around(np.zeros((SIDE, SIDE), np.uint8), [], ORIGIN[0] + 0.1, ORIGIN[1] + 1.5, cover(ROUND))
    assert found.cost[:, 0].tolist() == [255] * len(found.cost)


def test_steeper_inflation_gives_lower_costs_at_a_distance():
    cost, robot = np.zeros((SIDE, SIDE), np.uint8), (ORIGIN[0] + 1.5, ORIGIN[1] + 1.5)
    near = [(robot[0] + 0.3, robot[1])]
    flat, steep = (
        clearance(
            cost, RESOLUTION, *ORIGIN, near, *robot, cover(ROUND),
            Inflation(inscribed_radius=0.17, inflation_radius=0.5, cost_scaling=scaling), LIMITS, SETTINGS,
        ).cost.astype(int)
        for scaling in (2.0, 8.0)
    )  # fmt: skip
    assert (steep <= flat).all()
    assert steep.sum() < flat.sum()


@given(st.sampled_from([LONG, WEDGE]), st.integers(0, 10_000))
def test_discs_cover_the_outline_and_stick_out_of_it_little(outline, place):
    body = cover(outline)
    ring = np.array([*outline, outline[0]])
    lengths = np.hypot(*np.diff(ring, axis=0).T)
    along = place / 10_000 * lengths.sum()
    point = np.array([np.interp(along, np.concatenate(([0.0], np.cumsum(lengths))), ring[:, i]) for i in (0, 1)])
    assert (np.hypot(*(body.discs[:, :2] - point).T) <= body.discs[:, 2] + 1e-9).any()
    outside = [-signed_inside(outline, disc[:2]) + disc[2] for disc in body.discs]
    assert max(outside) < (0.035 if outline is WEDGE else 0.0081)


def signed_inside(outline, point) -> float:
    """Return how deep (m) a point lies inside a convex outline."""
    ring = np.array([*outline, outline[0]])
    edges = np.diff(ring, axis=0)
    offsets = np.asarray(point) - ring[:-1]
    return float(((edges[:, 0] * offsets[:, 1] - edges[:, 1] * offsets[:, 0]) / np.hypot(*edges.T)).min())


def test_round_outline_is_one_disc_and_an_open_one_is_refused():
    assert len(cover(ROUND).discs) == 0
    with pytest.raises(ValueError, match="between the wheels"):
        cover([(1.0, 0.0), (2.0, 0.0), (2.0, 1.0)])
    with pytest.raises(ValueError, match="three vertices"):
        cover([(1.0, 0.0), (2.0, 0.0)])


def things(cost: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the points, and points every centimetre on the sides of the lethal squares."""
    rows, columns = np.nonzero(cost == 254)
    corners = np.column_stack((columns, rows)) * RESOLUTION + ORIGIN
    side = np.linspace(0.0, RESOLUTION, 6)
    ring = [(a, b) for a in side for b in (0.0, RESOLUTION)] + [(b, a) for a in side for b in (0.0, RESOLUTION)]
    return np.vstack((points, (corners[:, None, :] + np.array(ring)).reshape(-1, 2)))


def keeps(outline, known: np.ndarray, pose) -> float:
    """Return the distance (m) from the body at a pose to the nearest of the points; negative when one is inside it."""
    x, y, theta = pose
    turn = np.array([[math.cos(theta), -math.sin(theta)], [math.sin(theta), math.cos(theta)]])
    seen = (known - (x, y)) @ turn
    seen = seen[np.hypot(*seen.T) < 0.6]
    if not len(seen):
        return 0.3
    ring = np.array([*outline, outline[0]])
    begins, edges = ring[:-1], np.diff(ring, axis=0)
    squares = (edges**2).sum(axis=1)
    offsets = seen[:, None, :] - begins
    share = np.clip((offsets * edges).sum(axis=2) / squares, 0.0, 1.0)
    away = np.hypot(*np.moveaxis(offsets - share[:, :, None] * edges, 2, 0)).min(axis=1)
    depth = ((edges[:, 0] * offsets[:, :, 1] - edges[:, 1] * offsets[:, :, 0]) / np.sqrt(squares)).min(axis=1)
    return float(np.where(depth > 0.0, -depth, away).min())


@compiled_only
@settings(max_examples=150, deadline=None)
@given(seeds, st.sampled_from([ROUND, LONG]), st.booleans())
def test_body_swept_along_the_commanded_arc_keeps_its_padding(seed, outline, narrow):
    """The whole arc until the horizon, not only the period; a body that starts too near comes no nearer.

    "Nearer" is judged by a lower bound of the distance, which is low by up to 2.5 mm for a round body, and by up to
    14 mm for another, whose discs stick out of it.
    """
    rng = np.random.default_rng(seed)
    cost, points = world(rng)
    x, y = rng.uniform(1.0, 2.0, 2) + ORIGIN
    theta = rng.uniform(-3.0, 3.0)
    if narrow:  # something beside or ahead of the body, a few centimetres away
        bearing, off = rng.uniform(-3.0, 3.0), rng.uniform(0.165, 0.30)
        points = np.vstack((points, (x + off * math.cos(bearing), y + off * math.sin(bearing))))
    body: Body = cover(outline)
    found = around(cost, points, x, y, body)
    goal = (x + rng.uniform(0.5, 1.0) * math.cos(theta), y + rng.uniform(0.5, 1.0) * math.sin(theta))
    chosen = dwa(rng.uniform(0.0, 0.3), rng.uniform(-1.0, 1.0), x, y, theta, found, [], *goal, None, body, LIMITS)
    if (chosen.v, chosen.w) == (0.0, 0.0):
        return
    known = things(cost, points)
    at_start = keeps(outline, known, (x, y, theta))
    if len(body.discs) and at_start < 0.0:
        return  # discs cover the outline, and can't tell how deep something lies inside it
    promised = min(SETTINGS.padding, at_start - (0.014 if len(body.discs) else 0.0025))
    for time in np.arange(0.0, 1.5, 0.02):
        turned = theta + chosen.w * time
        chord = chosen.v * time * np.sinc(chosen.w * time / math.tau)
        middle = theta + 0.5 * chosen.w * time
        pose = (x + chord * math.cos(middle), y + chord * math.sin(middle), turned)
        assert keeps(outline, known, pose) >= promised - 0.0005
