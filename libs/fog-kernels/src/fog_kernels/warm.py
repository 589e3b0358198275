"""Compile every kernel into numba's cache, so that no process compiles at start: `python -m fog_kernels.warm`.

Run it on the machine, and as the user, that will use the cache: the cache is valid for one CPU name and one version of
numba, and lies beside the sources or, where these can't be written, in NUMBA_CACHE_DIR or the user's cache folder.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import importlib.util
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from numba.core import event
from numba.core.dispatcher import Dispatcher

from fog_kernels.cache import remove_outdated

if TYPE_CHECKING:
    from collections.abc import Callable

PROFILES: dict[str, tuple[str, ...]] = {
    "robot": (
        "amcl",
        "astar",
        "clearance",
        "course",
        "distance",
        "dwa",
        "flood",
        "guides",
        "inflation",
        "lidar",
        "lines",
        "raycast",
        "scans",
        "sweep",
    ),
    "planner": (
        "astar",
        "components",
        "course",
        "dead_ends",
        "detour",
        "distance",
        "flood",
        "guides",
        "inflation",
        "lines",
        "tiles",
    ),
    "map": ("components", "distance", "inflation", "raycast"),
    "sim": ("distance", "emulation", "raycast"),
    "mapping": ("matching",),
    "all": (
        "amcl",
        "astar",
        "clearance",
        "components",
        "course",
        "dead_ends",
        "detour",
        "distance",
        "dwa",
        "emulation",
        "flood",
        "guides",
        "inflation",
        "lidar",
        "lines",
        "matching",
        "raycast",
        "scans",
        "sweep",
        "tiles",
    ),
}


def _dispatchers() -> list[Dispatcher]:
    found = {}
    for name, module in list(sys.modules.items()):
        if name.startswith("fog_kernels."):
            for value in list(vars(module).values()):
                if isinstance(value, Dispatcher):
                    found[id(value)] = value
    return list(found.values())


def kernels(module: str) -> list[str]:
    """Return the kernels that importing a module of this package compiles: those with explicit signatures.

    Reads only the source. Raises ValueError for a module that does not exist.
    """
    spec = importlib.util.find_spec(f"fog_kernels.{module}")
    if spec is None or spec.origin is None:
        raise ValueError(f"there is no module fog_kernels.{module}")
    tree = ast.parse(Path(spec.origin).read_text("utf-8"))
    return [
        node.name
        for node in tree.body
        if isinstance(node, ast.FunctionDef)
        and any(
            isinstance(decorator, ast.Call)
            and isinstance(decorator.func, ast.Name)
            and decorator.func.id == "njit"
            and decorator.args
            for decorator in node.decorator_list
        )
    ]


class _Compiled(event.Listener):
    """Counts the kernels of one module as they are compiled; those that come from the cache raise no event."""

    def __init__(self, names: list[str], on_kernel: Callable[[int, str], None]) -> None:
        self._remaining = set(names)
        self._total = len(names)
        self._on_kernel = on_kernel

    def on_start(self, _: event.Event) -> None:
        """Ignore the start of a compilation."""

    def on_end(self, ended: event.Event) -> None:
        """Count a kernel once, whatever the number of its signatures."""
        name = ended.data["dispatcher"].py_func.__name__
        if name in self._remaining:
            self._remaining.remove(name)
            self._on_kernel(self._total - len(self._remaining), name)


def warm(profile: str = "all", on_progress: Callable[[int, int, str], None] = lambda *_: None) -> None:
    """Compile, or load from the cache, every kernel that the profile's processes use.

    All signatures are explicit, so importing a module compiles it. Kernels of these modules that were compiled from
    older sources are removed. `on_progress` is called with the number of kernels that are ready, their total number,
    and the name of the kernel compiled or module loaded last. Raises ValueError for an unknown profile.
    """
    if profile not in PROFILES:
        raise ValueError(f"profile must be one of {', '.join(sorted(PROFILES))}, not {profile!r}")
    names = {module: kernels(module) for module in PROFILES[profile]}
    total = sum(map(len, names.values()))
    ready = 0
    for module, module_kernels in names.items():
        before = ready
        listener = _Compiled(module_kernels, lambda done, name: on_progress(before + done, total, f"{module}.{name}"))  # noqa: B023  # called in this pass only
        with event.install_listener("numba:compile", listener):
            importlib.import_module(f"fog_kernels.{module}")
        _remove_outdated(f"fog_kernels.{module}")
        ready += len(module_kernels)
        on_progress(ready, total, module)


def _remove_outdated(module: str) -> None:
    own = [each for each in _dispatchers() if each.py_func.__module__ == module]
    for file, folder in {(each.py_func.__code__.co_filename, each.stats.cache_path) for each in own}:
        if folder is not None:  # a helper that is compiled into its callers only
            remove_outdated(Path(file), Path(folder))


def cache_misses() -> int:
    """Return how many kernels of the imported modules were compiled in this process instead of loaded."""
    return sum(sum(dispatcher.stats.cache_misses.values()) for dispatcher in _dispatchers())


def main() -> None:
    """Compile a profile's kernels; print the progress and how many were not in the cache."""
    parser = argparse.ArgumentParser(prog="python -m fog_kernels.warm", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("profile", nargs="?", default="all", choices=sorted(PROFILES))
    profile: str = parser.parse_args().profile

    def show(ready: int, total: int, name: str) -> None:
        sys.stdout.write(f"{ready} of {total} kernels ready: {name}\n")
        sys.stdout.flush()

    warm(profile, show)
    sys.stdout.write(f"{profile}: {len(_dispatchers())} kernels and helpers ready, {cache_misses()} compiled now\n")


if __name__ == "__main__":
    main()
