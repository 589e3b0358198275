"""Writes what was measured or seen into a robot's settings file, the old values beside the new ones as comments."""

from __future__ import annotations

import datetime as dt
from typing import TYPE_CHECKING, Any

import tomlkit
from tomlkit.exceptions import TOMLKitError

from fog_contracts.generate.robot_toml import setting_text
from fog_runtime.configuration.robot_file import parse_robot
from fog_runtime.files import SHARED, atomic_write
from fognav.output import WrongUseError, writing
from robot_agent import registry
from robot_agent.agent.settings import read_footprint, refuse_body, refuse_contradictions

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

Change = tuple[str, object, object]
"""A setting by its dotted name, its value before, by which a file without it goes, and its value now."""


def write(robot_file: Path, changed: Iterable[Change], verb: str, source: str) -> None:
    """Write new values into a robot's file; each comment says `verb`, today, and (`source`).

    A file that `robot check` would refuse is not written. Raises `WrongUseError`, or `SettingsError` for new values.
    """
    try:
        document = tomlkit.parse(robot_file.read_text("utf-8"))
    except (OSError, UnicodeDecodeError, TOMLKitError) as error:
        raise WrongUseError(f"{robot_file}: {error}. Name the robot's settings file") from error
    today = dt.datetime.now(tz=dt.UTC).date().isoformat()
    for setting, before, now in changed:
        *tables, key = setting.split(".")
        table: Any = document
        for name in tables:
            if name not in table:
                table[name] = tomlkit.table()
            table = table[name]
        if key in table:
            written = tomlkit.item(table[key])
            before = written.as_string()  # noqa: PLW2901  # as the person wrote it
            if "\n" in before:
                before = setting_text(written.unwrap())  # noqa: PLW2901  # a comment has one line
        else:
            before = setting_text(before)  # noqa: PLW2901  # the default
        value = tomlkit.item(now)
        value.comment(f"{verb} {today} ({source}), before: {before}")
        table[key] = value
    changed_text = tomlkit.dumps(document)
    robot = parse_robot(changed_text, robot_file, {})
    base, footprint = registry.make_base(robot), read_footprint(robot)
    refuse_contradictions(robot, base)
    if footprint is not None:
        refuse_body(robot, base, footprint)
    with writing(robot_file, "Name another file"):
        atomic_write(robot_file, changed_text.encode(), mode=SHARED)
