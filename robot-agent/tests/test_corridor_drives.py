"""The whole agent along plain corridors in which its lidar sees two walls and nothing else, with wrong encoders.

What a robot then believes of how far it is must be right, or it must stand. `FOGNAV_CORRIDOR_GRID=FILE` drives the
whole grid of lengths, widths, errors and seeds besides its worst cells, and adds a line to the file for each cell that
it lacks yet; `python test_corridor_drives.py FILE` sums the file up.
"""

from __future__ import annotations

import itertools
import json
import os
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from little_world import LittleWorld

from fog_contracts import channels as ch
from fog_contracts.messages import PolygonShape, Pose, Zone, ZoneSet

BEGIN, SOUTH = 2.5, 4.0
LIDAR_M = 12.0
RADIUS = 0.17
WORST_M = 1.5
"""How far a robot that drives may be from where it believes to be."""
EXCUSED_M = 1.2
"""From this product of blind length and error of the encoders on, a robot may stand instead of arriving."""
RECORDED_NOISE = 0.034
"""By how much (m) Intel's wheels were off after a metre at random, besides counting too far."""
GRID = os.environ.get("FOGNAV_CORRIDOR_GRID", "")


class Cell(NamedTuple):
    """A drive: the corridor (m), the encoders' error (share), and what was changed since the map was made.

    doors: share of the doors that stand open. glass: of the windows, "" has none. zone: a no-go zone from and to (m).
    recorded: wheels are as unsteady as recorded ones, and each 3 m of the map's walls are up to 5 cm off. carpet: the
    encoders' error from there (m) on.
    """

    length: float
    width: float
    encoders: float
    seed: int = 1
    doors: float = 0.0
    glass: str = ""
    furniture: int = 0
    goal: float | None = None
    zone: tuple[float, float] | None = None
    recorded: bool = False
    carpet: tuple[float, float] | None = None

    def world(self) -> LittleWorld:
        north = SOUTH + self.width
        world = LittleWorld(
            rooms=[(1.0, SOUTH, 1.0 + self.length, north)],
            size=(2.0 + self.length, self.width + 8.0),
            pose=(BEGIN, SOUTH + 0.5 * self.width, 0.0),
            wheel_error=self.encoders,
            seed=self.seed,
            lidar_noise=0.008,
            lidar_noise_share=0.0045,
            wheel_noise=RECORDED_NOISE if self.recorded else 0.0,
        )
        rng = np.random.default_rng(self.seed)

        def put(left, bottom, right, top, value):
            rows, columns = (
                slice(round(low / 0.05), round(high / 0.05)) for low, high in ((bottom, top), (left, right))
            )
            world.solid[rows, columns] = value

        for number, left in enumerate(np.arange(4.0, self.length - 1.5, 3.0)):
            room = (north, north + 2.5) if number % 2 else (SOUTH - 2.5, SOUTH)
            if rng.random() < self.doors:
                put(left, room[0], left + 0.9, room[1], 0)
            if self.glass == "behind" and number % 4 == 0:
                put(left + 1.0, room[0], left + 2.8, room[1], 0)
            elif self.glass == "nothing":
                world.glass.append((left + 1.0, north - 0.2, left + 2.8, north + 0.2))
        for left in rng.uniform(6.0, self.length - 4.0, self.furniture):
            put(left, north - 0.25, left + 0.6, north, 1)
        if self.recorded:
            for left in np.arange(1.0, self.length, 3.0):
                for wall, inwards in ((SOUTH, 0.05), (north, -0.05)):
                    off = int(rng.integers(-1, 2))
                    face = wall + off * inwards
                    put(left, min(wall, face), left + 3.0, max(wall, face), int(off > 0))
        return world

    @property
    def may_stand(self) -> bool:
        return abs(self.encoders) * max(0.0, self.length - 2.0 * LIDAR_M) >= EXCUSED_M


class Outcome(NamedTuple):
    """Errors and claimed deviations (n, 2; m; along, across) while it drove; m driven in the zone; s in each mode."""

    reached: bool
    reasons: list[str]
    errors: np.ndarray
    sigmas: np.ndarray
    in_zone: float
    collided: bool


def drive(cell: Cell) -> Outcome:
    world, middle = cell.world(), SOUTH + 0.5 * cell.width
    world.agent.load(world.master.snapshot(), world.now)
    world.run(0.6)
    # As an operator gives it: the end of the corridor behind the robot tells the rest.
    assert world.command("initial_pose", pose=Pose(x=BEGIN + 0.2, y=middle - 0.1, theta=0.05)).accepted
    world.run(3.0)
    assert world.command("enable").accepted
    if cell.zone is not None:
        left, right = cell.zone
        bottom, top = SOUTH - 0.2, SOUTH + cell.width + 0.2
        outline = [(left, bottom), (right, bottom), (right, top), (left, top)]
        zone = Zone(id="closed", kind="BLOCKED", shape=PolygonShape(points=outline))
        world.send(ch.ZONES, ZoneSet(epoch=7, seq=1, zones=[zone], active=["closed"]))
        world.block(left, bottom, right, top)
    world.drive_to([(BEGIN, middle), (cell.goal or cell.length - 0.5, middle)])
    errors, sigmas, in_zone, stands = [], [], 0.0, 0
    while not world.state().goal_reached and stands < 30 and world.travelled < cell.length + 5.0:
        before = world.travelled
        if cell.carpet is not None and world.x > cell.carpet[0]:
            world.wheel_error = cell.carpet[1]
        world.run(0.5, lambda w: w.state().goal_reached)
        moved = world.travelled - before
        stands = 0 if moved > 0.01 else stands + 1
        if moved > 0.01:
            pose, covariance = world.agent.pose(world.moment), world.agent.localizer.covariance()
            errors.append((pose.x - world.x, pose.y - world.y))
            sigmas.append(np.sqrt(np.diag(covariance)[:2]))
            if cell.zone is not None and cell.zone[0] - RADIUS < world.x < cell.zone[1] + RADIUS:
                in_zone += moved
    state = world.state()
    return Outcome(state.goal_reached, state.reasons, np.array(errors), np.array(sigmas), in_zone, world.collided)


