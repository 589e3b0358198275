"""A commented `robot.toml` and the document of its settings, from their types: they can't go stale."""

import math
from collections.abc import Iterable, Iterator, Mapping
from textwrap import wrap
from typing import Any, Final, NamedTuple

import msgspec
from msgspec import inspect

from fog_contracts.generate import NOTE
from fog_contracts.robot import RobotSettings

_WIDTH: Final = 100


class Setting(NamedTuple):
    """One setting: its name, its value or default, what it means and which values it takes."""

    name: str
    value: Any
    description: str
    values: str


class Table(NamedTuple):
    """One table: its dotted name, its type's description, and its settings."""

    name: str
    description: str
    settings: list[Setting]


def robot_toml(settings: RobotSettings, base_options: msgspec.Struct, lidar_options: msgspec.Struct) -> str:
    """Return a `robot.toml` with every setting, its description and its range; loading it gives the same values."""
    parts = [
        "# A robot's settings. Lengths in m, angles in rad, times in s; x forward, y to the left of the point between"
    ]
    parts.append("# the driven wheels. Check it with: fognav robot check FILE")
    for table in tables(settings, {"base.options": base_options, "lidar.options": lidar_options}):
        parts += ["", *_comment(table.description), f"[{table.name}]"]
        for setting in table.settings:
            note = f"{setting.description} ({setting.values})" if setting.values else setting.description
            parts += [*_comment(note), f"{setting.name} = {_toml(setting.value)}"]
    return "\n".join(parts) + "\n"


def tables(settings: msgspec.Struct, options: Mapping[str, msgspec.Struct], prefix: str = "") -> Iterator[Table]:
    """Yield a table for each struct in `settings`; `options` are the drivers' own, by the table's dotted name."""
    kind = inspect.type_info(type(settings))
    assert isinstance(kind, inspect.StructType)
    own: list[Setting] = []
    inner: list[tuple[str, msgspec.Struct]] = []
    for field in kind.fields:
        name, value = prefix + field.encode_name, getattr(settings, field.name)
        if name in options:
            inner.append((name, options[name]))
        elif isinstance(value, dict):
            continue  # the options of a driver, whose type is not given
        elif isinstance(value, msgspec.Struct):
            inner.append((name, value))
        else:
            description, values = _described(field.type)
            own.append(Setting(field.encode_name, value, description, values))
    if own:
        yield Table(prefix.rstrip("."), _first_sentence(type(settings)), own)
    for name, struct in inner:
        yield from tables(struct, options, f"{name}.")


def accepted_values(kind: type[msgspec.Struct], name: str) -> str:
    """Return which values a setting of a table takes, in words; empty if it has no such setting, or takes any text."""
    table = inspect.type_info(kind)
    assert isinstance(table, inspect.StructType)
    types = {field.encode_name: field.type for field in table.fields}
    if name not in types:
        return ""
    inner = types[name]
    while isinstance(inner, inspect.Metadata):
        inner = inner.type
    if isinstance(inner, inspect.StructType | inspect.DictType):
        return f"a table, [{name}]"
    if isinstance(inner, inspect.StrType):
        return "a name of letters, digits, ., _ and -, in quotes" if inner.pattern else "a text in quotes"
    return _values(inner)


def setting_text(value: object) -> str:
    """Return a value of any kind that a TOML file can have, as it has it there."""
    return _toml(value)


def robot_settings_markdown(settings: RobotSettings, drivers: Iterable[tuple[str, msgspec.Struct]]) -> str:
    """Return the document of all settings; `drivers` are the options of each driver, by the table's title."""
    lines = [
        "# Settings of a robot",
        "",
        f"<!-- {NOTE} -->",
        "",
        "`fognav robot new` writes a `robot.toml` with all of them, `fognav robot check` checks one and prints what it",
        "sets. `FOGNAV_ROBOT_FILE` names it to watchdog, guardian, agent and simulator. Lengths in m, angles in rad,",
        "times in s; x forward, y to the left of the point between the driven wheels.",
    ]
    for table in tables(settings, {}):
        lines += _section(f"## `[{table.name}]`", table)
    for title, options in drivers:
        for table in tables(options, {}, "options."):
            lines += _section(f"## {title}", table)
    return "\n".join(lines) + "\n"


def _section(title: str, table: Table) -> list[str]:
    rows = [
        f"| `{setting.name}` | `{_toml(setting.value)}` | {setting.values} | {setting.description} |"
        for setting in table.settings
    ]
    return [
        "",
        title,
        "",
        table.description,
        "",
        "| setting | default | values | meaning |",
        "|---|---|---|---|",
        *rows,
    ]


def _first_sentence(kind: type) -> str:
    return (kind.__doc__ or "").split("\n\n", maxsplit=1)[0].replace("\n    ", " ").strip()


def _described(kind: inspect.Type) -> tuple[str, str]:
    description = ""
    while isinstance(kind, inspect.Metadata):
        description = description or (kind.extra_json_schema or {}).get("description", "")
        kind = kind.type
    return description, _values(kind)


def _values(kind: inspect.Type) -> str:  # noqa: PLR0911  # one answer per kind of setting
    while isinstance(kind, inspect.Metadata):
        kind = kind.type
    if isinstance(kind, inspect.BoolType):
        return "true or false"
    if isinstance(kind, inspect.StrType):
        return ""
    if isinstance(kind, inspect.LiteralType):
        return " or ".join(_toml(value) for value in kind.values)
    if isinstance(kind, inspect.TupleType):
        return f"[{len(kind.item_types)} numbers, {_values(kind.item_types[0])}]"
    if isinstance(kind, inspect.ListType):
        return f"list of {_values(kind.item_type)}"
    if isinstance(kind, inspect.FloatType | inspect.IntType):
        low = kind.ge if kind.ge is not None else kind.gt
        high = kind.le if kind.le is not None else kind.lt
        above = "above " if kind.ge is None else ""
        if low is None or high is None:
            return "a number"
        return f"{above}{low:g} to {high:g}"
    raise TypeError(f"robot.toml has no way to write {kind}: use numbers, text, lists or tables")


def _comment(text: str) -> list[str]:
    return [f"# {line}" for line in wrap(text, _WIDTH, break_on_hyphens=False)]


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    if isinstance(value, list | tuple):
        return f"[{', '.join(_toml(item) for item in value)}]"
    if isinstance(value, str):
        return msgspec.json.encode(value).decode()
    return str(value)
