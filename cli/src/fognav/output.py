"""What the command says: people read standard error, machines read one JSON object on standard output."""

import json
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from rich.console import Console

from fognav import __version__

SCHEMA: Final = 1
"""Version of the JSON objects' keys; grows when a key changes its meaning or goes."""

OK: Final = 0
NOT_TRUE: Final = 1
"""The thing that was asked for did not come true."""
WRONG_USE: Final = 2

console = Console(stderr=True, highlight=False, width=None if sys.stderr.isatty() else 200)


class WrongUseError(ValueError):
    """The command was called with something that can't be used; the message names it, and the remedy."""


def envelope(values: Mapping[str, object]) -> dict[str, object]:
    """Return the values with what every JSON object of this command carries."""
    return {"schema": SCHEMA, "fognav": __version__, **values}


def to_json(values: Mapping[str, object]) -> str:
    """Spell an object as indented JSON with its envelope; NaN and infinity are refused, for JSON has none."""
    return json.dumps(envelope(values), indent=2, ensure_ascii=False, allow_nan=False)


def print_json(values: Mapping[str, object]) -> None:
    """Write the one object of this command to standard output."""
    sys.stdout.write(to_json(values) + "\n")
    sys.stdout.flush()


def write_report(path: Path, values: Mapping[str, object]) -> None:
    """Write the object to a file; raises `WrongUseError` when the file can't be written."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(to_json(values) + "\n", encoding="utf-8")
    except OSError as error:
        raise WrongUseError(f"the report can't be written to {path}: {error.strerror}. Name another file") from error


def check_writable(path: Path | None) -> None:
    """Refuse a file that can't be written before the work whose outcome it is to hold; None is no file."""
    if path is None:
        return
    if not path.parent.is_dir():
        raise WrongUseError(f"{path} can't be written: there is no folder {path.parent}. Make it, or name another file")
    if path.is_dir() or not os.access(path if path.exists() else path.parent, os.W_OK):
        raise WrongUseError(f"{path} can't be written: it is a folder, or you may not write there. Name another file")