WORST = [
    Cell(100.0, 1.2, 0.05),
    Cell(100.0, 1.2, 0.0),
    Cell(100.0, 2.0, -0.1, 2),
    Cell(80.0, 1.2, 0.1),
    Cell(40.0, 1.2, -0.05, 2, doors=1.0),
    Cell(40.0, 2.0, 0.02, 2, doors=0.5, furniture=8),
    Cell(40.0, 2.0, -0.05, 2, glass="nothing"),
    Cell(40.0, 2.0, 0.05, 2, glass="behind"),
    Cell(60.0, 1.2, -0.03, goal=43.0, zone=(46.0, 52.0)),
]


@pytest.mark.timeout(900)
@pytest.mark.parametrize("cell", WORST, ids=str)
@pytest.mark.drive
def test_robot_in_a_plain_corridor_arrives_and_is_never_far_from_where_it_believes_to_be(cell):
    outcome = drive(cell)
    assert outcome.reached or (cell.may_stand and "the robot may be" in outcome.reasons[0]), outcome.reasons
    assert np.abs(outcome.errors[:, 0]).max() < WORST_M
    assert np.abs(outcome.errors[:, 1]).max() < 0.1
    assert outcome.in_zone == 0.0
    assert not outcome.collided
    assert (np.abs(outcome.errors) <= 3.5 * outcome.sigmas + 0.05).all()


def grid():
    lengths, widths, errors = (
        (20.0, 40.0, 60.0, 80.0, 100.0), (1.2, 2.0, 3.0), (0.0, 0.02, -0.02, 0.05, -0.05, 0.1, -0.1)
    )  # fmt: skip
    cells = [Cell(*drawn) for drawn in itertools.product(lengths, widths, errors, (1, 2, 3))]
    recorded = [Cell(length, 2.0, error, recorded=True) for length, error in itertools.product(lengths, errors)]
    return sorted(cells + recorded, key=lambda cell: cell.seed)


def driven_cells():
    lines = Path(GRID).read_text(encoding="utf-8").splitlines() if Path(GRID).is_file() else []
    return {record["cell"]: record for record in map(json.loads, lines)}


@pytest.mark.timeout(0)
@pytest.mark.skipif(not GRID, reason="an hour: set FOGNAV_CORRIDOR_GRID=FILE")
@pytest.mark.parametrize("cell", grid(), ids=str)
def test_whole_grid_of_corridors(cell):
    record = driven_cells().get(str(cell))
    if record is None:
        outcome = drive(cell)
        squares = np.square(outcome.errors)
        record = {
            "cell": str(cell), "reached": outcome.reached, "reasons": outcome.reasons, "collided": outcome.collided,
            "count": len(squares), "worst": float(np.sqrt(squares[:, 0].max())),
            "errors": squares.sum(axis=0).tolist(), "sigmas": np.square(outcome.sigmas).sum(axis=0).tolist(),
            "within": (squares <= 4.0 * np.square(outcome.sigmas)).sum(axis=0).tolist(),
        }  # fmt: skip
        with Path(GRID).open("a", encoding="utf-8") as file:
            file.write(json.dumps(record) + "\n")
    assert record["worst"] < WORST_M
    assert not record["collided"]
    assert record["reached"] or cell.may_stand or cell.recorded, record["reasons"]


@pytest.mark.timeout(900)
@pytest.mark.parametrize(("resolution", "share"), [(0.05, 0.015), (0.1, 0.004)])
@pytest.mark.drive
def test_robot_in_a_wide_hall_or_on_a_coarse_map_is_not_slowed_down_while_its_pose_is_right(resolution, share):
    world = LittleWorld(
        rooms=[(1, 1, 23, 17), (4, 17, 6, 18)], size=(24.0, 19.0), pose=(4.0, 4.0, 0.0), resolution=resolution,
        lidar_noise=0.0, lidar_noise_share=share,
    )  # fmt: skip
    world.ready()
    world.drive_to([(4.0, 4.0), (20.0, 4.0), (20.0, 14.0), (4.0, 14.0)])
    modes = []
    while not world.state().goal_reached and world.travelled < 60.0:
        world.run(0.5, lambda w: w.state().goal_reached)
        modes.append(world.state().mode)
        assert world.error()[0] < 0.1
    assert world.state().goal_reached
    assert modes.count("DEGRADED") <= 0.02 * len(modes)


def print_figures(records, name):
    count = sum(record["count"] for record in records)
    within, errors, sigmas = (
        np.sum([record[key] for record in records], axis=0) / count for key in ("within", "errors", "sigmas")
    )
    stood = sum(not record["reached"] for record in records)
    worst = max(record["worst"] for record in records)
    print(  # noqa: T201  # what it is for
        f"{name}: {len(records)} cells, {stood} stood, {worst:.2f} m wrong at worst; along, across: "
        f"{within} within two deviations, rms {np.sqrt(errors)} m, deviation by rms {np.sqrt(sigmas / errors)}"
    )


if __name__ == "__main__":
    GRID = sys.argv[1]
    for flag in (False, True):
        chosen = [record for record in driven_cells().values() if f"recorded={flag}" in record["cell"]]
        if chosen:
            print_figures(chosen, "recorded wheels and walls" if flag else "exact map, steady wheels")
