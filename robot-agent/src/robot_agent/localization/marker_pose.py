"""From the corners of a marker in a picture to a sighting: its pose seen from the robot, and how certain that is. Pure.

Markers hang upright on upright walls, and the camera looks level or up by a known angle: four numbers of a marker are
unknown, its place and the direction of its face. They are fitted to the corners by least squares (Gauss and Newton). A
face that is turned a little to the left looks nearly like one that is turned to the right (Collins and Bartoli 2014):
both are fitted, and the direction is as uncertain as they differ while the corners do not tell them apart.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final, NamedTuple

import numpy as np

from robot_agent.localization.markers import Sighting
from robot_agent.localization.pose import Pose2, wrap

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import NDArray

    from fog_contracts.robot import CameraSettings

_CORNER_SIGMA_PX: Final = 0.5
"""Standard deviation of a corner: a detector finds it to 0.3 px in a sharp picture, and a robot that turns blurs it."""
_MISFIT_PX: Final = 3.0
"""Corners that are farther (px, rms) from every upright square are none, or that of another size or camera."""
_AMBIGUOUS: Final = 9.0
"""The corners decide between two directions of the face if one fits worse by so much (chi squared)."""
_MOUNTING: Final = (0.01, 0.01, 0.02)
"""Standard deviations of what the settings say: of the place (m, and of 1 by the distance) and the direction (rad)."""
_TURNED_RAD: Final = 0.7
_ROUNDS: Final = 12
_CONVERGED: Final = 1e-4
"""Changes (m, rad) that are a fiftieth of what a corner's noise makes."""
_STEP: Final = 1e-5
_DAMPING: Final = 1e-6
_TURN_MAX_RAD: Final = 0.3
"""A round turns the face by no more than this: a longer step may leave for the other minimum."""
_NEAREST_M: Final = 0.05
_UNDISTORTION_ROUNDS: Final = 8


class _Fit(NamedTuple):
    """Place (x ahead, y left, z up; m) and direction of the face (rad), seen from the camera; how well they fit."""

    values: NDArray[np.float64]
    covariance: NDArray[np.float64]
    chi2: float


