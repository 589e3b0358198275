"""`fognav hunt`: drive random worlds in lockstep, and look for what must never happen."""

from __future__ import annotations

from pathlib import Path  # noqa: TC003  # Typer reads annotations at run time
from typing import TYPE_CHECKING, Annotated

import typer

from fognav import checkout, kernels, system
from fognav.commands.installed import MEASURE
from fognav.output import NOT_TRUE, WrongUseError, exit_codes, print_line

if TYPE_CHECKING:
    from fognav_experiments.hunt.play import Hunted


def add_to(app: typer.Typer) -> None:
    """Add the command to `fognav`."""
    app.command("hunt", epilog="Example: fognav hunt --minutes 10 --seed 1 --jobs 2", rich_help_panel=MEASURE)(
        hunt_command
    )


def hunt_command(  # noqa: PLR0913  # each option is an argument
    *,
    minutes: Annotated[float, typer.Option("--minutes", metavar="M", min=0.0, help="Begin drives for so long.")] = 1.0,
    seed: Annotated[int, typer.Option("--seed", metavar="S", min=0, help="Seed of the worlds.")] = 1,
    jobs: Annotated[int, typer.Option("--jobs", metavar="N", min=1, help="Drives at the same time.")] = 1,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Records (default: experiments/hunt).")
    ] = None,
    data: Annotated[
        Path | None, typer.Option("--data", metavar="DIR", envvar="FOGNAV_DATA", help="Folder of further maps.")
    ] = None,
    tries: Annotated[int, typer.Option("--tries", metavar="N", min=0, help="Drives that shrink a failure.")] = 40,
    replay: Annotated[
        list[Path] | None, typer.Option("--replay", metavar="FILE", help="Drive the worlds of these files instead.")
    ] = None,
) -> None:
    """Drive random worlds, and look for broken rules.

    They are driven in lockstep, under the eyes of an oracle that knows what must always hold.
    Floors, the map's errors, sensors, radio, people, operators and failures are drawn from the seed. Every drive is
    recorded, and a seed goes on where it was; a world that breaks a rule is shrunk to a file that drives it again
    (--replay). With --minutes 0 the records are summed up. The exit code is 1 if a rule was broken.
    """
    from fognav_experiments.hunt import play, runner  # noqa: PLC0415  # keeps the other commands fast

    with exit_codes():
        root = checkout.root()
        folders = [root / "sites", *([data] if data is not None else [])]
        system.prepare_node_code(print_line)
        kernels.warm_cache(print_line)
        folder = out or root / "experiments" / "hunt"
        try:
            if replay:
                broken = sum(_told(file, play.hunt(play.read_world(file), folders)) for file in replay)
            else:
                broken = 0
                for record in runner.run(folder, seed, minutes, jobs, checkout.revision(), folders, tries):
                    broken += bool(record.rules)
                    broke = f"; {record.rules[0]} {record.values}" if record.rules else ""
                    driven = f"{record.outcome}, {record.figures.driven_m:.1f} m"
                    print_line(f"{record.seed}-{record.number} {record.kind}: {driven}{broke}")
                print_line(runner.summary(runner.read_records(folder)))
        except ValueError as error:
            raise WrongUseError(str(error)) from error
    if broken:
        raise typer.Exit(NOT_TRUE)


def _told(file: Path, hunted: Hunted) -> bool:
    """Tell how a drive went; return whether it broke a rule."""
    print_line(f"{file}: {hunted.outcome} ({hunted.reason}), {hunted.figures.driven_m:.1f} m")
    for found in hunted.violations:
        print_line(f"  {found.rule} at {found.at_s} s, ({found.x}, {found.y}): {found.values}")
    return bool(hunted.violations)
