"""What all tests share: how hypothesis looks for examples, and where recordings of real hardware lie."""

import os
from pathlib import Path

import pytest
from hypothesis import settings

# A run that judges a change must come out the same twice; on a developer's machine every run looks further.
settings.register_profile("repeatable", derandomize=True)
if os.environ.get("CI", "").lower() in {"1", "true"}:
    settings.load_profile("repeatable")


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Return the folder of recordings and maps: FOGNAV_DATA, or `shared/data` beside the checkout; skip without it."""
    folder = Path(os.environ.get("FOGNAV_DATA") or Path(__file__).resolve().parent.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"no recordings in {folder}: set FOGNAV_DATA to their folder")
    return folder


@pytest.fixture(scope="session")
def maps_dir(data_dir: Path) -> Path:
    """Return the folder of recorded maps; skip without it."""
    return data_dir / "maps"
