"""Where numba keeps compiled kernels, when they are out of date, and how they are loaded without its compiler.

numba compiles a kernel anew when its own module has changed. But a kernel holds what it calls and the constants that it
uses, whichever module they come from: here, a change of any module that the kernel's module imports makes it compile
anew, too. numba finds this module by the name that `_arrays` gives it, before it looks for the first kernel.

The names of a kernel's files tell the sources, too. numba writes an index with their stamp first, then the code: under
one name for all sources, older code would count as up to date after a process that was killed in between.
"""

from __future__ import annotations

import gc
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Protocol

from numba.core import caching, environment
from numba.core.codegen import CPUCodeLibrary
from numba.core.runtime.nrt import rtsys

from fog_kernels.sources import digest_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from numba.core.base import BaseContext
    from numba.core.typing.templates import Signature

_PACKAGE: Final = Path(__file__).parent
_CHOICES: Final[tuple[Any, ...]] = (
    caching.UserProvidedCacheLocator,
    caching.InTreeCacheLocator,
    caching.UserWideCacheLocator,
)
"""numba's own, in its order."""


class _Locator(Protocol):
    """What numba asks for the place of one kernel."""

    def ensure_cache_path(self) -> None: ...
    def get_cache_path(self) -> str: ...
    def get_disambiguator(self) -> str: ...


class KernelLocator:
    """numba's own place for a kernel, with a stamp of all of the kernel's sources."""

    def __init__(self, own: _Locator, file: Path) -> None:
        """`own`: the locator that numba would choose."""
        self._own = own
        self._py_file = str(file)  # numba names it in its warnings

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> KernelLocator | None:
        """Return the locator of a function of this package; None for another's, which numba locates by itself."""
        file = Path(py_file)
        if file.parent != _PACKAGE or not file.exists():
            return None
        own = next((found for choice in _CHOICES if (found := choice.from_function(py_func, py_file))), None)
        return None if own is None else cls(own, file)

    def ensure_cache_path(self) -> None:
        """Make the folder; raises `OSError` if it can't be written."""
        self._own.ensure_cache_path()

    def get_cache_path(self) -> str:
        """Return the folder of the compiled kernels."""
        return self._own.get_cache_path()

    def get_source_stamp(self) -> bytes:
        """Return what must be the same for a compiled kernel to be used."""
        return digest_of(Path(self._py_file))

    def get_disambiguator(self) -> str:
        """Return what tells kernels of one name apart, and those of other sources: a part of their files' names."""
        return f"{self._own.get_disambiguator()}-{_sources_tag(Path(self._py_file))}"


def remove_outdated(file: Path, folder: Path) -> None:
    """Remove the kernels of the module in `file` from numba's `folder` that were compiled from other sources than now.

    Raises `OSError` if the folder can't be written.
    """
    current = f"-{_sources_tag(file)}."
    for found in folder.glob(f"{file.stem}.*.nb[ic]*"):  # indices and code, also halves of them that a kill left
        if current not in found.name:
            found.unlink(missing_ok=True)  # another process may remove it at the same time


def _sources_tag(file: Path) -> str:
    return digest_of(file).hex()[:12]


def _load_overload(self: caching.FunctionCache, sig: Signature, target_context: BaseContext) -> object:
    """As `numba.core.caching.Cache.load_overload`, but that only the runtime of kernels (their memory) is prepared.

    numba imports the implementations of all functions that kernels may call (60 modules) whenever it looks for a
    compiled kernel. A kernel that is found contains what it calls: the modules cost some 0.1 s and 8 MB for nothing.
    Where a kernel is not found, compiling it imports them.
    """
    rtsys.initialize(target_context)
    with self._guard_against_spurious_io_errors():
        return self._load_overload(sig, target_context)  # type: ignore[no-untyped-call]  # numba has no types


setattr(caching.FunctionCache, "load_overload", _load_overload)  # noqa: B010  # numba has no setting for it


def release_bitcode() -> None:
    """Free the bitcode of all loaded kernels, 9 MB in a planner; call it once, when every module has been imported.

    Only a new kernel that calls one of them would need it: it can't be compiled in this process any more. Each kernel
    is compiled, or found in the cache, when its module is imported.
    """
    for library in gc.get_objects():
        if isinstance(library, CPUCodeLibrary):
            setattr(library, "_shared_module", None)  # noqa: B010  # numba keeps it for ever


_rebuild_with_its_module: Final[Callable[..., object]] = environment._rebuild_env  # noqa: SLF001  # numba has no setting for it


def _rebuild_env(module: str, constants: list[object], name: str) -> object:
    """As numba's, for the environment of what a compiled kernel calls; but numba's own modules are not imported for it.

    Only Python's object mode, which no kernel uses, reads the globals of an environment. With `numba.np.arraymath`,
    which loads SciPy's linear algebra, a process took 0.25 s and 24 MB more.
    """
    known = environment.Environment._memo  # noqa: SLF001  # as numba's does
    if name in known or not module.startswith("numba.") or module in sys.modules:
        return _rebuild_with_its_module(module, constants, name)
    made = environment.Environment({"__name__": module})
    made.consts[:] = constants
    made.env_name = name
    known[name] = made
    return made


setattr(environment, "_rebuild_env", _rebuild_env)  # noqa: B010  # compiled kernels name it: it is looked up there
