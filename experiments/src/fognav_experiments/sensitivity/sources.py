"""A digest of the sources that a drive in lockstep runs: two machines with the same one drive the same."""

from __future__ import annotations

import hashlib
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Final

_PACKAGES: Final = (
    "fog_contracts", "fog_kernels", "fog_runtime", "fog_supervisor", "fognav_experiments", "fognav_sim",
    "hazard_aggregator", "map_service", "planner", "robot_agent",
)  # fmt: skip


@cache
def digest() -> str:
    """Return a hash of all modules of Fognav that a drive can import, as they are installed here."""
    found = hashlib.sha256()
    for package in _PACKAGES:
        spec = find_spec(package)
        if spec is None or spec.submodule_search_locations is None:
            raise RuntimeError(f"the package {package} is not installed: install fognav-experiments again")
        for place in map(Path, spec.submodule_search_locations):
            for file in sorted(place.rglob("*.py")):
                found.update(f"{package}/{file.relative_to(place)}".encode() + b"\0" + file.read_bytes() + b"\0")
    return found.hexdigest()[:16]
