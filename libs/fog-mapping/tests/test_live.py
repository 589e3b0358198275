"""A map that grows while the robot drives."""

from __future__ import annotations

import numpy as np

from fog_contracts.costs import LETHAL
from fog_kernels.raycast import cast
from fog_mapping.building import draw
from fog_mapping.live import LiveMap
from fog_mapping.scans import keep_moved, scan_of
from fog_mapping.trajectory import WINDOW, match_in_order

ANGLES = np.linspace(-np.pi, np.pi, 360, endpoint=False)


def scans_round_a_corner():
    """A drive of 14 m through an L of corridors, with odometry that turns 2 % too far."""
    solid = np.ones((400, 400), np.uint8)
    solid[40:80, 40:360] = 0
    solid[40:360, 320:360] = 0
    solid[80:84, 100:120] = 0
    solid[120:140, 316:320] = 0
    way = [(3.0 + 0.1 * step, 3.0, 0.0) for step in range(135)]
    way += [(16.5, 3.0, angle) for angle in np.arange(0.1, 1.55, 0.1)]
    way += [(16.5, 3.0 + 0.1 * step, np.pi / 2) for step in range(60)]
    noise = np.random.default_rng(5)
    scans = []
    for number, (x, y, theta) in enumerate(way):
        ranges = cast(solid, 0.05, 0.0, 0.0, x, y, ANGLES + theta, 12.0) + 0.01 * noise.standard_normal(len(ANGLES))
        scans.append(scan_of(number, ANGLES, ranges, (x, y, 1.02 * theta), 12.0))
    return scans


def test_the_growing_map_has_the_poses_and_walls_of_the_same_scans_matched_at_once():
    scans, live = scans_round_a_corner(), LiveMap()
    kept = keep_moved(scans)
    poses, _ = match_in_order(kept)
    seen = [live.pose for scan in scans if live.add(scan)]
    assert np.allclose(seen, poses)
    whole = draw(zip(poses, [scan.points for scan in kept], strict=True), 0.1)
    grown = live.map()
    assert walls(grown) == walls(whole)
    assert grown.cells.size < 4_000_000


def test_it_keeps_no_more_scans_than_it_matches():
    live = LiveMap()
    for scan in scans_round_a_corner():
        live.add(scan)
    assert live.scans > 5 * WINDOW
    assert len(live._recent) == len(live._poses) == WINDOW


def along_a_corridor(live, until: float):
    """Let the map grow along a corridor of 2 m by 123 m with niches, up to `until` (m); return it."""
    solid = np.ones((80, 2500), np.uint8)
    solid[30:50, 20:2480] = 0
    for column in range(60, 2460, 70):
        solid[50:54, column : column + 20] = 0
    for number, x in enumerate(np.arange(3.0, until, 0.8)):
        ranges = cast(solid, 0.05, 0.0, 0.0, x, 2.0, ANGLES, 12.0)
        live.add(scan_of(number, ANGLES, ranges, (x, 2.0, 0.0), 12.0))
    return live.map()


def test_a_long_corridor_is_drawn_to_its_end():
    """It grew on all sides at once, and stopped after 90 m; the film of a finer map after 40."""
    grown = along_a_corridor(LiveMap(0.05), 120.0)
    assert grown.cells.size < 4_000_000
    drawn = np.flatnonzero((grown.cells == LETHAL).any(axis=0))
    assert np.ptp(drawn) * 0.05 > 115.0


def test_a_scan_that_leaves_the_largest_map_is_drawn_as_far_as_it_lies_within(monkeypatch):
    monkeypatch.setattr("fog_mapping.live._MOST_CELLS", 40_000)
    grown = along_a_corridor(LiveMap(), 40.0)
    assert grown.cells.size <= 40_000
    drawn = np.flatnonzero((grown.cells == LETHAL).any(axis=0))
    assert drawn[-1] == grown.cells.shape[1] - 1, "up to its edge"


def walls(shown) -> set[tuple[int, int]]:
    """Return the walls' cells, by their place in a grid of 0.1 m whose corner is the origin."""
    rows, columns = np.nonzero(shown.cells == LETHAL)
    left, bottom = round(shown.geometry.origin_x / 0.1), round(shown.geometry.origin_y / 0.1)
    return set(zip((rows + bottom).tolist(), (columns + left).tolist(), strict=True))
