"""The version of Fognav that runs: all members have the same, from the file VERSION of the checkout."""

import os
from importlib.metadata import version
from typing import Final

VERSION: Final = version("fog-runtime")
REVISION: Final = os.environ.get("FOGNAV_REVISION") or "unknown"
"""The commit that runs, as images and the demo's processes get it."""
