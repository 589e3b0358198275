"""Shared by all tests: hypothesis profiles, the folder of recordings, and which tests may run in parallel."""

import gc
import os
import platform
import re
import signal
import subprocess
from collections.abc import Iterator
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

import programs
import pytest
from hypothesis import HealthCheck, settings

from fog_supervisor import net

if TYPE_CHECKING:
    from _pytest.terminal import TerminalReporter
    from xdist.scheduler import LoadScopeScheduling
    from xdist.workermanage import WorkerController

# In CI the examples are the same in every run; on a developer's machine each run tries new ones.
settings.register_profile(
    "default", deadline=None, suppress_health_check=[HealthCheck.too_slow]
)  # a busy machine is no defect
settings.register_profile("repeatable", parent=settings.get_profile("default"), derandomize=True)
settings.load_profile("default")
if os.environ.get("CI", "").lower() in {"1", "true"}:
    settings.load_profile("repeatable")

# What is imported and collected is there until the end: looking again and again for what of it is garbage takes a tenth
# of the collection's time, and some seconds at the end.
gc.disable()

# A script's shell lets its background jobs ignore what the keyboard sends; so would all programs that tests start.
for number, action in ((signal.SIGINT, signal.default_int_handler), (signal.SIGQUIT, signal.SIG_DFL)):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, action)

WORKER: Final = os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")
WORKERS: Final = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
ROOT: Final = Path(__file__).parent
LONGER: Final = (
    "FOGNAV_CROWD_SEEDS", "FOGNAV_DAMAGED_ORDERS", "FOGNAV_FLAPS", "FOGNAV_FUZZ_INPUTS", "FOGNAV_GAP_SEEDS",
    "FOGNAV_HISTORIES", "FOGNAV_KILLS", "FOGNAV_NONSENSE", "FOGNAV_PERMUTED_READINGS", "FOGNAV_RIDE_SEEDS",
    "FOGNAV_ROOM_SEEDS", "FOGNAV_STORE_EXAMPLES", "FOGNAV_TEST_STOP_FIELD_SEEDS", "FOGNAV_WRITES",
)  # fmt: skip
"""Variables that set how much some tests try, which may take hours then (CONTRIBUTING.md)."""
COMMIT: Final = pytest.StashKey[str]()
LAST_LONG_RUN: Final = ROOT / "tests" / "last-long-run.txt"
REACTION, COMPUTING, SYSTEM, LIVE, COMPOSE = range(5)
"""Kinds of test modules, in the order in which they are started."""


def pytest_configure(config: pytest.Config) -> None:
    """Give each worker its own range of ports and the run's programs, and what it starts the usual signals.

    Two workers that search for a port at the same moment would find the same one.
    """
    if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN:
        # Under nohup. What is ignored is inherited by the programs that tests start and hang up; a handler is not.
        signal.signal(signal.SIGHUP, lambda *_: None)
    if config.getoption("tier", "all") == "long":
        config.stash[COMMIT] = commit()
    if hasattr(config, "workerinput"):
        programs.RUN = os.getppid()
    share = len(net.PORTS) // WORKERS
    net.PORTS = net.PORTS[int(WORKER) * share : (int(WORKER) + 1) * share]


@cache
def group_of(module: str) -> tuple[int, str]:
    """Return the group of a test module, as its kind and a name; a group runs on one worker, one test after another.

    Tests that measure the reaction time of real processes never run in parallel. The tests of any other module stay
    together, because they share its servers; those of the firmware share what is compiled for them. Tests of the whole
    system, and those that have a time limit of their own, take longest and start first.
    """
    text = (ROOT / module).read_text("utf-8")
    if "mark.compose" in text:
        return COMPOSE, ""
    if "mark.reaction" in text:
        return REACTION, ""
    if "mark.live" in text:
        return (SYSTEM if module.startswith("tests/") or "mark.timeout" in text else LIVE), module
    return COMPUTING, "firmware" if module.startswith("firmware/") else module


@cache
def scope_of(nodeid: str, tier: str) -> str:
    """Return which tests run with this one on one worker: its group, but whole drives that share nothing run anywhere.

    Otherwise a module of twelve drives would keep one worker for minutes after all others have ended.
    """
    module = module_of(nodeid)
    group = group_of(module)
    shares = re.search(r"scope=|^@(functools\.)?(lru_)?cache", (ROOT / module).read_text("utf-8"), re.MULTILINE)
    alone = tier != "quick" and group == (COMPUTING, module) and not shares
    return nodeid if alone else str(group)


def computes(worker: str) -> bool:
    """Whether this worker prefers tests that only compute: one per core except one, which tests that wait share."""
    return int(worker.removeprefix("gw")) < max(1, (os.cpu_count() or 1) - 1)


