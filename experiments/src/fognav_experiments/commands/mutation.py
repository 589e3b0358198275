"""`fognav bench mutation`: test the tests of what stops the robot."""

from __future__ import annotations

import os
from typing import Annotated

import typer

from fognav import checkout
from fognav.operate.options import JsonOption  # noqa: TC001  # Typer reads annotations at run time
from fognav.output import NOT_TRUE, console, exit_codes, print_json


def mutation_command(
    *,
    part: Annotated[
        list[str] | None, typer.Option("--part", metavar="NAME", help="Only this part; may be repeated.")
    ] = None,
    module: Annotated[
        str, typer.Option("--module", metavar="NAME", help="Only mutants of modules whose name ends so.")
    ] = "",
    coverage: Annotated[
        bool, typer.Option("--coverage", help="Measure only which lines and branches the tests reach.")
    ] = False,
    jobs: Annotated[int, typer.Option("--jobs", metavar="N", min=0, help="Mutants at once; 0: one per core.")] = 0,
    json: JsonOption = False,
) -> None:
    """Test the tests of what stops the robot.

    Changes one operator, number or statement of safety gate, guardian, watchdog, recoveries or maneuvers, and runs
    their tests, which must notice it; prints each change that none does. Exit code 1: a line or branch that no test
    reaches, or fewer than 90 percent of the changes noticed.
    """
    from fognav_experiments import mutation  # noqa: PLC0415  # keeps the other commands fast
    from fognav_experiments.mutation import parts_named  # noqa: PLC0415  # same

    def tell(text: str) -> None:
        console.print(text, markup=False, soft_wrap=True)

    with exit_codes():
        root, chosen = checkout.root(), parts_named(part or [])
        figures = {
            each.name: mutation.measure(
                each, root, jobs=jobs or os.cpu_count() or 1, only=None if coverage else module, tell=tell
            )
            for each in chosen
        }
    if json:
        print_json({"bench": "mutation", "parts": mutation.report_values(figures)})
    else:
        for line in mutation.report_lines(figures):
            tell(line)
    if not mutation.passes(figures):
        raise typer.Exit(NOT_TRUE)
