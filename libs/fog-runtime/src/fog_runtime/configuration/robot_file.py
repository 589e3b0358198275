"""A robot's settings: `robot.toml` (FOGNAV_ROBOT_FILE), with single values overridden by variables.

Without a file the robot is the thesis's: a Roomba 600 with an RPLidar A1 and every default.
"""

import re
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, TypeVar

import msgspec

from fog_contracts.robot import BaseSettings, LidarSettings, RobotSettings
from fog_runtime.configuration.parts import DEFAULT_BASE, DEFAULT_LIDAR
from fog_runtime.configuration.settings import SettingsError

_PART: Final = r"""(?:[A-Za-z0-9_-]+|"[^"]*"|'[^']*')"""
_DOTTED: Final = rf"{_PART}(?:\s*\.\s*{_PART})*"
_HEADER: Final = re.compile(rf"\s*\[\[?\s*({_DOTTED})\s*\]")
_KEY: Final = re.compile(rf"\s*({_DOTTED})\s*=")
_TOKEN: Final = re.compile(
    r'"""(?:\\.|[^\\])*?"""|\'\'\'.*?\'\'\'|"(?:\\.|[^"\\\n])*"|\'[^\'\n]*\'|#[^\n]*|[\[{]|[\]}]|\n', re.DOTALL
)


def key_lines(text: str) -> dict[str, int]:
    """Return the line, from 1, of every table and key of a valid TOML text, by their dotted names.

    Keys inside of an inline table or an array of several lines are not listed: look for the name that leads to them.
    """
    lines: dict[str, int] = {}
    table = ""
    for number, line in _statements(text):
        if (header := _HEADER.match(line)) is not None:
            table = _plain(header.group(1))
            lines.setdefault(table, number)
        elif (key := _KEY.match(line)) is not None:
            name = _plain(key.group(1))
            lines.setdefault(f"{table}.{name}" if table else name, number)
    return lines


def find_line(lines: dict[str, int], key: str) -> int | None:
    """Return the line of a key, else of the innermost table or value around it; None if there is none."""
    while key:
        if key in lines:
            return lines[key]
        key = key.rpartition(".")[0]
    return None


def _statements(text: str) -> list[tuple[int, str]]:
    """Return each statement with the number of its first line; strings and brackets may span lines."""
    found: list[tuple[int, str]] = []
    begin = depth = 0
    number = 1
    for token in _TOKEN.finditer(text):
        kind = token.group()
        if kind == "\n" and depth == 0:
            found.append((number, text[begin : token.start()]))
            number += text.count("\n", begin, token.end())
            begin = token.end()
        elif kind in "[{":
            depth += 1
        elif kind in "]}":
            depth -= 1
    found.append((number, text[begin:]))
    return found


def _plain(dotted: str) -> str:
    return ".".join(part.strip().strip("\"'") for part in dotted.split("."))


ROBOT_FILE: Final = "FOGNAV_ROBOT_FILE"
"""The variable that names the file."""
VARIABLES: Final[Mapping[str, str]] = {
    "base.driver": "FOGNAV_BASE",
    "base.port": "FOGNAV_BASE_PORT",
    "base.options": "FOGNAV_BASE_OPTIONS",
    "lidar.driver": "FOGNAV_LIDAR",
    "lidar.port": "FOGNAV_LIDAR_PORT",
    "lidar.options": "FOGNAV_LIDAR_OPTIONS",
    "body.footprint": "FOGNAV_FOOTPRINT",
}
"""Settings that a variable overrides; a value that is no text is written as JSON."""
_JSON: Final = frozenset({"base.options", "lidar.options", "body.footprint"})

Options = TypeVar("Options", bound=msgspec.Struct)


@dataclass(frozen=True, kw_only=True)
class RobotFile:
    """A robot's effective settings, and where each of them was read."""

    settings: RobotSettings
    path: Path | None = None
    lines: dict[str, int] = field(default_factory=dict)
    variables: Mapping[str, str] = field(default_factory=dict)
    """The variables that were set, by the setting that each overrides."""

    def error(self, key: str, problem: str, remedy: str = "Correct it") -> SettingsError:
        """Return an error that names the place of a setting, the problem and the remedy."""
        return SettingsError(f"{_place(key, self.path, self.lines, self.variables)}: {problem}. {remedy}", key)

    def options(self, part: str, kind: type[Options]) -> Options:
        """Return the options of a driver, `part` being "base" or "lidar", as its own type; raises `SettingsError`."""
        given = self.settings.base.options if part == "base" else self.settings.lidar.options
        try:
            return msgspec.convert(given, kind)
        except msgspec.ValidationError as error:
            key, problem = _explain(error)
            known = ", ".join(item.encode_name for item in msgspec.structs.fields(kind)) or "none"
            remedy = _values_remedy(kind, key, given) or f"Its options: {known}"
            raise self.error(f"{part}.options{'.' if key else ''}{key}", problem, remedy) from error


def default_robot(base: str = DEFAULT_BASE, lidar: str = DEFAULT_LIDAR) -> RobotFile:
    """Return a robot with these drivers, and the default of every other setting."""
    return RobotFile(settings=RobotSettings(base=BaseSettings(driver=base), lidar=LidarSettings(driver=lidar)))


def load_robot(environ: Mapping[str, str]) -> RobotFile:
    """Read the file that FOGNAV_ROBOT_FILE names, and the variables that override it; raises `SettingsError`."""
    path = Path(environ[ROBOT_FILE]) if environ.get(ROBOT_FILE) else None
    return parse_robot(_text(path) if path else None, path, environ)


