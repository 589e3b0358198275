"""How `fognav test` runs pytest: on all cores, with progress, and with a browser where one can be had."""

import os
import sys
from collections.abc import Callable, Sequence
from typing import Final

from fognav import system

_OWN_WAY: Final = ("-n", "--numprocesses", "--dist", "--pdb", "--trace", "--collect-only", "--co", "-s", "--capture=no")
"""Arguments of people who want pytest to run in another way, or in one process."""


def workers() -> int:
    """Return how many tests run at once: one for each core, and one more, for most tests of processes wait."""
    return (os.cpu_count() or 1) + 1


def pytest_command(arguments: Sequence[str], *, terminal: bool | None = None) -> list[str]:
    """Return the command line of pytest, with a person's own arguments last."""
    command = [sys.executable, "-m", "pytest", "-p", "fognav.pytest_progress", "-r", "fE"]
    if sys.stderr.isatty() if terminal is None else terminal:
        command += ["-o", "console_output_style=classic"]  # the bar says how far it is
    if not any(argument.startswith(_OWN_WAY) for argument in arguments):
        command += ["-n", str(workers()), "--dist", "loadgroup", "--no-loadscope-reorder"]
    return [*command, *arguments]


def get_browser(*, yes: bool, say: Callable[[str], None]) -> None:
    """Install a browser for the tests of the page if it is missing and that is agreed; they are skipped without it."""
    if system.find(system.CHROMIUM) is not None or not system.agreed(yes):
        return
    try:
        system.ensure([system.CHROMIUM], yes=yes, say=say)
    except system.MissingToolsError as error:
        say(f"no tests of the page: {error}")
