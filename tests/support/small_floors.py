"""Small maps drawn of rectangles, for tests of what is done with maps."""

import json
import math

import numpy as np
from scipy import ndimage

from fog_contracts.costs import FREE, LETHAL, UNKNOWN
from fog_contracts.grid import GridGeometry, StaticMap
from fog_kernels.raycast import cast
from fog_mapping.poses import between, compose

Box = tuple[float, float, float, float]


def floor(*free: Box, boxes: tuple[Box, ...] = ()) -> StaticMap:
    """Return a map of 15 x 10 m with free rectangles (left, bottom, right, top; m), boxes in them, walls of 0.2 m."""
    open_ = np.zeros((200, 300), bool)
    for rectangles, value in ((free, True), (boxes, False)):
        for left, bottom, right, top in rectangles:
            open_[round(bottom * 20) : round(top * 20), round(left * 20) : round(right * 20)] = value
    near = ndimage.binary_dilation(open_, np.ones((9, 9), bool))
    cells = np.where(open_, FREE, np.where(near, LETHAL, UNKNOWN)).astype(np.uint8)
    return StaticMap(GridGeometry(300, 200, 0.05, 0.0, 0.0), cells)


ROOMS: tuple[Box, ...] = (
    (1, 1, 14, 3), (1, 1, 3, 9), (4, 3.2, 7, 6), (5, 2.8, 6, 3.4), (8, 4, 13, 9), (9, 2.8, 10, 4.2),
)  # fmt: skip
OFFICE = floor(*ROOMS)


def log_of_drive(
    static: StaticMap,
    corners: list[tuple[float, float]],
    seed: int,
    person: tuple[float, float, float, float] | None = None,
) -> list[str]:
    """Return the JSON lines of a log of a drive along corners: 240 beams around of 8 m, an odometry that is off.

    person: walks from one point to another and back while the robot drives (x, y, x, y; m), 0.3 m wide.
    """
    rng = np.random.default_rng(seed)
    solid, beams = (static.cells != FREE).astype(np.uint8), np.radians(np.arange(240) * 1.5 - 180.0)
    truth = [np.array((*corners[0], math.atan2(corners[1][1] - corners[0][1], corners[1][0] - corners[0][0])))]
    for corner in corners[1:]:
        while math.dist(truth[-1][:2], corner) > 0.2:
            x, y, theta = truth[-1]
            turn = math.remainder(math.atan2(corner[1] - y, corner[0] - x) - theta, math.tau)
            step = (0.0, 0.0, max(-0.3, min(0.3, turn))) if abs(turn) > 0.05 else (0.25, 0.0, turn)
            truth.append(compose(truth[-1], np.array(step)))
    odometry, lines = np.zeros(3), [json.dumps({"meta": "simulated", "fov_deg": 360})]
    for number, pose in enumerate(truth):
        if number:
            step = between(truth[number - 1], pose)
            odometry = compose(odometry, step * (1.03, 1.0, 1.02) + rng.standard_normal(3) * (0.004, 0.0, 0.004))
        world = solid
        if person is not None:
            share = abs(math.remainder(number / 20.0, 2.0))
            x, y = (person[k] + share * (person[k + 2] - person[k]) for k in (0, 1))
            world = solid.copy()
            world[round(y * 20) - 3 : round(y * 20) + 3, round(x * 20) - 3 : round(x * 20) + 3] = 1
        ranges = cast(world, 0.05, 0.0, 0.0, pose[0], pose[1], beams + pose[2], 8.0)
        ranges = ranges + 0.01 * rng.standard_normal(len(beams))
        values = [round(float(value), 4) if math.isfinite(value) and value < 8.0 else None for value in ranges]
        lines.append(json.dumps({"t": 0.2 * number, "odom": odometry.tolist(), "ranges": values}))
    return lines
