"""Compile every kernel into numba's cache, so that no process compiles at start: `python -m fog_kernels.warm`.

Run it on the machine, and as the user, that will use the cache: the cache is valid for one CPU name and one version of
numba, and lies beside the sources or, where these can't be written, in NUMBA_CACHE_DIR or the user's cache folder.
"""

from __future__ import annotations

import argparse
import importlib
import sys

from numba.core.dispatcher import Dispatcher

PROFILES: dict[str, tuple[str, ...]] = {
    "robot": ("amcl", "astar", "distance", "dwa", "inflation", "likelihood", "raycast"),
    "planner": ("astar", "distance", "inflation"),
    "map": ("distance", "inflation"),
    "sim": ("distance", "raycast"),
    "all": ("amcl", "astar", "distance", "dwa", "inflation", "likelihood", "raycast"),
}


def _dispatchers() -> list[Dispatcher]:
    found = {}
    for name, module in list(sys.modules.items()):
        if name.startswith("fog_kernels."):
            for value in list(vars(module).values()):
                if isinstance(value, Dispatcher):
                    found[id(value)] = value
    return list(found.values())


def warm(profile: str = "all") -> None:
    """Compile, or load from the cache, every kernel that the profile's processes use.

    All signatures are explicit, so importing a module is what compiles it. Raises ValueError for an unknown profile.
    """
    if profile not in PROFILES:
        raise ValueError(f"profile must be one of {', '.join(sorted(PROFILES))}, not {profile!r}")
    for name in PROFILES[profile]:
        importlib.import_module(f"fog_kernels.{name}")


def cache_misses() -> int:
    """Return how many kernels of the imported modules were compiled in this process instead of loaded."""
    return sum(sum(dispatcher.stats.cache_misses.values()) for dispatcher in _dispatchers())


def main() -> None:
    """Warm a profile and say how many kernels had to be compiled."""
    parser = argparse.ArgumentParser(prog="python -m fog_kernels.warm", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("profile", nargs="?", default="all", choices=sorted(PROFILES))
    profile: str = parser.parse_args().profile
    warm(profile)
    sys.stdout.write(f"{profile}: {len(_dispatchers())} kernels and helpers ready, {cache_misses()} compiled now\n")


if __name__ == "__main__":
    main()