def module_of(nodeid: str) -> str:
    """Return the path of a test's module."""
    return nodeid.partition("::")[0]


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> "LoadScopeScheduling | None":
    """Distribute the tests by group, for `--dist loadgroup`."""
    if config.getoption("dist") != "loadgroup":
        return None
    from xdist.scheduler import LoadScopeScheduling  # noqa: PLC0415  # absent when pytest runs without xdist

    class GroupScheduling(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            return scope_of(nodeid, config.getoption("tier"))

        def _assign_work_unit(self, node: "WorkerController") -> None:
            # Each worker takes the other kind when there is no more of its own, so that none is idle before the end.
            preferred = computes(node.gateway.id)
            first = (
                scope for scope, tests in self.workqueue.items()
                if (group_of(module_of(next(iter(tests))))[0] == COMPUTING) == preferred
            )  # fmt: skip
            self.workqueue.move_to_end(next(first, next(iter(self.workqueue))), last=False)
            super()._assign_work_unit(node)

    return GroupScheduling(config, log)


@cache
def claims() -> frozenset[str]:
    """Return the tests that docs/security.md names, by their ids."""
    text = (ROOT / "docs" / "security.md").read_text("utf-8")
    return frozenset(re.findall(r"`([\w/-]+/test_\w+\.py::test_\w+)`", text))


def is_quick(item: pytest.Item) -> bool:
    """Whether a test is one of some minutes: all that only compute, but for whole drives, and some of each process."""
    computes_only = group_of(module_of(item.nodeid))[0] == COMPUTING and item.get_closest_marker("drive") is None
    return computes_only or item.get_closest_marker("smoke") is not None


def belongs(item: pytest.Item, tier: str) -> bool:
    """Whether a test is run with those of a tier; what needs containers is one of the rest and a long one."""
    long = item.get_closest_marker("long") is not None
    if tier == "long":
        return long or item.get_closest_marker("compose") is not None
    return not long and (tier == "all" or is_quick(item) == (tier == "quick"))


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Import no module of which the tier runs no test, unless it is named: each worker imports what it collects."""
    tier = config.getoption("tier", "all")
    named = {config.invocation_params.dir / argument.partition("::")[0] for argument in config.args}
    if tier in {"all", "long"} or not collection_path.match("test_*.py") or collection_path in named:
        return None
    text = collection_path.read_text("utf-8")
    computes_only = group_of(str(collection_path.relative_to(ROOT)))[0] == COMPUTING
    some = computes_only or "mark.smoke" in text if tier == "quick" else not computes_only or "mark.drive" in text
    return None if some else True


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out what another tier runs, and start with the tests that take longest, if several workers share them.

    No test that was made longer times out.
    The tests that show a claim of docs/security.md are marked: `./fognav test -m claim`.
    """
    for item in items:
        if item.nodeid.partition("[")[0] in claims():
            item.add_marker(pytest.mark.claim)
    if any(os.environ.get(name) for name in LONGER):
        for item in items:
            if item.get_closest_marker("timeout") is None:
                item.add_marker(pytest.mark.timeout(0))
    tier = config.getoption("tier", "all")
    if left_out := [item for item in items if not belongs(item, tier)]:
        items[:] = [item for item in items if belongs(item, tier)]
        config.hook.pytest_deselected(items=left_out)
    if "PYTEST_XDIST_WORKER" in os.environ:
        items.sort(key=lambda item: group_of(module_of(item.nodeid)))


def pytest_collection_finish() -> None:
    """Collect garbage from now on, but for what is there."""
    gc.freeze()
    gc.enable()


def commit() -> str:
    """Return what is tested, as git names it."""
    git = ["git", "-C", str(ROOT), "describe", "--always", "--dirty"]
    done = subprocess.run(git, capture_output=True, text=True, check=False)  # noqa: S603  # a fixed command, no shell
    return done.stdout.strip() or "no commit"


def pytest_terminal_summary(terminalreporter: "TerminalReporter", config: pytest.Config) -> None:
    """Keep the date and result of the last run of all long tests, to be committed."""
    selected = config.args_source != pytest.Config.ArgsSource.TESTPATHS or config.option.keyword
    if config.getoption("tier", "all") != "long" or selected or config.option.markexpr:
        return
    counts = {kind: len(terminalreporter.stats.get(kind, [])) for kind in ("passed", "failed", "error", "skipped")}
    told = ", ".join(f"{count} {kind}" for kind, count in counts.items() if count) or "no test ran"
    machine = f"{os.cpu_count()} cores, {platform.system()} {platform.machine()}"
    line = f"{datetime.now(UTC):%Y-%m-%d}, {config.stash[COMMIT]}: {told} ({machine})\n"
    LAST_LONG_RUN.write_text(line, "utf-8")
    terminalreporter.line(f"commit {LAST_LONG_RUN.relative_to(ROOT)}: {line}")


@pytest.fixture(scope="module")
def forked_programs() -> Iterator[None]:
    """Let supervisors of a module's tests fork Fognav's programs, where the start of one is not what is tested."""
    with programs.fork_supervised():
        yield


@pytest.fixture(scope="session")
def data_dir() -> Path:
    """Return the folder of recordings and maps: FOGNAV_DATA, or a default beside the checkout; skip without it."""
    folder = Path(os.environ.get("FOGNAV_DATA") or Path(__file__).resolve().parent.parent / "shared" / "data")
    if not folder.is_dir():
        pytest.skip(f"{folder} does not exist: set FOGNAV_DATA to the folder of recordings and maps")
    return folder


@pytest.fixture(scope="session")
def maps_dir(data_dir: Path) -> Path:
    """Return the folder of recorded maps; skip without it."""
    return data_dir / "maps"
