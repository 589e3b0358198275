import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def maps_dir() -> Path:
    """Return the folder of recorded maps beside the project."""
    beside = Path(__file__).parents[3].parent / "shared" / "data"
    maps = Path(os.environ.get("FOGNAV_DATA", beside)) / "maps"
    if not maps.is_dir():
        pytest.skip("no data")
    return maps
