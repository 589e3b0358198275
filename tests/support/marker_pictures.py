"""Pictures of markers as a pinhole camera on a robot takes them, rendered ray by ray."""

from __future__ import annotations

import ctypes
import math
from functools import lru_cache

import numpy as np
import pyapriltags
from pyapriltags.apriltags import _ImageU8

WALL, FLOOR = 150, 90
SAMPLES = 3
"""Rays along each side of a pixel."""


@lru_cache
def pattern(marker):
    """Return the picture of a marker, a byte for each of its 10 x 10 squares, the white rim included."""
    detector = pyapriltags.Detector(families="tag36h11")
    draw = detector.libc.apriltag_to_image
    draw.argtypes, draw.restype = [ctypes.c_void_p, ctypes.c_uint32], ctypes.POINTER(_ImageU8)
    drawn = draw(detector.tag_families["tag36h11"], marker).contents
    pixels = np.ctypeslib.as_array(drawn.buf, (drawn.height, drawn.stride))
    return pixels[:, : drawn.width].copy()


def picture(pose, markers, camera, height=0.0, noise=3.0, seed=0):
    """Return what a camera sees from a robot's pose (x, y, theta): grey (height, width), uint8.

    height: how much higher than the camera the markers hang (m).
    """
    x, y, theta = pose
    eye = (
        x + camera.x_m * math.cos(theta) - camera.y_m * math.sin(theta),
        y + camera.x_m * math.sin(theta) + camera.y_m * math.cos(theta),
    )
    heading = theta + camera.yaw_rad
    fine = SAMPLES * np.array((camera.width_px, camera.height_px))
    columns, rows = ((np.arange(count) + 0.5) / SAMPLES - 0.5 for count in fine)
    centre = camera.centre_px or ((camera.width_px - 1) / 2, (camera.height_px - 1) / 2)
    right, down = np.meshgrid((columns - centre[0]) / camera.focal_px, (rows - centre[1]) / camera.focal_px)
    squares = right**2 + down**2
    k1, k2 = camera.distortion
    for _ in range(8 if (k1, k2) != (0.0, 0.0) else 0):
        squares = (right**2 + down**2) / (1 + squares * (k1 + k2 * squares)) ** 2
    right, down = (each / (1 + squares * (k1 + k2 * squares)) for each in (right, down))
    ahead = math.cos(camera.pitch_rad) + math.sin(camera.pitch_rad) * down
    up = math.sin(camera.pitch_rad) - math.cos(camera.pitch_rad) * down
    dx, dy = (
        math.cos(heading) * ahead + math.sin(heading) * right,
        math.sin(heading) * ahead - math.cos(heading) * right,
    )
    grey = np.where(up > -0.2, WALL, FLOOR).astype(np.float64)
    nearest = np.full(grey.shape, np.inf)
    for marker in markers:
        nx, ny = math.cos(marker.theta), math.sin(marker.theta)
        facing = dx * nx + dy * ny
        with np.errstate(divide="ignore", invalid="ignore"):
            far = ((marker.x - eye[0]) * nx + (marker.y - eye[1]) * ny) / facing
            aside = -(eye[0] + far * dx - marker.x) * ny + (eye[1] + far * dy - marker.y) * nx
            above = far * up - height
        drawn = pattern(marker.id)
        square = marker.size / 8
        hit = (facing < 0) & (far > 0) & (far < nearest)
        hit &= (np.abs(aside) < 5 * square) & (np.abs(above) < 5 * square)
        column, row = 5 + aside[hit] / square, 5 - above[hit] / square
        grey[hit] = 20 + 0.85 * drawn[np.clip(row.astype(int), 0, 9), np.clip(column.astype(int), 0, 9)]
        nearest[hit] = far[hit]
    grey = grey.reshape(camera.height_px, SAMPLES, camera.width_px, SAMPLES).mean(axis=(1, 3))
    grey += noise * np.random.default_rng(seed).standard_normal(grey.shape)
    return np.clip(grey, 0, 255).astype(np.uint8)


def pgm(grey):
    """Return a picture as a binary PGM."""
    return b"P5\n%d %d\n255\n" % (grey.shape[1], grey.shape[0]) + grey.tobytes()
