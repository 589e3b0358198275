"""Gathers the pages of the documentation's site, writes that of the REST routes, and builds the site.

The site mirrors the repository: a document is shown as it is, at its path, so that its links hold. Sources and folders
that it links to become pages, too: `x.py` the page `x.py.md`, a folder the `README.md` in it. A link that leads nowhere
is taken for one of these, whose page the strict build misses.
"""

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

from fognav import system
from fognav.output import FailedError

Described = Mapping[str, Any]
"""A part of an OpenAPI description."""
_METHODS: Final = ("get", "put", "post", "patch", "delete")
_HEAD: Final = """\
# REST

The routes of the three services. [Channels](../docs/channels.md#rest) has them at a glance. A service serves its own
description at `/openapi.json`; errors are problem documents (RFC 9457).
"""
_LIMITS: Final = {
    "minimum": ">=", "exclusiveMinimum": ">", "maximum": "<=", "exclusiveMaximum": "<", "minLength": "characters >=",
    "maxLength": "characters <=", "minItems": "items >=", "maxItems": "items <=", "pattern": "like",
}  # fmt: skip


def rest_page(services: Mapping[str, Described]) -> str:
    """Return the page in Markdown; `services` are the descriptions by the name of the service."""
    types: dict[str, Described] = {}
    sections = [_HEAD]
    for service, described in services.items():
        sections.append(f"## {service}\n")
        sections += [
            _route(f"{method.upper()} {path}", operations[method])
            for path, operations in sorted(described["paths"].items())
            for method in _METHODS
            if method in operations
        ]
        types |= described.get("components", {}).get("schemas", {})
    sections.append("## Types\n")
    sections += [_type(name, types[name]) for name in sorted(types)]
    return "\n".join(sections)


def _route(name: str, operation: Described) -> str:
    role = "Needs a token.\n" if operation.get("security") else ""
    body = _content(operation.get("requestBody", {}))
    parameters = [
        [f"`{each['name']}`", each["in"], _text(each["schema"]), each.get("description", "")]
        for each in operation.get("parameters", [])
    ]
    answers = [
        [status, _content(answer), answer.get("description", "")]
        for status, answer in sorted(operation["responses"].items())
    ]
    parts = [
        f"### `{name}`\n",
        f"{_paragraph(operation.get('description', ''))}\n",
        role,
        f"Body: {body}\n" if body else "",
        _table(["parameter", "in", "type", "meaning"], parameters),
        _table(["status", "answer", "meaning"], answers),
    ]
    return "\n".join(part for part in parts if part)


def _type(name: str, schema: Described) -> str:
    required = schema.get("required", [])
    rows = [
        [
            f"`{field}`", _text(of), _limits(of),
            "" if field in required else f"`{json.dumps(of['default'])}`" if "default" in of else "none",
        ]
        for field, of in schema.get("properties", {}).items()
    ]  # fmt: skip
    about = _paragraph(schema.get("description", ""))
    fields = _table(["field", "type", "limits", "default"], rows) if rows else f"{_text(schema)}\n"
    return f"### {name}\n\n{about}\n\n{fields}"


def _content(of: Described) -> str:
    """Return the type of a body or an answer."""
    return " or ".join(
        _text(content.get("schema", {})) if "json" in kind else f"`{kind}`"
        for kind, content in of.get("content", {}).items()
    )


def _text(schema: Described) -> str:
    """Return a schema's type for people, with links to the types of this page."""
    if "$ref" in schema:
        name = schema["$ref"].rpartition("/")[2]
        return f"[{name}](#{name.lower()})"
    if several := schema.get("anyOf") or schema.get("oneOf") or schema.get("allOf"):
        return " or ".join(map(_text, several))
    if "enum" in schema:
        return " or ".join(f"`{value}`" for value in schema["enum"])
    if items := schema.get("prefixItems") or (schema.get("items") and [schema["items"]]):
        return f"list of {', '.join(map(_text, items))}"
    return str(schema.get("type", "anything"))


def _limits(schema: Described) -> str:
    for each in (schema, *schema.get("anyOf", ())):
        if found := [f"{sign} `{each[key]}`" for key, sign in _LIMITS.items() if key in each]:
            return ", ".join(found)
    return ""


def _paragraph(text: str) -> str:
    """Return a docstring's text as one paragraph for each of its own."""
    return "\n\n".join(" ".join(part.split()) for part in text.split("\n\n"))


def _table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [[" ".join(cell.split()).replace("|", "\\|") for cell in row] for row in rows]
    if not lines:
        return ""
    return "".join(f"| {' | '.join(line)} |\n" for line in [columns, ["---"] * len(columns), *lines])


_LINK: Final = re.compile(r"(?<=\]\()(?![a-z]+:|#)[^)\s#]+")
_SHOWN: Final = frozenset({".md", ".png", ".svg", ".gif", ".html", ".csv", ".xz"})
"""Kinds of files that browsers open or keep; all others are shown as sources."""
_LANGUAGES: Final = {".py": "python", ".hpp": "cpp", ".toml": "toml", ".yaml": "yaml"}
_UNSEEN: Final = re.compile(r"(^|/)(\.|__pycache__|node_modules|[^/]*\.egg-info)")
_PAGE: Final = "---\ntitle: {title}\nhide: [navigation, toc]\nsearch: {{exclude: true}}\n---\n# `{path}`\n\n{text}\n"
_COLOUR: Final = re.compile(r"\x1b\[[0-9;]*m")
CONFIGURATION: Final = "zensical.toml"


