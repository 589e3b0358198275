"""Poses (x, y in m, theta in rad) as arrays (..., 3): composed, seen from one another, and compared."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from fog_kernels.scans import out_of_frame

if TYPE_CHECKING:
    from numpy.typing import NDArray


def wrap(angle: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return angles in -pi..pi (rad)."""
    wrapped: NDArray[np.float64] = (angle + np.pi) % (2.0 * np.pi) - np.pi
    return wrapped


def compose(pose: NDArray[np.float64], step: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the poses that are `step` away, as seen from `pose`."""
    cos, sin = np.cos(pose[..., 2]), np.sin(pose[..., 2])
    return np.stack(
        (
            pose[..., 0] + cos * step[..., 0] - sin * step[..., 1],
            pose[..., 1] + sin * step[..., 0] + cos * step[..., 1],
            wrap(pose[..., 2] + step[..., 2]),
        ),
        axis=-1,
    )


def between(origin: NDArray[np.float64], pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return `pose` as seen from `origin`, so that composing both gives it back."""
    dx, dy = pose[..., 0] - origin[..., 0], pose[..., 1] - origin[..., 1]
    cos, sin = np.cos(origin[..., 2]), np.sin(origin[..., 2])
    return np.stack((cos * dx + sin * dy, -sin * dx + cos * dy, wrap(pose[..., 2] - origin[..., 2])), axis=-1)


def rotate(pose: NDArray[np.float64], vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return vectors (n, 2) that are given in the frame of a pose (3,) in the frame that the pose itself is in."""
    return out_of_frame(vectors, 0.0, 0.0, float(pose[2]))


def place(pose: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """As `rotate`, for points (n, 2; m)."""
    return out_of_frame(points, float(pose[0]), float(pose[1]), float(pose[2]))


def path_lengths(poses: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far (m) the robot has driven at each of its poses (n, 3)."""
    return np.concatenate(((0.0,), np.cumsum(np.hypot(*np.diff(poses[:, :2], axis=0).T))))


class Edge(NamedTuple):
    """`second` was measured at `step` (3,) as seen from `first`, with an information (3, 3); a loop may be wrong."""

    first: int
    second: int
    step: NDArray[np.float64]
    information: NDArray[np.float64]
    loop: bool = False
