"""Makes `driver` importable (pytest imports by path), and runs one stack for all tests of a module."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
