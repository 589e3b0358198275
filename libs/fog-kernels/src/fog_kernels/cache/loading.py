"""Loads compiled kernels without the parts of numba that only compilation needs.

numba imports the implementations of all functions that kernels may call (60 modules) whenever it looks for a compiled
kernel. A kernel that is found contains what it calls: the modules cost some 0.1 s and 8 MB for nothing. Where a kernel
is not found, compiling it imports them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from numba.core import caching
from numba.core.runtime.nrt import rtsys

if TYPE_CHECKING:
    from numba.core.base import BaseContext
    from numba.core.typing.templates import Signature


def load_without_compiler() -> None:
    """Let all kernels of this process be loaded so; call it before the first one is loaded."""
    setattr(caching.FunctionCache, "load_overload", _load_overload)  # noqa: B010  # numba has no setting for it


def _load_overload(self: caching.FunctionCache, sig: Signature, target_context: BaseContext) -> object:
    """As `numba.core.caching.Cache.load_overload`, but that only the runtime of kernels (their memory) is prepared."""
    rtsys.initialize(target_context)
    with self._guard_against_spurious_io_errors():
        return self._load_overload(sig, target_context)  # type: ignore[no-untyped-call]  # numba has no types
