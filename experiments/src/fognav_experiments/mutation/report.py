"""The figures of mutation tests, as text and as values of a JSON object."""

from __future__ import annotations

from typing import TYPE_CHECKING

from fognav_experiments.mutation.parts import LEAST_SCORE
from fognav_experiments.mutation.run import ModuleScore, score

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping


def passes(figures: Mapping[str, list[ModuleScore]]) -> bool:
    """Return whether tests reach every line and branch, and notice enough mutants of each part."""
    reached = all(not module.coverage.missing for modules in figures.values() for module in modules)
    return reached and all(score(modules) >= LEAST_SCORE for modules in figures.values())


def lines(figures: Mapping[str, list[ModuleScore]]) -> Iterator[str]:
    """Yield the lines of the report."""
    for part, modules in figures.items():
        for module in modules:
            reached = module.coverage
            yield (
                f"{module.module}: {reached.lines_reached} of {reached.lines} lines and {reached.branches_reached} of "
                f"{reached.branches} branches reached"
            )
            if reached.missing:
                yield f"  not reached: {reached.missing}"
            if module.mutants:
                asked = module.mutants - module.equivalent
                yield f"  {module.killed} of {asked} mutants noticed; {module.equivalent} more change nothing"
            yield from (f"  survives: {survivor}" for survivor in module.survivors)
        if any(module.mutants for module in modules):
            yield f"{part}: score {score(modules):.1%}"


def values(figures: Mapping[str, list[ModuleScore]]) -> dict[str, object]:
    """Return the figures of each part as values of a JSON object."""
    return {
        part: {"score": round(score(modules), 4), "modules": [_values(module) for module in modules]}
        for part, modules in figures.items()
    }


def _values(module: ModuleScore) -> dict[str, object]:
    return {
        "module": module.module,
        "coverage": module.coverage._asdict(),
        "mutants": module.mutants,
        "equivalent": module.equivalent,
        "killed": module.killed,
        "survivors": [str(survivor) for survivor in module.survivors],
    }