def sighting_of(
    marker: int, corners: NDArray[np.float64], size: float, camera: CameraSettings, stamp: float
) -> Sighting | None:
    """Return the sighting of a marker with a side of `size` (m); None if its corners are those of no upright square.

    corners: (4, 2) px, right and down, counter-clockwise as one sees them. stamp: when the picture was taken (s).
    """
    rays = _rays(corners, camera)
    # From the lower left on, however the marker is turned on its wall.
    lower = int(np.argmax(rays[:, 1] + np.roll(rays[:, 1], -1)))
    rays = np.roll(rays, -lower, axis=0)
    sigma = _CORNER_SIGMA_PX / camera.focal_px

    def residuals(values: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray((projected(values, size, camera.pitch_rad) - rays).ravel() / sigma)

    height = 0.5 * abs(rays[0, 1] + rays[1, 1] - rays[2, 1] - rays[3, 1])
    if not height > 0.0:
        return None
    ahead = size / height
    x, y, z = _levelled(ahead * np.array((rays[:, 0].mean(), rays[:, 1].mean())), ahead, camera.pitch_rad)
    facing = math.atan2(-y, -x)
    begins = (np.array((x, y, z, facing + side * _TURNED_RAD)) for side in (1.0, -1.0))
    fits = sorted((fit for begin in begins if (fit := _fitted(residuals, begin))), key=lambda fit: fit.chi2)
    if not fits or math.sqrt(fits[0].chi2 / 4.0) * _CORNER_SIGMA_PX > _MISFIT_PX:
        return None
    return _in_base(marker, fits, camera, stamp)


def projected(values: NDArray[np.float64], size: float, pitch: float) -> NDArray[np.float64]:
    """Return where a camera sees the corners of a marker, as tangents to the right and down (4, 2).

    values: place (x ahead, y to the left, z up; m) and direction of the face (rad) from the levelled camera.
    """
    x, y, z, theta = values
    half = 0.5 * size
    aside = half * np.array((-1.0, 1.0, 1.0, -1.0))
    xs, ys = x - aside * math.sin(theta), y + aside * math.cos(theta)
    zs = z + half * np.array((-1.0, -1.0, 1.0, 1.0))
    depth = np.maximum(math.cos(pitch) * xs + math.sin(pitch) * zs, 1e-3)
    up = math.cos(pitch) * zs - math.sin(pitch) * xs
    return np.column_stack((-ys / depth, -up / depth))


def _rays(corners: NDArray[np.float64], camera: CameraSettings) -> NDArray[np.float64]:
    """Return the tangents (n, 2), to the right and down, of points (n, 2; px) of a picture, without the distortion."""
    centre = camera.centre_px or (0.5 * (camera.width_px - 1), 0.5 * (camera.height_px - 1))
    seen = (np.asarray(corners, np.float64) - np.array(centre)) / camera.focal_px
    k1, k2 = camera.distortion
    rays = seen
    for _ in range(_UNDISTORTION_ROUNDS if (k1, k2) != (0.0, 0.0) else 0):
        squares = (rays**2).sum(axis=1, keepdims=True)
        rays = seen / (1.0 + squares * (k1 + k2 * squares))
    return np.asarray(rays)


def _levelled(aside: NDArray[np.float64], depth: float, pitch: float) -> tuple[float, float, float]:
    right, down = aside.tolist()
    cos, sin = math.cos(pitch), math.sin(pitch)
    return cos * depth + sin * down, -right, sin * depth - cos * down


def _fitted(
    residuals: Callable[[NDArray[np.float64]], NDArray[np.float64]], values: NDArray[np.float64]
) -> _Fit | None:
    """Return the minimum from some values on; None for one behind the camera, or that nothing determines."""
    for _ in range(_ROUNDS):
        jacobian = _jacobian(residuals, values)
        information = jacobian.T @ jacobian
        try:
            change = np.linalg.solve(
                information + _DAMPING * np.diag(np.diag(information)), jacobian.T @ residuals(values)
            )
        except np.linalg.LinAlgError:
            return None
        change[3] = min(max(change[3], -_TURN_MAX_RAD), _TURN_MAX_RAD)
        values = values - change
        if not np.isfinite(values).all() or values[0] < _NEAREST_M:
            return None
        if np.abs(change).max() < _CONVERGED:
            break
    jacobian, errors = _jacobian(residuals, values), residuals(values)
    covariance = np.linalg.pinv(jacobian.T @ jacobian, hermitian=True).astype(np.float64)
    return _Fit(values, covariance, float(errors @ errors))


def _jacobian(
    residuals: Callable[[NDArray[np.float64]], NDArray[np.float64]], values: NDArray[np.float64]
) -> NDArray[np.float64]:
    steps = _STEP * np.eye(4)
    columns = [(residuals(values + step) - residuals(values - step)) / (2.0 * _STEP) for step in steps]
    return np.column_stack(columns)


def _in_base(marker: int, fits: list[_Fit], camera: CameraSettings, stamp: float) -> Sighting:
    """Return the sighting in the robot's frame, by the best fit and how far the others differ."""
    best = fits[0]
    x, y, _, theta = best.values.tolist()
    chosen = np.ix_((0, 1, 3), (0, 1, 3))
    covariance = best.covariance[chosen].copy()
    for other in fits[1:]:
        if other.chi2 - best.chi2 < _AMBIGUOUS:
            covariance[2, 2] += wrap(other.values[3] - theta) ** 2
    cos, sin = math.cos(camera.yaw_rad), math.sin(camera.yaw_rad)
    turn = np.array(((cos, -sin, 0.0), (sin, cos, 0.0), (0.0, 0.0, 1.0)))
    place, share, angle = _MOUNTING
    mounting = np.diag(np.square((place + share * math.hypot(x, y),) * 2 + (angle,)))
    pose = Pose2(camera.x_m, camera.y_m, camera.yaw_rad).compose(Pose2(x, y, theta))
    return Sighting(marker, pose, turn @ covariance @ turn.T + mounting, stamp)
