"""Mutation tests: whether the tests of the parts that stop the robot notice each small change of their code.

Each run of a part's tests is a forked process, on a changed module or on all modules as they are. The libraries are
loaded once, before the fork. The modules of the part are imported in the child only, so that every module that takes a
name from the changed one gets it from there.
"""

from __future__ import annotations

import importlib
import importlib.machinery
import importlib.util
import json
import math
import os
import resource
import signal
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple, NoReturn

from fognav.output import FailedError, WrongUseError
from fognav_experiments.mutants import Mutant, mutants, mutate

if TYPE_CHECKING:
    import ast
    from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
    from types import CodeType, ModuleType

    import pytest


LEAST_SCORE: Final = 0.9
"""Share of the mutants that the tests of a part must notice; a few change nothing, and no test could notice these."""


class Part(NamedTuple):
    """A part of the robot.

    modules: names below `robot_agent`; a package stands for all its modules. tests: files or folders below
    `robot-agent/tests`. preload: what the tests import besides these modules and is the same for every mutant.
    """

    name: str
    modules: tuple[str, ...]
    tests: tuple[str, ...]
    preload: tuple[str, ...]

    def files(self, root: Path) -> dict[str, Path]:
        """Return the source of each module, by its full name, in a checkout."""
        package = root / "robot-agent/src/robot_agent"
        found: dict[str, Path] = {}
        for name in self.modules:
            path = package.joinpath(*name.split("."))
            files = sorted(path.glob("*.py")) if path.is_dir() else [path.with_suffix(".py")]
            for file in files:
                if file.stem != "__init__":
                    found[".".join(("robot_agent", *file.relative_to(package).with_suffix("").parts))] = file
        return found


def parts_named(names: Sequence[str]) -> list[Part]:
    """Return the parts of these names, or all; raises `WrongUseError` for an unknown name."""
    known = {part.name: part for part in PARTS}
    for name in names:
        if name not in known:
            raise WrongUseError(f"there is no part {name!r}: name one of {', '.join(known)}")
    return [known[name] for name in names] or list(PARTS)


PARTS: Final = (
    Part(
        "safety",
        ("safety",),
        ("safety",),
        ("numpy", "hypothesis.strategies", "fog_kernels.sweep", "robot_agent.config", "robot_agent.footprint"),
    ),
    Part(
        "guardian",
        (
            "guardian.base",
            "guardian.core",
            "guardian.link",
            "guardian.maneuvers",
            "guardian.timing",
        ),
        (
            "guardian/test_awakening.py",
            "guardian/test_guardian_core.py",
            "guardian/test_guardian_limits.py",
            "guardian/test_guardian_maneuvers.py",
            "guardian/test_guardian_moments.py",
            "guardian/test_guardian_self_driving.py",
            "guardian/test_timing.py",
        ),
        ("numpy", "hypothesis.strategies", "robot_agent.config"),
    ),
    Part(
        "recoveries",
        ("motion.recovery",),
        ("motion/test_recovery.py",),
        ("numpy", "hypothesis.strategies", "fog_kernels.clearance", "robot_agent.config"),
    ),
    Part(
        "maneuvers",
        ("agent.maneuvers", "agent.power"),
        ("agent/test_docking.py", "agent/test_maneuvers.py", "agent/test_rest.py"),
        ("numpy", "hypothesis.strategies", "robot_agent.localization.localizer", "robot_agent.config"),
    ),
    Part(
        "watchdog",
        ("guardian.watchdog",),
        ("guardian/test_watchdog.py",),
        ("robot_agent.serial_port", "fog_runtime.configuration.parts", "fog_runtime.machine"),
    ),
)


class Survivor(NamedTuple):
    """A mutant that no test notices."""

    module: str
    mutant: Mutant

    def __str__(self) -> str:
        """Name place, code and change."""
        mutant = self.mutant
        return f"{self.module}:{mutant.line}: {mutant.code}: {mutant.before} -> {mutant.after}"


class ModuleScore(NamedTuple):
    """Figures of one module."""

    module: str
    mutants: int
    survivors: list[Survivor]

    @property
    def killed(self) -> int:
        """Number of mutants that a test notices."""
        return self.mutants - len(self.survivors)


def score(modules: list[ModuleScore]) -> float:
    """Return the share of the mutants that tests notice; 1 without any."""
    asked = sum(module.mutants for module in modules)
    return sum(module.killed for module in modules) / asked if asked else 1.0


class _Task(NamedTuple):
    module: str
    source: str
    mutant: Mutant


