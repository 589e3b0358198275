"""Which source files a kernel is compiled from: its own module's, and those of Fognav's modules that it imports."""

from __future__ import annotations

import hashlib
import importlib.util
import re
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from collections.abc import Iterator

_IMPORT: Final = re.compile(
    r"^(?:from (fog_\w+(?:\.\w+)*) import (\([^)]*\)|[^\n#]*)|import (fog_\w+(?:\.\w+)*))", re.MULTILINE
)
"""An import that is not indented: those below `if TYPE_CHECKING:` are compiled into nothing."""
_NAME: Final = re.compile(r"\w+")
_KERNELS: Final = "fog_kernels"


@cache
def sources_of(file: Path) -> frozenset[Path]:
    """Return a module's file, and those of the modules of Fognav that it imports, directly or by way of others.

    Modules of `fog_kernels` are looked for beside the file. Imports nothing but the packages of those modules.
    """
    found: set[Path] = set()
    pending = [file]
    while pending:
        source = pending.pop()
        if source not in found:
            found.add(source)
            pending += _imported_by(source)
    return frozenset(found)


@cache
def digest_of(file: Path) -> bytes:
    """Return a hash of the contents of all sources of a module; it does not depend on where they lie."""
    contents = sorted((source.name, hashlib.sha256(source.read_bytes()).digest()) for source in sources_of(file))
    return hashlib.sha256(repr(contents).encode()).digest()


def _imported_by(file: Path) -> Iterator[Path]:
    for package, names, module in _IMPORT.findall(file.read_text("utf-8")):
        # `from package import a, b`: each of them may be a module, too.
        for name in (package or module, *(f"{package}.{each}" for each in _NAME.findall(names) if package)):
            source = _source_of(name, file.parent)
            if source is not None:
                yield source


def _source_of(name: str, folder: Path) -> Path | None:
    """Return the file of a module; None for what is no module, and for a module without a source."""
    package, _, module = name.rpartition(".")
    if package == _KERNELS:
        source = folder / f"{module}.py"
        return source if source.exists() else None
    parent = importlib.util.find_spec(package) if package else None
    if package and (parent is None or parent.submodule_search_locations is None):
        return None
    spec = importlib.util.find_spec(name)
    return Path(spec.origin) if spec is not None and spec.origin is not None and spec.origin.endswith(".py") else None
