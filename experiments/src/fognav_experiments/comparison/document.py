"""A document of headings, paragraphs, tables and figures, as Markdown and as one HTML file. Pure."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

_STYLE: Final = (
    "body{font:16px/1.5 sans-serif;max-width:60em;margin:2em auto;padding:0 1em;color:#222}"
    "table{border-collapse:collapse;margin:1em 0}td,th{border:1px solid #ccc;padding:.3em .6em;text-align:left}"
    "th{background:#f3f3f3}svg{max-width:100%;height:auto}code{background:#f3f3f3;padding:0 .2em}"
)


@dataclass(frozen=True, slots=True)
class Heading:
    """A heading; level 1 is the title."""

    text: str
    level: int = 2


@dataclass(frozen=True, slots=True)
class Paragraph:
    """A paragraph of plain text."""

    text: str


@dataclass(frozen=True, slots=True)
class Code:
    """Lines to be typed, or read as they are."""

    text: str


@dataclass(frozen=True, slots=True)
class Table:
    """A table of plain text."""

    header: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True, slots=True)
class Figure:
    """A figure as SVG, with the name of its file and a caption."""

    file: str
    svg: str
    caption: str


Block = Heading | Paragraph | Code | Table | Figure


def to_markdown(blocks: Sequence[Block]) -> str:
    """Return the document as Markdown, with its figures as files beside it."""
    return "\n\n".join(_markdown(block) for block in blocks) + "\n"


def _markdown(block: Block) -> str:
    match block:
        case Heading():
            return f"{'#' * block.level} {block.text}"
        case Paragraph():
            return block.text
        case Code():
            return f"```\n{block.text}\n```"
        case Table():
            rows = [block.header, ["---"] * len(block.header), *block.rows]
            return "\n".join(f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in row)} |" for row in rows)
        case Figure():
            return f"![{block.caption}]({block.file})\n\n*{block.caption}*"


def to_html(title: str, blocks: Sequence[Block]) -> str:
    """Return the document as one HTML file that needs no other."""
    body = "\n".join(_html(block) for block in blocks)
    return (
        f'<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f"<style>{_STYLE}</style></head><body>\n{body}\n</body></html>\n"
    )


def _html(block: Block) -> str:
    match block:
        case Heading():
            return f"<h{block.level}>{escape(block.text)}</h{block.level}>"
        case Paragraph():
            return f"<p>{escape(block.text)}</p>"
        case Code():
            return f"<pre><code>{escape(block.text)}</code></pre>"
        case Table():
            rows = "".join(f"<tr>{_cells(row, 'td')}</tr>" for row in block.rows)
            return f"<table><tr>{_cells(block.header, 'th')}</tr>{rows}</table>"
        case Figure():
            return f"<figure>{block.svg}<figcaption>{escape(block.caption)}</figcaption></figure>"


def _cells(row: Sequence[str], kind: str) -> str:
    return "".join(f"<{kind}>{escape(cell)}</{kind}>" for cell in row)


def flat(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, Any]]:
    """Return nested values as pairs of a name and a value."""
    found = []
    for name, value in values.items():
        found += flat(value, f"{prefix}{name} ") if isinstance(value, dict) else [(f"{prefix}{name}", value)]
    return found
