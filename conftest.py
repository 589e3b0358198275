"""What all tests share: how hypothesis looks for examples, where recordings lie, and which tests may run at once."""

import os
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

import pytest
from hypothesis import settings

from fog_supervisor import net

if TYPE_CHECKING:
    from xdist.scheduler import LoadScopeScheduling

# A run that judges a change must come out the same twice; on a developer's machine every run looks further.
settings.register_profile("repeatable", derandomize=True)
if os.environ.get("CI", "").lower() in {"1", "true"}:
    settings.load_profile("repeatable")

WORKER: Final = os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")
WORKERS: Final = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
ROOT: Final = Path(__file__).parent
REACTION, COMPUTING, SYSTEM, LIVE, COMPOSE = range(5)
"""Kinds of test modules, in the order in which they are begun."""


def pytest_configure() -> None:
    """Give each worker ports of its own: two that look for a free one at the same moment would find the same."""
    share = len(net.PORTS) // WORKERS
    net.PORTS = net.PORTS[int(WORKER) * share : (int(WORKER) + 1) * share]


@cache
def group_of(module: str) -> tuple[int, int]:
    """Return which tests run one after the other, on one worker, with those of a module: its kind, and a number.

    Tests of how fast real processes react never run beside one another. Modules that compute without waiting share one
    worker for each core but one, so that a core is left for all that wait. Other modules with real processes stay
    whole, for they share their servers; those of the whole system take longest, and begin first.
    """
    text = (ROOT / module).read_text("utf-8")
    number = sum(module.encode())
    if "mark.compose" in text:
        return COMPOSE, 0
    if "mark.reaction" in text:
        return REACTION, 0
    if "mark.live" in text:
        return (SYSTEM if module.startswith("tests/") else LIVE), number
    return COMPUTING, number % max(1, (os.cpu_count() or 1) - 1)


def module_of(nodeid: str) -> str:
    """Return the path of a test's module."""
    return nodeid.partition("::")[0]


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> "LoadScopeScheduling | None":
    """Hand out the tests in the groups above, for `--dist loadgroup`."""
    if config.getoption("dist") != "loadgroup":
        return None
    from xdist.scheduler import LoadScopeScheduling  # noqa: PLC0415  # not there when pytest runs without it

    class GroupScheduling(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return str(group_of(module_of(nodeid)))

    return GroupScheduling(config, log)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the tests that take longest, where several workers share them."""
    if "PYTEST_XDIST_WORKER" in os.environ:
        items.sort(key=lambda item: group_of(module_of(item.nodeid)))


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
