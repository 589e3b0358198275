"""Numba types and argument checks that the kernels' wrappers share; errors name the argument and the remedy."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import types
from numba.core import config

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

# Before any kernel is compiled: each one's module imports this one first. numba's settings are no declared names.
vars(config)["CACHE_LOCATOR_CLASSES"] = (
    "fog_kernels.cache.KernelLocator,UserProvidedCacheLocator,InTreeCacheLocator,UserWideCacheLocator,"
    "IPythonCacheLocator,ZipCacheLocator"
)

# Inputs are declared read-only, so that arrays made by np.frombuffer fit as well as writable ones.
U8_GRID = types.Array(types.uint8, 2, "C", readonly=True)
U8_FLAT = types.Array(types.uint8, 1, "C", readonly=True)
I32_FLAT = types.Array(types.int32, 1, "C", readonly=True)
I32_PAIRS = types.Array(types.int32, 2, "C", readonly=True)
F32_FLAT = types.Array(types.float32, 1, "C", readonly=True)
F64_FLAT = types.Array(types.float64, 1, "C", readonly=True)
F32_GRID = types.Array(types.float32, 2, "C", readonly=True)
F64_GRID = types.Array(types.float64, 2, "C", readonly=True)

U8_GRID_OUT = types.Array(types.uint8, 2, "C")
I32_GRID_OUT = types.Array(types.int32, 2, "C")
F64_GRID_OUT = types.Array(types.float64, 2, "C")
F32_GRID_OUT = types.Array(types.float32, 2, "C")
I32_OUT = types.Array(types.int32, 1, "C")
I64_OUT = types.Array(types.int64, 1, "C")
U64_OUT = types.Array(types.uint64, 1, "C")
F32_OUT = types.Array(types.float32, 1, "C")
F64_OUT = types.Array(types.float64, 1, "C")


def grid(array: NDArray[Any], name: str) -> NDArray[np.uint8]:
    """Return a C-ordered (h, w) uint8 or bool grid as uint8 without copying; raise TypeError or ValueError else."""
    if array.dtype == np.bool_:
        array = array.view(np.uint8)
    if array.dtype != np.uint8:
        raise TypeError(f"{name} must be uint8 or bool, not {array.dtype}: convert it where it is created")
    if array.ndim != 2 or array.size == 0:
        raise ValueError(f"{name} must have shape (height, width) and cells, not {array.shape}")
    if not array.flags.c_contiguous:
        raise ValueError(f"{name} must be C-ordered: pass np.ascontiguousarray of the view")
    return array


def exact(array: NDArray[Any], dtype: type[np.generic], ndim: int, name: str) -> None:
    """Raise TypeError or ValueError unless the array has this dtype, this many axes and C order."""
    if array.dtype != dtype:
        raise TypeError(f"{name} must be {np.dtype(dtype)}, not {array.dtype}: convert it where it is created")
    if array.ndim != ndim:
        raise ValueError(f"{name} must have {ndim} axes, not shape {array.shape}")
    if not array.flags.c_contiguous:
        raise ValueError(f"{name} must be C-ordered: pass np.ascontiguousarray of the view")


def vector(values: ArrayLike, name: str) -> NDArray[np.float64]:
    """Return values as a C-ordered float64 vector; raise ValueError if it has other than one axis."""
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.ndim != 1:
        raise ValueError(f"{name} must be a vector, not of shape {array.shape}")
    return array


def positive(value: float, name: str) -> float:
    """Return the value as float; raise ValueError unless it is finite and above zero."""
    number = float(value)
    if not (math.isfinite(number) and number > 0.0):
        raise ValueError(f"{name} must be above zero, not {value}")
    return number
