"""Support for tests with and without the compiler: numbers of examples, skipped tests, guarded arrays.

With NUMBA_DISABLE_JIT=1 kernels run as plain Python: coverage sees their lines, numpy warns of overflowing integers,
and an index beyond an array's end raises instead of reading foreign memory. They are a hundred times slower then.
"""

from __future__ import annotations

import functools
import inspect
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from numba import config

if TYPE_CHECKING:
    from collections.abc import Callable
    from types import ModuleType

COMPILED = not config.DISABLE_JIT

compiled_only = pytest.mark.skipif(not COMPILED, reason="too slow without the compiler; smaller tests run these lines")


def examples(count: int) -> int:
    """Return the number of examples: fewer without the compiler."""
    return count if COMPILED else max(count // 20, 5)


class Guarded(np.ndarray):
    """An array that refuses negative indices: kernels compute their indices, so a negative one is a bug."""

    def __getitem__(self, index: Any) -> Any:
        refuse_negative(index)
        return super().__getitem__(index)

    def __setitem__(self, index: Any, value: Any) -> None:
        refuse_negative(index)
        super().__setitem__(index, value)


def refuse_negative(index: Any) -> None:
    for part in index if isinstance(index, tuple) else (index,):
        if isinstance(part, int | np.integer) and part < 0:
            raise IndexError(f"negative index {index}: in a kernel it would read a cell at the other end")


def guarded(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return the function with its array arguments guarded; they keep their memory."""

    @functools.wraps(function)
    def call(*arguments: Any) -> Any:
        views = (one.view(Guarded) if isinstance(one, np.ndarray) else one for one in arguments)
        result = function(*views)
        return result.view(np.ndarray) if isinstance(result, Guarded) else result

    return call


def guard_kernels(module: ModuleType) -> None:
    """Guard the arrays that a module's wrappers pass to its kernels; has an effect only without the compiler."""
    for name, function in list(vars(module).items()):
        if name.startswith("_") and inspect.isfunction(function) and function.__module__ == module.__name__:
            setattr(module, name, guarded(function))
