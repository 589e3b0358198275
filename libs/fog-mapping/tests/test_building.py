"""Maps of simulated buildings: walls where they are, loops that are true, none that folds a corridor, nobody in it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import ndimage

from fog_contracts.costs import FREE, LETHAL
from fog_kernels.distance import squared_distance_capped
from fog_kernels.raycast import cast
from fog_mapping.building import draw, find_trajectory
from fog_mapping.loops import LoopSearch
from fog_mapping.poses import between, compose, place
from fog_mapping.relations import absolute_error, relation_errors, scans_fit
from fog_mapping.scans import Scan, keep_moved, scan_of
from fog_mapping.trajectory import _AROUND, _Cells, match_in_order, refuse_mirrored

CELL = 0.05
BEAMS = np.radians(np.arange(240) * 1.5 - 180.0)
RANGE_M = 8.0


class Building:
    """Rectangles (left, bottom, right, top; m) of free space, and boxes in it."""

    def __init__(self, rooms: list[tuple[float, ...]], boxes: list[tuple[float, ...]]) -> None:
        right, top = (max(room[k] for room in rooms) + 1.0 for k in (2, 3))
        self.solid = np.ones((round(top / CELL), round(right / CELL)), np.uint8)
        for value, rectangles in ((0, rooms), (1, boxes)):
            for left, bottom, end, upper in rectangles:
                self.solid[self.cells(bottom, upper), self.cells(left, end)] = value

    @staticmethod
    def cells(start: float, end: float) -> slice:
        return slice(round(start / CELL), round(end / CELL))

    def drive(
        self, corners: list[tuple[float, float]], seed: int, scale: float = 1.05, people: float = 0.0
    ) -> tuple[list[Scan], np.ndarray]:
        """Return scans along corners with an odometry that is off, and the true poses of those that are used.

        scale: of the odometry's ways; people: share of the scans in which somebody stands 1.5 m before the robot.
        """
        rng = np.random.default_rng(seed)
        truth = [np.array((*corners[0], math.atan2(corners[1][1] - corners[0][1], corners[1][0] - corners[0][0])))]
        for corner in corners[1:]:
            while math.dist(truth[-1][:2], corner) > 0.2:
                x, y, theta = truth[-1]
                turn = math.remainder(math.atan2(corner[1] - y, corner[0] - x) - theta, math.tau)
                step = (0.0, 0.0, max(-0.3, min(0.3, turn))) if abs(turn) > 0.05 else (0.25, 0.0, turn)
                truth.append(compose(truth[-1], np.array(step)))
        odometry, scans = np.zeros(3), []
        for number, pose in enumerate(truth):
            if number:
                step = between(truth[number - 1], pose)
                noise = rng.standard_normal(2) * (0.02 * step[0], 0.004 + 0.03 * abs(step[2]))
                odometry = compose(odometry, step * (scale, 1.0, 1.03) + (noise[0], 0.0, noise[1]))
            ranges = cast(self.solid, CELL, 0.0, 0.0, pose[0], pose[1], BEAMS + pose[2], RANGE_M)
            ranges = ranges + 0.01 * rng.standard_normal(len(BEAMS))
            ranges[~np.isfinite(ranges) | (rng.random(len(BEAMS)) < 0.03)] = np.nan
            if rng.random() < people:
                before = np.abs(BEAMS) < 0.1
                ranges[before] = np.fmin(ranges[before], 1.5)
            scan = scan_of(number, BEAMS, ranges, odometry, RANGE_M)
            if scan is not None:
                scans.append(scan)
        kept = keep_moved(scans)
        return kept, np.array([truth[scan.number] for scan in kept])


FLOOR = Building(
    [(1, 1, 19, 3), (1, 1, 3, 13), (1, 11, 19, 13), (17, 1, 19, 13), (3, 6, 17, 7.6), (5, 3, 8, 5), (12, 3, 15, 5.2),
     (6, 7.6, 10, 10)],
    [(4.0, 1.0, 4.4, 1.4), (9.0, 2.6, 9.8, 3.0), (2.7, 8, 3, 8.6), (13.5, 12.7, 14.6, 13), (17, 9, 17.3, 10),
     (11.2, 11, 11.5, 11.4), (12, 7.2, 12.8, 7.6)],
)  # fmt: skip
ROUND: list[tuple[float, float]] = [
    (2, 2), (18, 2), (18, 12), (2, 12), (2, 6.8), (16.5, 6.8), (18, 6.8), (18, 2), (2, 2), (2, 12), (17, 12),
]  # fmt: skip


@pytest.fixture(scope="module")
def mapped():
    scans, truth = FLOOR.drive(ROUND, seed=1)
    return scans, truth, find_trajectory(scans, jobs=2)


def drawn(scans: list[Scan], poses: np.ndarray, truth: np.ndarray, value: int) -> np.ndarray:
    """Return the centres of the map's cells with a value, laid on the building as the whole way fits best.

    The map lies as its first scan does, some thousandths of a radian off: that is not in its walls.
    """
    built = draw(((pose, scan.points) for pose, scan in zip(poses, scans, strict=True)), CELL)
    found, true = poses[:, :2] @ (1.0, 1.0j), truth[:, :2] @ (1.0, 1.0j)
    turn = np.angle(np.vdot(found - found.mean(), true - true.mean()))
    shift = true.mean() - np.exp(1.0j * turn) * found.mean()
    origin = np.array((shift.real, shift.imag, turn))
    return place(origin, built.geometry.centres(np.argwhere(built.cells == value)[:, ::-1].astype(np.int64)))


@pytest.mark.drive
def test_walls_are_where_they_are_in_the_building(mapped):
    scans, truth, found = mapped
    solid = FLOOR.solid
    inner = np.all([np.roll(solid, shift, axis) for shift in (1, -1) for axis in (0, 1)], axis=0)
    away = np.sqrt(squared_distance_capped(solid & ~inner, 40)) * CELL

    def at(field: np.ndarray, value: int) -> np.ndarray:
        cells = np.floor(drawn(scans, found.poses, truth, value) / CELL).astype(int)
        cells = cells.clip(0, np.array(solid.shape[::-1]) - 1)
        return field[cells[:, 1], cells[:, 0]]

    walls = at(away, LETHAL)
    assert len(walls) > 1500
    assert (walls <= 0.05).mean() > 0.95
    assert (at(solid, FREE) == 0).mean() > 0.99


@pytest.mark.drive
def test_loops_are_found_all_true_and_join_what_odometry_tore_apart(mapped):
    scans, truth, found = mapped
    odometry = np.array([scan.odometry for scan in scans])
    assert absolute_error(odometry, truth) > 1.0
    assert absolute_error(found.poses, truth) < 0.05
    assert relation_errors(found.poses, truth)["loops"].translation_m < 0.05
    assert sum(weight > 0.5 for _, weight in found.loops) > 10
    for loop, weight in found.loops:
        if weight > 0.5:
            assert math.dist(truth[loop.first][:2], truth[loop.second][:2]) < 6.0


@pytest.mark.drive
def test_loops_mend_a_break_of_the_odometry_that_says_nothing_of_five_metres(mapped):
    """Of them the odometry knows nothing, and along a corridor the scans before and after them fit each other, too."""
    scans, truth, _ = mapped
    begin, end = 150, 170
    assert math.dist(truth[begin - 1][:2], truth[end][:2]) > 5.0
    moved = [
        scan._replace(
            odometry=compose(scans[begin - 1].odometry, between(scans[end].odometry, scan.odometry)), stretch=1
        )
        for scan in scans[end:]
    ]
    found = find_trajectory([*scans[:begin], *moved], jobs=2)
    assert absolute_error(found.poses, np.concatenate((truth[:begin], truth[end:]))) < 0.05


@pytest.mark.drive
def test_map_is_the_same_however_many_threads_make_it(mapped):
    scans, _, found = mapped
    again = find_trajectory(scans, jobs=1)
    assert (again.poses == found.poses).all()
    assert again.loops == found.loops


@pytest.mark.parametrize(
    "share", [pytest.param(0.05, marks=pytest.mark.drive), pytest.param(0.1, marks=pytest.mark.drive), 0.2]
)
@pytest.mark.drive
def test_wrong_loops_among_those_found_change_the_map_by_less_than_a_cell(mapped, monkeypatch, share):
    """Of the matches that each round finds, so many more are wrong: of places that are 2 to 6 m from each other."""
    scans, truth, found = mapped
    rng, wrong, search = np.random.default_rng(7), [], LoopSearch.search

    def deceived(self, *given, **named):
        result = search(self, *given, **named)
        for i in rng.choice(len(result.edges), math.ceil(share * len(result.edges)), replace=False):
            away = rng.uniform(2.0, 6.0) * np.array((math.cos(i), math.sin(i)))
            edge = result.edges[i]
            result.edges.append(edge._replace(step=np.add(edge.step, (*away, rng.uniform(-0.5, 0.5)))))
            result.loops.append(result.loops[i]._replace(score=-1.0))
            wrong.append(i)
        return result

    monkeypatch.setattr(LoopSearch, "search", deceived)
    again = find_trajectory(scans, jobs=2)
    assert len(wrong) >= share * sum(loop.score > 0.0 for loop, _ in again.loops)
    assert max(weight for loop, weight in again.loops if loop.score < 0.0) < 0.05
    assert min(weight for loop, weight in again.loops if loop.score > 0.0) > 0.25
    assert np.abs(again.poses - found.poses)[:, :2].max() < CELL
    assert absolute_error(again.poses, truth) < 0.05


@pytest.mark.drive
@pytest.mark.timeout(600)
@pytest.mark.parametrize("drives", [3, pytest.param(10, marks=pytest.mark.long)])
def test_drives_with_other_noise_join_the_same_places_and_rooms(drives):
    """The topology: no loop is false, all visits of a place agree, and the same rooms are reached from the start."""
    maps = []
    for seed in range(drives):
        scans, truth = FLOOR.drive([*ROUND[:4], ROUND[0], (10, 2)], seed=20 + seed)
        found = find_trajectory(scans, jobs=2)
        free = drawn(scans, found.poses, truth, FREE)
        cells = np.floor(free / 0.2).astype(int)
        grid = np.zeros(cells.max(axis=0) + 1, bool)
        grid[tuple(cells[(cells >= 0).all(axis=1)].T)] = True
        labels, _ = ndimage.label(grid)
        rooms = ((2, 2), (18, 2), (18, 12), (2, 12), (6, 4), (13, 4))
        spots = [labels[int(x / 0.2), int(y / 0.2)] for x, y in rooms]
        maps.append([spot == spots[0] != 0 for spot in spots])
        joined = [loop for loop, weight in found.loops if weight > 0.5]
        assert joined, seed
        assert all(math.dist(truth[loop.first][:2], truth[loop.second][:2]) < 6.0 for loop in joined), seed
        assert relation_errors(found.poses, truth)["loops"].translation_m < 0.05, seed
    assert all(reached == maps[0] for reached in maps), maps
    assert all(maps[0]), "every room of the floor is open to the corridor"


@pytest.mark.drive
def test_loop_that_is_refused_is_not_closed(mapped):
    scans, truth, found = mapped
    refused = [(loop.first, loop.second) for loop, _ in found.loops]
    without = find_trajectory(scans, without=refused)
    assert without.loops == []
    assert absolute_error(without.poses, truth) < 0.5, "what is left is the way that scans tell one by one"


@pytest.mark.drive
@pytest.mark.parametrize("scale", [0.85, 1.15])
def test_odometry_that_is_15_percent_off_still_makes_the_map(scale):
    scans, truth = FLOOR.drive(ROUND, seed=2, scale=scale)
    found = find_trajectory(scans, jobs=2)
    assert absolute_error(found.poses, truth) < 0.08


@pytest.mark.drive
def test_corridor_without_features_is_neither_folded_nor_shortened():
    hall = Building([(1, 1, 41, 3), (1, 3, 4, 5), (37, 3, 41, 5)], [])
    scans, truth = hall.drive([(2, 2), (40, 2), (39, 4), (40, 2), (3, 2), (2.5, 4), (2, 2), (30, 2)], seed=3)
    found = find_trajectory(scans, jobs=2)
    odometry = np.array([scan.odometry for scan in scans])
    assert absolute_error(odometry, truth) > 1.0
    assert absolute_error(found.poses, truth) < 0.5
    # Nothing along it tells how long it is: odometry says so, which is 5 % long.
    assert 0.98 < np.ptp(found.poses[:, 0]) / np.ptp(truth[:, 0]) < 1.06


def test_a_step_along_a_corridor_is_certain_across_and_not_along_however_the_first_scan_lay():
    scans, _ = Building([(1, 1, 31, 3)], []).drive([(12, 1.4), (12, 2.0), (19, 2.0)], seed=3)
    _, edges = match_in_order(scans)
    along, across = np.array([(edge.information[0, 0], edge.information[1, 1]) for edge in edges[-25:]]).T
    assert (across > 10.0 * along).all()


def test_lidar_on_its_head_is_noticed_and_one_that_stands_right_is_not():
    scans, _ = FLOOR.drive(ROUND[:5], seed=5)
    refuse_mirrored(scans)
    flipped = [
        scan._replace(points=scan.points[::-1] * (1, -1), normals=scan.normals[::-1] * (1, -1)) for scan in scans
    ]
    with pytest.raises(ValueError, match="The lidar stands on its head: mirror its angles"):
        find_trajectory(flipped)


def test_people_who_walk_by_leave_no_walls():
    scans, truth = FLOOR.drive([(2.0, 2.0), (18.0, 2.0), (2.0, 2.0)], seed=4, people=0.3)
    found = find_trajectory(scans)
    occupied = drawn(scans, found.poses, truth, LETHAL)
    middle = (np.abs(occupied[:, 1] - 2.0) < 0.4) & (occupied[:, 0] > 5.0) & (occupied[:, 0] < 16.0)
    assert middle.sum() <= 3


def test_fewer_than_two_scans_are_refused_in_words():
    with pytest.raises(ValueError, match="two scans or more between which the robot has moved, not 0"):
        find_trajectory([])


def test_scan_that_shows_little_is_left_out_and_one_without_odometry_refused():
    assert scan_of(3, BEAMS, np.full(len(BEAMS), np.nan), (0.0, 0.0, 0.0), RANGE_M) is None
    with pytest.raises(ValueError, match="scan 3: the odometry must be x, y and theta, finite"):
        scan_of(3, BEAMS, np.full(len(BEAMS), 1.0), (0.0, math.nan, 0.0), RANGE_M)


def test_scans_lie_on_each_other_best_where_they_were_taken_and_tell_how_far_off_a_reference_is():
    scans, truth = FLOOR.drive(ROUND[:3], seed=1)
    off = truth + np.random.default_rng(1).normal(0.0, (0.03, 0.03, 0.01), truth.shape)
    true, wrong = scans_fit(scans, truth, off)
    assert true.residual_m < 0.02 < wrong.residual_m
    assert true.off_m < 0.015
    assert 0.03 < wrong.off_m < 0.08
    assert true.off_deg < 0.3 < wrong.off_deg


def test_the_scans_around_one_are_the_nearest_of_all_wherever_they_have_moved():
    rng = np.random.default_rng(1)
    poses = np.column_stack((rng.normal(0.0, 3.0, (400, 2)), np.zeros(400)))
    cells = _Cells(poses)
    for i in rng.integers(0, 400, 300).tolist():
        away = np.hypot(*(poses[:, :2] - poses[i, :2]).T)
        nearest = [j for j in np.argsort(away, kind="stable")[:_AROUND].tolist() if away[j] < 4.0 and j != i]
        assert cells.nearest(i) == nearest
        poses[i, :2] += rng.normal(0.0, 0.5, 2)
        cells.moved(i)
