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


def walls(shown) -> set[tuple[int, int]]:
    """Return the walls' cells, by their place in a grid of 0.1 m whose corner is the origin."""
    rows, columns = np.nonzero(shown.cells == LETHAL)
    left, bottom = round(shown.geometry.origin_x / 0.1), round(shown.geometry.origin_y / 0.1)
    return set(zip((rows + bottom).tolist(), (columns + left).tolist(), strict=True))
