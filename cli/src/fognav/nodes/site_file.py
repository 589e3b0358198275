"""A node's table in `site.toml`: added, or replaced with all other lines left as they are."""

from __future__ import annotations

import re
import tomllib
from typing import TYPE_CHECKING

from fog_runtime.configuration.site import SITE_FILE, LoadedSite, SiteError, load_site
from fog_runtime.files import SHARED, atomic_write
from fognav.output import FailedError, WrongUseError
from fognav.site_text import node_lines

if TYPE_CHECKING:
    from pathlib import Path

    from fog_contracts.site import NodeSite

_TABLE = re.compile(r"^\s*\[")
_NODE_TABLE = re.compile(r"^\s*\[\[\s*nodes\s*\]\]")


def load(folder: Path) -> LoadedSite:
    """Load a site; raises `WrongUseError` with what is wrong with it."""
    try:
        return load_site(folder)
    except SiteError as error:
        raise WrongUseError(str(error)) from error


def node_of(loaded: LoadedSite, name: str) -> NodeSite:
    """Return a node of a site; raises `WrongUseError` with the names that there are."""
    for node in loaded.site.nodes:
        if node.id == name:
            return node
    names = ", ".join(node.id for node in loaded.site.nodes) or "none"
    raise WrongUseError(f"{loaded.directory / SITE_FILE} has no node {name!r}: it has {names}")


def with_node(loaded: LoadedSite, node: NodeSite) -> str:
    """Return the text of the site's file with one more node; raises `WrongUseError` if that makes the site invalid."""
    text = _read(loaded.directory).rstrip("\n") + "\n\n" + "\n".join(node_lines(node))
    _check(loaded.directory, text)
    return text


def replace(loaded: LoadedSite, node: NodeSite) -> None:
    """Replace a node's table in the site's file; raises `WrongUseError` if that makes the site invalid.

    Comments between the lines of its table are lost. Raises `FailedError` for a file that is written in another way.
    """
    text = _read(loaded.directory)
    new = replaced(text, node)
    if new is None:
        block = "\n".join(node_lines(node))
        raise FailedError(
            f"the table of node {node.id} was not found in {loaded.directory / SITE_FILE}: replace it by\n{block}"
        )
    _check(loaded.directory, new)
    write(loaded, new)


def replaced(text: str, node: NodeSite) -> str | None:
    """Return the text of a site's file with another table of a node, or None if that is written in another way."""
    lines = text.splitlines(keepends=True)
    begin, end = _table_of(lines, node.id)
    # Comments after the table are about what follows.
    while end > begin and (not lines[end - 1].strip() or lines[end - 1].lstrip().startswith("#")):
        end -= 1
    if begin == end:
        return None
    new = "\n".join(node_lines(node)).rstrip("\n") + "\n"
    return "".join(lines[:begin]) + new + "".join(lines[end:])


def _table_of(lines: list[str], name: str) -> tuple[int, int]:
    """Return the first line of a node's table and the one after its last, or an empty range."""
    starts = [index for index, line in enumerate(lines) if _TABLE.match(line)]
    for index, start in enumerate(starts):
        end = starts[index + 1] if index + 1 < len(starts) else len(lines)
        if not _NODE_TABLE.match(lines[start]):
            continue
        try:
            table = tomllib.loads("".join(lines[start:end]))
        except tomllib.TOMLDecodeError:
            continue  # a table with tables of its own, whose lines end elsewhere
        if table["nodes"][0].get("id") == name:
            return start, end
    return 0, 0


def _read(folder: Path) -> str:
    try:
        return (folder / SITE_FILE).read_text("utf-8")
    except OSError as error:
        raise WrongUseError(f"{folder / SITE_FILE} can't be read: {error.strerror}") from error


def _check(folder: Path, text: str) -> None:
    """Raise `WrongUseError` for an invalid text before it replaces the file: a service may read that at any time."""
    try:
        load_site(folder, text)
    except SiteError as error:
        raise WrongUseError(f"{error} (nothing was changed)") from error


def write(loaded: LoadedSite, text: str) -> None:
    """Replace the site's file by a text that was found valid; raises `WrongUseError`."""
    file = loaded.directory / SITE_FILE
    try:
        atomic_write(file, text.encode(), mode=SHARED)
    except OSError as error:
        raise WrongUseError(f"{file} can't be written: {error.strerror}") from error
