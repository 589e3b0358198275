"""A lidar's measurements from bytes to metres, a batch in a few calls, twenty times a second.

Each call of numpy costs a small computer more than the hundred values that it works on here.
"""

# Kernels take arrays and scalars, typed by their compiled signatures.
# ruff: noqa: ANN401, PLR0913

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final, NamedTuple

import numpy as np
from numba import boolean, float64, int64, njit, types, void

from fog_kernels import _arrays

if TYPE_CHECKING:
    from numpy.typing import NDArray

NODE_BYTES: Final = 5
FULL_CIRCLE_Q6: Final = 360 * 64
_RAD_PER_Q6: Final = math.pi / (180.0 * 64.0)
_M_PER_Q2: Final = 0.00025

_U16_FLAT = types.Array(types.uint16, 1, "A", readonly=True)
_F64_ANY = types.Array(types.float64, 1, "A", readonly=True)
_U8_OUT = types.Array(types.uint8, 1, "C")
_U16_OUT = types.Array(types.uint16, 1, "C")
_BOOL_OUT = types.Array(boolean, 1, "C")


class DecodedNodes(NamedTuple):
    """The first n nodes of some bytes, up to the first one that is none.

    start: bool[n], first node of a scan. quality: uint8[n], 0..63. angle_q6: uint16[n], degrees / 64, clockwise,
    0..23039. distance_q2: uint16[n], millimetres / 4, 0 for no return.
    """

    start: NDArray[np.bool_]
    quality: NDArray[np.uint8]
    angle_q6: NDArray[np.uint16]
    distance_q2: NDArray[np.uint16]


class Batch(NamedTuple):
    """n measurements as the stop field takes them, and their times.

    times: float64[n], s. angles_rad: float32[n], counter-clockwise in (-pi, pi]. ranges_m: float32[n].
    """

    times: NDArray[np.float64]
    angles_rad: NDArray[np.float32]
    ranges_m: NDArray[np.float32]


@njit(int64(_arrays.U8_FLAT, _BOOL_OUT, _U8_OUT, _U16_OUT, _U16_OUT), cache=True, nogil=True)
def _decode_nodes(raw: Any, start: Any, quality: Any, angle_q6: Any, distance_q2: Any) -> int:
    """Return how many of the nodes are valid, up to the first that is not."""
    count: int = start.size
    for node in range(count):
        at = node * NODE_BYTES
        first, second = np.int64(raw[at]), np.int64(raw[at + 1])
        angle = (second >> 1) | (np.int64(raw[at + 2]) << 7)
        if ((first ^ (first >> 1)) & second & 1) == 0 or angle >= FULL_CIRCLE_Q6:
            return node
        start[node] = (first & 1) == 1
        quality[node] = first >> 2
        angle_q6[node] = angle
        distance_q2[node] = np.int64(raw[at + 3]) | (np.int64(raw[at + 4]) << 8)
    return count


@njit(void(_U16_FLAT, _U16_FLAT, _arrays.F64_OUT, _arrays.F64_OUT), cache=True, nogil=True)
def _in_metres(angle_q6: Any, distance_q2: Any, clockwise: Any, ranges: Any) -> None:
    for i in range(clockwise.size):
        clockwise[i] = angle_q6[i] * _RAD_PER_Q6
        ranges[i] = distance_q2[i] * _M_PER_Q2 if distance_q2[i] != 0 else math.nan


@njit(
    void(_F64_ANY, _F64_ANY, float64, float64, _arrays.F64_OUT, _arrays.F32_OUT, _arrays.F32_OUT),
    cache=True,
    nogil=True,
)
def _batch(clockwise: Any, ranges: Any, before: float, now: float, times: Any, angles: Any, ranges_m: Any) -> None:
    count = times.size
    for i in range(count):
        times[i] = before + (now - before) * (i + 1) / count
        angles[i] = (0.0 if clockwise[i] < math.pi else 2.0 * math.pi) - clockwise[i]
        ranges_m[i] = ranges[i]


def decode_nodes(data: bytes) -> DecodedNodes:
    """Return the 5-byte nodes at the beginning of `data`, up to the first invalid one or the last whole one.

    Lowest bit of byte 0: start of a scan, the next one: its inverse, then the quality; bytes 1 and 2, little-endian:
    a bit that is always 1, and the angle; bytes 3 and 4: the distance. Source: Slamtec, RPLIDAR interface protocol.
    """
    count = len(data) // NODE_BYTES
    start, quality = np.empty(count, np.bool_), np.empty(count, np.uint8)
    angle, distance = np.empty(count, np.uint16), np.empty(count, np.uint16)
    good = _decode_nodes(np.frombuffer(data, np.uint8), start, quality, angle, distance)
    if good < count:
        start, quality, angle, distance = start[:good], quality[:good], angle[:good], distance[:good]
    return DecodedNodes(start, quality, angle, distance)


def in_metres(
    angle_q6: NDArray[np.uint16], distance_q2: NDArray[np.uint16]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return clockwise angles (rad) and ranges (m; nan for a distance of 0) of n nodes, each float64[n].

    Raises TypeError or ValueError for other types, or arrays of different sizes.
    """
    _check(angle_q6, distance_q2, np.uint16)
    clockwise, ranges = np.empty(angle_q6.size), np.empty(angle_q6.size)
    _in_metres(angle_q6, distance_q2, clockwise, ranges)
    return clockwise, ranges


def batch(clockwise: NDArray[np.float64], ranges: NDArray[np.float64], before: float, now: float) -> Batch:
    """Return n measurements that arrived at `now` (s), after those that arrived at `before`: they came evenly.

    clockwise: float64[n], rad in [0, 2 pi). ranges: float64[n], m. Raises TypeError or ValueError for other types, or
    arrays of different sizes.
    """
    _check(clockwise, ranges, np.float64)
    count = clockwise.size
    made = Batch(np.empty(count), np.empty(count, np.float32), np.empty(count, np.float32))
    _batch(clockwise, ranges, before, now, *made)
    return made


def _check(one: NDArray[Any], other: NDArray[Any], dtype: type[np.generic]) -> None:
    if one.dtype != dtype or other.dtype != dtype:
        raise TypeError(f"both arrays must be {np.dtype(dtype)}, not {one.dtype} and {other.dtype}")
    if one.ndim != 1 or one.shape != other.shape:
        raise ValueError(f"both arrays must be vectors of one size, not of shapes {one.shape} and {other.shape}")
