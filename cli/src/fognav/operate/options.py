"""Options that several commands have, and the texts of points and shapes in their arguments."""

import datetime as dt
import math
import re
from typing import Annotated, Final

import msgspec
import typer

from fog_contracts.messages import WEEKDAYS, Id
from fognav.output import WrongUseError

FogOption = Annotated[
    str | None,
    typer.Option(
        "--fog",
        metavar="ADDRESS",
        help="Host of a fog node, or a name from fognav status; default: FOGNAV_FOG, else the one that runs here.",
    ),
]
RobotOption = Annotated[
    str | None, typer.Option("--robot", metavar="ID", help="The robot; not needed where there is only one.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Write one JSON object to standard output.")]
YesOption = Annotated[
    bool, typer.Option("--yes", help="Install missing system packages without asking (as does CI=true).")
]

Point = tuple[float, float]

NUMBERS: Final = {"ignore_unknown_options": True}
"""Context settings of a command whose arguments may begin with a minus sign."""


def numbers(text: str, count: tuple[int, ...], form: str) -> list[float]:
    """Return the numbers of a text like `1.5,-2`; raises `WrongUseError` that shows the `form`."""
    try:
        found = [float(part) for part in text.split(",")]
    except ValueError:
        found = []
    if len(found) not in count or not all(math.isfinite(value) for value in found):
        raise WrongUseError(f"{text!r} is not {form}, such as {_example(form)}; metres, separated by commas")
    return found


def checked_id(text: str) -> str:
    """Return the id of a robot, node or user; raises `WrongUseError` for what can be none."""
    try:
        return msgspec.convert(text, Id)
    except msgspec.ValidationError as error:
        raise WrongUseError(f"{text!r}: an id has only a to z, 0 to 9 and -, at most 32") from error


_UNITS: Final = {"s": 1.0, "m": 60.0, "h": 3600.0, "d": 86_400.0}


def duration(text: str, option: str) -> float:
    """Return the seconds of a text like `90s`, `15m`, `2h` or `3d`; raises `WrongUseError` that names the option."""
    found = re.fullmatch(r"([0-9]{1,9}(?:\.[0-9]{1,3})?)([smhd])", text.strip())
    if found is None or float(found[1]) <= 0.0:
        raise WrongUseError(f"{option} {text}: give a number and its unit: 90s, 15m, 2h or 3d")
    return float(found[1]) * _UNITS[found[2]]


def moment(text: str, option: str) -> float:
    """Return the Unix time (s) of a text like `2026-11-24T18:30`, here in local time, or `+2h` from now.

    A time may carry its own offset (`…+01:00`, `…Z`). Raises `WrongUseError` that names the option.
    """
    if text.startswith("+"):
        return dt.datetime.now(dt.UTC).timestamp() + duration(text[1:], option)
    try:
        return dt.datetime.fromisoformat(text).timestamp()
    except (ValueError, OverflowError, OSError):
        raise WrongUseError(
            f"{option} {text}: give a time, such as 2026-11-24T18:30 (here) or 2026-11-24T18:30+01:00, or +2h from now"
        ) from None


_WEEKLY: Final = re.compile(r"([a-z]{3}(?:[,-][a-z]{3})*) (\d\d:\d\d)-(\d\d:\d\d)")


def weekly(text: str, option: str) -> dict[str, object]:
    """Return the weekly window of a text like `mon-fri 18:00-20:00` or `sat,sun 08:00-12:00`; raises as `moment`."""
    found = _WEEKLY.fullmatch(text.strip().lower())
    days: list[str] = []
    for part in found[1].split(",") if found else []:
        first, _, last = part.partition("-")
        if not {first, last or first} <= set(WEEKDAYS):
            found = None
            break
        begin, count = WEEKDAYS.index(first), (WEEKDAYS.index(last or first) - WEEKDAYS.index(first)) % len(WEEKDAYS)
        days += [WEEKDAYS[(begin + step) % len(WEEKDAYS)] for step in range(count + 1)]
    if found is None:
        raise WrongUseError(
            f"{option} {text!r}: give days and times, such as 'mon-fri 18:00-20:00' or 'sat,sun 08:00-12:00'"
        )
    return {"days": list(dict.fromkeys(days)), "begin": found[2], "end": found[3]}


def goal_body(text: str) -> dict[str, object]:
    """Return the goal of a text like `office` or `12.5,3[,1.57]` as requests have it; raises `WrongUseError`."""
    if "," not in text:
        try:
            return {"place": msgspec.convert(text, Id)}
        except msgspec.ValidationError as error:
            raise WrongUseError(
                f"{text!r} is neither a place, which has only a to z, 0 to 9 and -, nor X,Y[,THETA], such as "
                "12.5,3,1.57; metres, separated by commas"
            ) from error
    x, y, *theta = numbers(text, (2, 3), "X,Y[,THETA]")
    return {"pose": {"x": x, "y": y, **({"theta": theta[0]} if theta else {})}}


def points(text: str, least: int, form: str) -> list[Point]:
    """Return the points of a text like `0,0 1,0 1,1`; raises `WrongUseError`."""
    found = [numbers(part, (2,), "X,Y") for part in text.split()]
    if len(found) < least:
        raise WrongUseError(f"{text!r} has {len(found)} points, but {form} needs at least {least}: 'X,Y X,Y …'")
    return [(x, y) for x, y in found]


def _example(form: str) -> str:
    values = {"X": "12.5", "Y": "3", "R": "0.5", "THETA": "1.57", "X2": "14", "Y2": "4.5"}
    return ",".join(values[name] for name in form.replace("[", "").replace("]", "").split(","))