def measure(part: Part, root: Path, *, jobs: int, only: str, tell: Callable[[str], object]) -> list[ModuleScore]:
    """Return the figures of each module of a part.

    only: mutants of modules whose name ends so, all for an empty text. `tell` gets each survivor.

    Raises `FailedError` if a test fails without any change.
    """
    preload(part, part.files(root))
    unchanged = try_unchanged(part, root)
    if unchanged.failed:
        raise FailedError(f"{unchanged.failed[0]} fails without any change: mend it first")
    tasks = _tasks(part, root, only)
    survivors: dict[str, list[Survivor]] = {}
    for done, (task, survives) in enumerate(_run(part, root, tasks, unchanged.seconds, jobs), 1):
        if survives:
            survivor = Survivor(task.module, task.mutant)
            survivors.setdefault(task.module, []).append(survivor)
            tell(f"survives ({done} of {len(tasks)} tried): {survivor}")
    return [
        ModuleScore(
            module,
            sum(task.module == module for task in tasks),
            sorted(survivors.get(module, []), key=lambda survivor: survivor.mutant.line),
        )
        for module in part.files(root)
    ]


def _tasks(part: Part, root: Path, only: str) -> list[_Task]:
    """Return the mutants to try."""
    sources = {module: path.read_text("utf-8") for module, path in part.files(root).items() if module.endswith(only)}
    return [_Task(module, source, mutant) for module, source in sources.items() for mutant in mutants(source)]


def _run(
    part: Part, root: Path, tasks: list[_Task], seconds: dict[str, float], jobs: int
) -> Iterator[tuple[_Task, bool]]:
    """Yield each mutant with whether it survives its tests, in the order in which they end."""
    running: dict[int, _Task] = {}
    waiting = list(reversed(tasks))
    while running or waiting:
        while waiting and len(running) < jobs:
            task = waiting.pop()
            tree = mutate(task.source, task.mutant)
            running[start_mutant(part, root, task.module, tree, seconds)] = task
        # Not os.wait(): other children of this process are none of these.
        ended = [(pid, status) for pid in running for got, status in [os.waitpid(pid, os.WNOHANG)] if got]
        for pid, status in ended:
            yield running.pop(pid), os.WIFEXITED(status) and os.WEXITSTATUS(status) == 0
        if not ended:
            time.sleep(0.005)


_SKIPPED_PLUGINS: Final = ("cacheprovider", "faulthandler", "doctest", "junitxml", "stepwise", "unraisableexception")
_INI: Final = "[pytest]\nfilterwarnings = ignore\nmarkers =\n  live: x\n  reaction: x\n  data: x\n"


_PATIENCE_S: Final = 120
_CPU_S: Final = 20
"""Processor time of a mutant besides thrice what its tests take."""


class TestRun(NamedTuple):
    """Result of the tests on the unchanged modules: seconds of each test, and those that failed."""

    seconds: dict[str, float]
    failed: list[str]


class _Timing:
    """Records how long each test takes, and which fail; pytest calls it."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.failed: list[str] = []

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.seconds[report.nodeid] = self.seconds.get(report.nodeid, 0.0) + report.duration
        if report.failed:
            self.failed.append(report.nodeid)


class _QuickFirst:
    """Sorts the tests so that those run first that are done soonest, property tests last; pytest calls it."""

    def __init__(self, seconds: dict[str, float]) -> None:
        self._seconds = seconds

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items.sort(key=lambda item: self._seconds.get(item.nodeid, math.inf))


def preload(part: Part, modules: Iterable[str]) -> None:
    """Import what every run of the part's tests needs; raises `FailedError` if that imports a module of the part."""
    for name in ("pytest", "hypothesis", *part.preload):
        importlib.import_module(name)
    for name in modules:
        if name in sys.modules:
            raise FailedError(f"{name} is imported before it can be changed: correct `preload` of part {part.name}")


def try_unchanged(part: Part, root: Path) -> TestRun:
    """Run the tests on the modules as they are."""
    with tempfile.TemporaryDirectory(prefix="fognav-mutation-") as folder:
        report = Path(folder) / "result.json"
        child = os.fork()
        if child == 0:
            _end_with(lambda: _time_tests(part, root, report))
        os.waitpid(child, 0)
        return TestRun(**json.loads(report.read_text("utf-8")))