def parse_robot(text: str | None, path: Path | None, environ: Mapping[str, str]) -> RobotFile:
    """Return the settings in the text of a robot file (None: there is no file); raises `SettingsError`."""
    tree, lines = _tree(text, path)
    variables = {key: variable for key, variable in VARIABLES.items() if environ.get(variable)}
    for key, variable in variables.items():
        _override(tree, key, _value(key, variable, environ[variable]))
    try:
        settings = msgspec.convert(tree, RobotSettings)
    except msgspec.ValidationError as error:
        key, problem = _explain(error)
        place = _place(key, path, lines, variables)
        raise SettingsError(f"{place}: {problem}. {_remedy(key, path, tree)}", key) from error
    return RobotFile(settings=settings, path=path, lines=lines, variables=variables)


def describe_robot(robot: RobotFile, base_options: msgspec.Struct, lidar_options: msgspec.Struct) -> dict[str, object]:
    """Return all effective settings by their dotted names, the drivers' defaults included: for the log."""
    shown = msgspec.to_builtins(robot.settings)
    shown["base"]["options"] = msgspec.to_builtins(base_options)
    shown["lidar"]["options"] = msgspec.to_builtins(lidar_options)
    return {"file": str(robot.path) if robot.path else None, **_flat(shown)}


def _flat(tree: Mapping[str, Any], prefix: str = "") -> dict[str, object]:
    flat: dict[str, object] = {}
    for key, value in tree.items():
        if isinstance(value, dict):
            flat.update(_flat(value, f"{prefix}{key}."))
        else:
            flat[prefix + key] = value
    return flat


def _text(path: Path) -> str:
    try:
        return path.read_text("utf-8-sig")  # some editors begin a file with a mark that TOML does not know
    except OSError as error:
        raise SettingsError(
            f"{ROBOT_FILE}: {path} can't be read: {error.strerror}. Name a file that `fognav robot new` wrote"
        ) from error
    except UnicodeDecodeError as error:
        raise SettingsError(
            f"{ROBOT_FILE}: {path} can't be read: it is no text in UTF-8 ({error}). Save it as UTF-8, or name a file "
            "that `fognav robot new` wrote"
        ) from error


def _tree(text: str | None, path: Path | None) -> tuple[dict[str, Any], dict[str, int]]:
    if text is None:
        return {"base": {"driver": DEFAULT_BASE}, "lidar": {"driver": DEFAULT_LIDAR}}, {}
    try:
        return tomllib.loads(text), key_lines(text)
    except tomllib.TOMLDecodeError as error:
        raise SettingsError(f"{path} is not valid TOML: {error}. Correct that line") from error


def _value(key: str, variable: str, text: str) -> object:
    if key not in _JSON:
        return text
    try:
        return msgspec.json.decode(text)
    except (msgspec.DecodeError, UnicodeEncodeError) as error:
        raise SettingsError(f"{variable}: {error}. Give it as JSON") from error


def _override(tree: dict[str, Any], key: str, value: object) -> None:
    part, _, name = key.partition(".")
    table = tree.setdefault(part, {})
    if not isinstance(table, dict):
        return  # the conversion names the mistake
    if name == "driver" and table.get("driver") != value:
        table.pop("options", None)  # they are another driver's
    if name == "options" and isinstance(value, dict) and isinstance(table.get(name), dict):
        value = {**table[name], **value}
    table[name] = value


def _explain(error: msgspec.ValidationError) -> tuple[str, str]:
    """Return the dotted name of the setting that an error means, and the problem."""
    problem, _, path = str(error).partition(" - at ")
    key = path.strip("`").removeprefix("$").lstrip(".").partition("[")[0]
    for words in ("Object contains unknown field `", "Object missing required field `"):
        if problem.startswith(words):
            name = problem.removeprefix(words).rstrip("`")
            key = f"{key}.{name}" if key else name
            problem = "there is no such setting" if "unknown" in words else "this setting is missing"
    return key, problem


def _remedy(key: str, path: Path | None, tree: Mapping[str, Any]) -> str:
    kind: Any = RobotSettings
    table: object = tree
    *tables, name = key.split(".")
    for inner in tables:
        fields = {item.encode_name: item.type for item in msgspec.structs.fields(kind)}
        if inner not in fields or not isinstance(fields[inner], type):
            break
        kind = fields[inner]
        table = table.get(inner) if isinstance(table, Mapping) else None
    if isinstance(table, Mapping) and (remedy := _values_remedy(kind, name, table)):
        return remedy
    known = ", ".join(item.encode_name for item in msgspec.structs.fields(kind))
    return f"Correct it{' there' if path else ''}; settings at this place: {known}"


def _values_remedy(kind: type[msgspec.Struct], name: str, table: Mapping[str, Any]) -> str:
    """Return what a setting with a wrong value has and what it takes; empty if it is missing, unknown or a table."""
    # Only who has made a mistake waits for it: the watchdog reads this file, too, and needs none of it.
    from fog_contracts.generate.robot_toml import accepted_values, setting_text  # noqa: PLC0415  # errors alone need it

    values = accepted_values(kind, name)
    given = table.get(name)
    if not values or given is None or isinstance(given, Mapping):
        return ""
    return f"It has {setting_text(given)}, and takes {values}"


def _place(key: str, path: Path | None, lines: dict[str, int], variables: Mapping[str, str]) -> str:
    for setting, variable in variables.items():
        if key == setting or key.startswith(f"{setting}."):
            return f"{variable}{key.removeprefix(setting)}"
    line = find_line(lines, key)
    file = f"{path}:{line}" if line else f"{path}"
    return f"{file}: {key}" if path and key else file if path else key
