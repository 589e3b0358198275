"""How `fognav test` runs pytest: which tests, on all cores, with progress, and with programs that can be installed."""

import os
import sys
from collections.abc import Callable, Sequence
from typing import Final

from fognav import checkout, system

_OVERRIDES: Final = (
    "-n",
    "--numprocesses",
    "--dist",
    "--pdb",
    "--trace",
    "--collect-only",
    "--co",
    "-s",
    "--capture=no",
)
"""Arguments that choose another distribution of the tests, or need a single process."""

_TIERS: Final = {"--all": "all", "--rest": "rest", "--long": "long"}
"""Arguments that ask for every test, those that are left out without one, or those that all tests leave out."""


def workers(tier: str) -> int:
    """Return how many tests run at once: two more than there are cores, because most tests of processes wait.

    The root's conftest.py lets no more of them compute than there are cores to spare. Nearly all quick ones do: more at
    once would leave no time to the real processes of the others.
    """
    return (os.cpu_count() or 1) + (0 if tier == "quick" else 2)


def pytest_command(arguments: Sequence[str], *, terminal: bool | None = None) -> list[str]:
    """Return the command line of pytest, with the user's arguments last."""
    tier = next((_TIERS[argument] for argument in arguments if argument in _TIERS), None)
    if tier is None:
        tier = "all" if _selects(arguments) else "quick"
    arguments = [argument for argument in arguments if argument not in _TIERS]
    command = [sys.executable, "-m", "pytest", "-p", "fognav.pytest_progress", "-r", "fE", f"--tier={tier}"]
    if sys.stderr.isatty() if terminal is None else terminal:
        command += ["-o", "console_output_style=classic"]  # the bar shows the progress
    if not any(argument.startswith(_OVERRIDES) for argument in arguments):
        command += ["-n", str(workers(tier)), "--dist", "loadgroup", "--no-loadscope-reorder"]
    return [*command, *arguments]


def _selects(arguments: Sequence[str]) -> bool:
    """Whether the user says which tests to run, by their path, a name or a marker: then no tier leaves one out."""
    paths = (argument.partition("::")[0] for argument in arguments if not argument.startswith("-"))
    by_name = any(argument.startswith(("-k", "-m")) for argument in arguments)
    return by_name or any((checkout.root() / path).exists() for path in paths)


def get_optional_tools(*, yes: bool, print_line: Callable[[str], None]) -> None:
    """Install, given consent, missing programs that some tests need; without them those tests are skipped."""
    if not system.has_consent(yes):
        return
    for tool in system.TOOLS:
        if tool.required or system.find(tool) is not None:
            continue
        try:
            system.ensure([tool], yes=yes, print_line=print_line)
        except system.MissingToolsError as error:
            print_line(f"skipping tests that need {tool.name} ({tool.purpose}): {error}")