def start_mutant(part: Part, root: Path, module: str, tree: ast.Module, seconds: dict[str, float]) -> int:
    """Start the tests on a changed module; return the child's id. It exits with 0 if no test fails."""
    child = os.fork()
    if child == 0:
        # A mutant may loop for ever, which its processor time shows soon however busy the machine is, or wait for ever.
        took = int(sum(seconds.values()))
        resource.setrlimit(resource.RLIMIT_CPU, (_CPU_S + 3 * took, resource.RLIM_INFINITY))
        signal.alarm(_PATIENCE_S + 10 * took)

        def run() -> int:
            sys.meta_path.insert(0, _Finder(module, tree))
            return _pytest(part, root, ["-x"], [_QuickFirst(seconds)])

        _end_with(run)
    return child


class _Finder:
    """Finds one module, as its changed tree."""

    def __init__(self, name: str, tree: ast.Module) -> None:
        self._name, self._tree = name, tree

    def find_spec(
        self, name: str, path: Sequence[str] | None, _target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        if name != self._name:
            return None
        found = importlib.machinery.PathFinder.find_spec(name, path)
        assert found is not None
        assert found.origin is not None
        loader = _Loader(name, found.origin, compile(self._tree, found.origin, "exec"))
        return importlib.util.spec_from_file_location(name, found.origin, loader=loader)


class _Loader(importlib.machinery.SourceFileLoader):
    """Loads a module from code that was compiled already."""

    def __init__(self, name: str, path: str, code: CodeType) -> None:
        super().__init__(name, path)
        self._code = code

    def get_code(self, _fullname: str) -> CodeType:
        return self._code


def _end_with(run: Callable[[], int]) -> NoReturn:
    """Run the child's work silently and end it, whatever the work raises."""
    code = 1
    try:
        quiet = os.open(os.devnull, os.O_RDWR)
        for descriptor in (0, 1, 2):
            os.dup2(quiet, descriptor)
        code = run()
    finally:
        os._exit(code)


def _pytest(part: Part, root: Path, options: list[str], plugins: list[object]) -> int:
    import pytest  # noqa: PLC0415  # for developers, absent from an installation

    os.environ["PYTEST_DISABLE_PLUGIN_AUTOLOAD"] = "1"
    os.environ["CI"] = "1"  # the same examples of property tests in every run
    folder = root / "robot-agent/tests"
    with tempfile.TemporaryDirectory(prefix="fognav-mutation-") as temporary:
        ini = Path(temporary) / "pytest.ini"
        ini.write_text(_INI, "utf-8")
        skipped = [word for name in _SKIPPED_PLUGINS for word in ("-p", f"no:{name}")]
        arguments = ["-c", str(ini), "--rootdir", str(root), "--confcutdir", str(root), "--import-mode=importlib", "-q"]
        arguments += ["-o", f"pythonpath={root / 'tests/support'}"]
        arguments += ["--assert=plain", "-m", "not live", "--ignore-glob=*_drives.py", *skipped, *options]
        return int(pytest.main([*arguments, *(str(folder / test) for test in part.tests)], plugins=plugins))


def _time_tests(part: Part, root: Path, report: Path) -> int:
    timing, started = _Timing(), time.monotonic()
    code = _pytest(part, root, [], [timing])
    if code and not timing.failed:
        timing.failed.append(f"pytest ended with {code} after {time.monotonic() - started:.1f} s")
    report.write_text(json.dumps({"seconds": timing.seconds, "failed": timing.failed}), "utf-8")
    return 0


def passes(figures: Mapping[str, list[ModuleScore]]) -> bool:
    """Return whether tests notice enough mutants of each part."""
    return all(score(modules) >= LEAST_SCORE for modules in figures.values())


def report_lines(figures: Mapping[str, list[ModuleScore]]) -> Iterator[str]:
    """Yield the lines of the report."""
    for part, modules in figures.items():
        for module in modules:
            if module.mutants:
                yield f"{module.module}: {module.killed} of {module.mutants} mutants noticed"
            yield from (f"  survives: {survivor}" for survivor in module.survivors)
        if any(module.mutants for module in modules):
            yield f"{part}: score {score(modules):.1%}"


def report_values(figures: Mapping[str, list[ModuleScore]]) -> dict[str, object]:
    """Return the figures of each part as values of a JSON object."""
    return {
        part: {"score": round(score(modules), 4), "modules": [_values(module) for module in modules]}
        for part, modules in figures.items()
    }


def _values(module: ModuleScore) -> dict[str, object]:
    return {
        "module": module.module,
        "mutants": module.mutants,
        "killed": module.killed,
        "survivors": [str(survivor) for survivor in module.survivors],
    }
