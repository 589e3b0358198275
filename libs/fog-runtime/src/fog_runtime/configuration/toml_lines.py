"""Where in a TOML file each setting stands, for messages that name the line; `tomllib` reads the values."""

import re
from typing import Final

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