def gather(root: Path) -> dict[str, str | Path]:
    """Return the site's pages, and the files that they show, by path: a page's text, or the file to copy."""
    found: dict[str, str | Path] = {}
    waiting = [*root.glob("*.md"), *(root / "docs").rglob("*.md")]
    linked: set[Path] = set()
    while waiting:
        file = waiting.pop()
        path = file.relative_to(root).as_posix()
        if path in found:
            continue
        if file.suffix != ".md":
            found[path] = file
            continue
        text = file.read_text("utf-8")
        found[path] = _LINK.sub(partial(_to_page, file.parent), text)
        targets = {(file.parent / link).resolve() for link in _LINK.findall(text)}
        targets = {target / "README.md" if (target / "README.md").is_file() else target for target in targets}
        waiting += (target for target in targets if target.is_file() and target.suffix in _SHOWN)
        linked |= targets
    for target in sorted(linked):
        path = target.relative_to(root).as_posix()
        if target.is_file() and target.suffix not in _SHOWN:
            found[f"{path}.md"] = _source(path, target)
    for target in sorted(linked):
        if target.is_dir():
            found[f"{target.relative_to(root).as_posix()}/README.md"] = _folder(root, target, found)
    return found


def _to_page(folder: Path, found: re.Match[str]) -> str:
    """Return the address of the page that shows what a document's link leads to; `folder` has the document."""
    link = found[0]
    target = folder / link
    if target.is_dir():
        return f"{link.rstrip('/')}/README.md"
    return link if target.suffix in _SHOWN else f"{link}.md"


def _source(path: str, file: Path) -> str:
    fence = "`" * 8
    text = f"{fence}{_LANGUAGES.get(file.suffix, 'text')}\n{file.read_text('utf-8').rstrip()}\n{fence}"
    return _PAGE.format(title=file.name, path=path, text=text)


def _folder(root: Path, folder: Path, pages: Mapping[str, object]) -> str:
    """Return a page that lists the files of a folder: modules with their purpose, and a link where there is a page."""
    lines = []
    for file in sorted(folder.rglob("*")):
        path, name = file.relative_to(root).as_posix(), file.relative_to(folder).as_posix()
        if not file.is_file() or _UNSEEN.search(path) or "/tests/" in f"/{name}":
            continue
        page = next((page for page in (path, f"{path}.md") if page in pages), None)
        shown = f"[`{name}`]({os.path.relpath(page, folder.relative_to(root))})" if page else f"`{name}`"
        purpose = re.match(r'(?:#.*\n)*"""(.+?)(?:"""|\n|$)', file.read_text("utf-8")) if file.suffix == ".py" else None
        lines.append(f"- {shown}: {purpose[1]}" if purpose else f"- {shown}")
    path = folder.relative_to(root).as_posix()
    return _PAGE.format(title=path, path=path, text="\n".join(lines))


def write(root: Path, folder: Path, services: Mapping[str, Described]) -> None:
    """Write what has changed of the site's configuration and pages into a folder."""
    found = gather(root) | {"reference/rest.md": rest_page(services)}
    pages = folder / "pages"
    for file in [file for file in pages.rglob("*") if file.is_file()]:
        if file.relative_to(pages).as_posix() not in found:
            file.unlink()
    for path, content in found.items():
        _update(pages / path, content.encode() if isinstance(content, str) else content.read_bytes())
    _update(folder / CONFIGURATION, (root / "docs" / CONFIGURATION).read_bytes())
    checkout = folder / "checkout"  # where the configuration finds the sources
    if not checkout.is_symlink() or checkout.readlink() != root:
        checkout.unlink(missing_ok=True)
        checkout.symlink_to(root)


def _update(file: Path, content: bytes) -> None:
    if not file.is_file() or file.read_bytes() != content:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(content)


def find_builder(root: Path) -> Path | None:
    """Return the program that builds the site, if it is installed as pinned."""
    stamp = root / ".fognav" / "docs" / "venv" / "requirements.txt"
    current = stamp.is_file() and stamp.read_bytes() == (root / "requirements" / "docs.txt").read_bytes()
    return stamp.parent / "bin" / "zensical" if current else None


def install_builder(root: Path) -> Path:
    """Install the program that builds the site into an environment of its own, and return it; raises `FailedError`."""
    if (uv := system.find_uv(root)) is None:
        raise FailedError("uv, which installs what builds the documentation, is not found: python3 -m pip install uv")
    venv, pins = root / ".fognav" / "docs" / "venv", root / "requirements" / "docs.txt"
    create: list[str | Path] = ["venv", "--clear", "--no-project", "--python", sys.executable, venv]
    install = ["pip", "install", "--python", venv / "bin" / "python", "--require-hashes", "-r", pins]
    for step in (create, install):
        done = subprocess.run([uv, "--quiet", *step], check=False, capture_output=True, text=True)
        if done.returncode != 0:
            raise FailedError(f"what builds the documentation could not be installed: {done.stderr.strip()}")
    shutil.copyfile(pins, venv / "requirements.txt")
    return venv / "bin" / "zensical"


def build(builder: Path, folder: Path) -> str:
    """Build the site in `folder`/site; return what is wrong with it, or an empty text."""
    # From nothing: its cache knows no changes of the sources, and pages that are gone would stay.
    if (folder / "site").exists():
        shutil.rmtree(folder / "site")
    done = subprocess.run(
        [builder, "build", "--strict", "--clean"],
        cwd=folder,
        env=os.environ | {"NO_COLOR": "1"},
        check=False,
        capture_output=True,
        text=True,
    )
    said = _COLOUR.sub("", f"{done.stdout}{done.stderr}").partition("Traceback")[0]
    return (said.strip() or f"{builder} ended with {done.returncode}") if done.returncode != 0 else ""
