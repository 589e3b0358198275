from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def data_dir() -> Path:
    folder = Path(os.environ.get("FOGNAV_DATA") or Path(__file__).parents[4] / "shared" / "data")
    if not (folder / "roomba").is_dir():
        pytest.skip("no data")
    return folder
