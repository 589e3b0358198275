"""Runs every mutant of a part, several at once, and counts those that its tests notice."""

from __future__ import annotations

import os
import time
from typing import TYPE_CHECKING, NamedTuple

from fognav.output import FailedError
from fognav_experiments.mutation import child
from fognav_experiments.mutation.mutants import Mutant, mutants, mutate

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from fognav_experiments.mutation.parts import Part


class Survivor(NamedTuple):
    """A mutant that no test notices."""

    module: str
    mutant: Mutant

    def __str__(self) -> str:
        """Name place, code and change."""
        mutant = self.mutant
        return f"{self.module}:{mutant.line}: {mutant.code}: {mutant.before} -> {mutant.after}"


class ModuleScore(NamedTuple):
    """Figures of one module. `equivalent` mutants change nothing and are no part of the score."""

    module: str
    coverage: child.Coverage
    mutants: int
    equivalent: int
    survivors: list[Survivor]

    @property
    def killed(self) -> int:
        """Number of mutants that a test notices."""
        return self.mutants - self.equivalent - len(self.survivors)


def score(modules: list[ModuleScore]) -> float:
    """Return the share of the mutants that tests notice, of those that change something; 1 without any."""
    asked = sum(module.mutants - module.equivalent for module in modules)
    return sum(module.killed for module in modules) / asked if asked else 1.0


class _Task(NamedTuple):
    module: str
    source: str
    mutant: Mutant


def measure(part: Part, root: Path, *, jobs: int, only: str | None, tell: Callable[[str], object]) -> list[ModuleScore]:
    """Return the figures of each module of a part.

    only: mutants of modules whose name ends so, all for an empty text, and none for None. `tell` gets each survivor.

    Raises `FailedError` if a test fails without any change.
    """
    child.preload(part, part.files(root))
    unchanged = child.try_unchanged(part, root)
    if unchanged.failed:
        raise FailedError(f"{unchanged.failed[0]} fails without any change: mend it first")
    tasks, equivalent = _tasks(part, root, only) if only is not None else ([], {})
    survivors: dict[str, list[Survivor]] = {}
    for done, (task, survives) in enumerate(_run(part, root, tasks, unchanged.seconds, jobs), 1):
        if survives:
            survivor = Survivor(task.module, task.mutant)
            survivors.setdefault(task.module, []).append(survivor)
            tell(f"survives ({done} of {len(tasks)} tried): {survivor}")
    return [
        ModuleScore(
            module,
            coverage,
            sum(task.module == module for task in tasks) + equivalent.get(module, 0),
            equivalent.get(module, 0),
            sorted(survivors.get(module, []), key=lambda survivor: survivor.mutant.line),
        )
        for module, coverage in unchanged.coverage.items()
    ]


def _tasks(part: Part, root: Path, only: str) -> tuple[list[_Task], dict[str, int]]:
    """Return the mutants to try, and how many of each module change nothing."""
    tasks: list[_Task] = []
    equivalent: dict[str, int] = {}
    for module, path in part.files(root).items():
        if not module.endswith(only):
            continue
        source = path.read_text("utf-8")
        for mutant in mutants(source):
            if part.why_equivalent(module, mutant) is None:
                tasks.append(_Task(module, source, mutant))
            else:
                equivalent[module] = equivalent.get(module, 0) + 1
    return tasks, equivalent


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
            running[child.start_mutant(part, root, task.module, tree, seconds)] = task
        # Not os.wait(): other children of this process are none of these.
        ended = [(pid, status) for pid in running for got, status in [os.waitpid(pid, os.WNOHANG)] if got]
        for pid, status in ended:
            yield running.pop(pid), os.WIFEXITED(status) and os.WEXITSTATUS(status) == 0
        if not ended:
            time.sleep(0.005)
