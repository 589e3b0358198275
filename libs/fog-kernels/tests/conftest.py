"""Lets tests import modules of this folder, and guards the kernels' arrays when the compiler is off."""

from __future__ import annotations

import importlib
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))

from compiler import COMPILED, guard_kernels

if not COMPILED:
    for name in ("amcl", "astar", "clearance", "distance", "dwa", "inflation", "raycast"):
        guard_kernels(importlib.import_module(f"fog_kernels.{name}"))
