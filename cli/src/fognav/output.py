"""Output of the command: answers on standard output, one JSON object for scripts; progress and errors beside it."""

import datetime as dt
import json
import os
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Final, NoReturn, TypeVar

import typer
from rich.console import Console

from fog_runtime.configuration.settings import SettingsError
from fog_runtime.configuration.site import SiteError
from fog_runtime.token_file import TokensError
from fog_supervisor.servers import ServerError
from fog_supervisor.supervisor import NotReadyError
from fognav import __version__

T = TypeVar("T")

SCHEMA: Final = 1
"""Version of the JSON objects; incremented when a key changes its meaning or is removed."""

OK: Final = 0
NOT_TRUE: Final = 1
"""The command worked, but its result is negative: a failed check or drive."""
WRONG_USE: Final = 2

console = Console(stderr=True, highlight=False, width=None if sys.stderr.isatty() else 200)
answers = Console(highlight=False, width=None if sys.stdout.isatty() else 200)


class WrongUseError(ValueError):
    """An option, argument or file can't be used; the message names it and the remedy."""


class FailedError(RuntimeError):
    """What was asked for did not come true; the message names the thing, the place and the remedy."""


def print_line(text: str) -> None:
    """Write a line of what happens, for people, to standard error."""
    console.print(text, markup=False)


def print_answer(text: str) -> None:
    """Write a line of what was asked for, for people and their pipes, to standard output."""
    answers.print(text, markup=False, soft_wrap=True)


def fail(message: str, code: int = NOT_TRUE) -> NoReturn:
    """Print an error and end the command with an exit code."""
    console.print(f"fognav: {message}", markup=False, style="red", soft_wrap=True)
    raise typer.Exit(code)


@contextmanager
def exit_codes() -> Iterator[None]:
    """Turn the errors of a command into their messages and exit codes."""
    try:
        yield
    except (WrongUseError, SiteError, SettingsError) as error:
        fail(str(error), WRONG_USE)
    except (FailedError, NotReadyError, ServerError, TokensError) as error:
        fail(str(error))


def envelope(values: Mapping[str, object]) -> dict[str, object]:
    """Return the values with the keys that every JSON object of this command has."""
    return {"schema": SCHEMA, "fognav": __version__, **values}


def to_json(values: Mapping[str, object]) -> str:
    """Encode an object as indented JSON with its envelope; raises `ValueError` for NaN and infinity."""
    return json.dumps(envelope(values), indent=2, ensure_ascii=False, allow_nan=False)


def print_json(values: Mapping[str, object]) -> None:
    """Write the JSON object of this command to standard output."""
    sys.stdout.write(to_json(values) + "\n")
    sys.stdout.flush()


def local_time(stamp: float) -> str:
    """Return a Unix time (s) as people of this computer write it."""
    return dt.datetime.fromtimestamp(stamp, dt.UTC).astimezone().isoformat(" ", "seconds")


def print_result(
    values: Mapping[str, object], *lines: str, json: bool, write: Callable[[str], None] = print_answer
) -> None:
    """Tell what a command has done: by the JSON object of this command, or to people by lines."""
    if json:
        print_json(values)
        return
    for line in lines:
        write(line)


def print_list(name: str, found: Sequence[T], line: Callable[[T], str], *, json: bool) -> None:
    """Write what was asked for to standard output: a list in the JSON object, or a line for each, for people."""
    print_result({name: found}, *(map(line, found) if found else [f"no {name}"]), json=json)


@contextmanager
def writing(path: Path, remedy: str = "Name another file") -> Iterator[None]:
    """Turn an error of writing a file into `WrongUseError` with the remedy."""
    try:
        yield
    except OSError as error:
        raise WrongUseError(f"{path} can't be written: {error.strerror}. {remedy}") from error


def write_report(path: Path, values: Mapping[str, object]) -> None:
    """Write the JSON object to a file; raises `WrongUseError` if the file can't be written."""
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(to_json(values) + "\n", encoding="utf-8")


def check_writable(path: Path | None) -> None:
    """Raise `WrongUseError` if a file can't be written, before the work whose result it shall hold; None is allowed."""
    if path is None:
        return
    if not path.parent.is_dir():
        raise WrongUseError(
            f"{path} can't be written: there is no folder {path.parent}. Create it or name another file"
        )
    is_other = path.exists() and not path.is_file()
    if is_other or not os.access(path if path.exists() else path.parent, os.W_OK):
        reason = "it is a folder or a device" if is_other else "you may not write there"
        raise WrongUseError(f"{path} can't be written: {reason}. Name another file")
