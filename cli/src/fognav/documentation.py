"""What is generated of a checkout: files, by the channel table and the settings' types; and the documentation's site.

The REST routes come from OpenAPI. The services' apps are created without a service behind them: describing the routes
calls no service. The site mirrors the repository: a document is shown as it is, at its path, so that its links hold.
Sources and folders that it links to become pages, too: `x.py` the page `x.py.md`, a folder the `README.md` in it. A
link that leads nowhere is taken for one of these, whose page the strict build misses.
"""

import json
import os
import re
import shutil
import subprocess
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from importlib.metadata import distribution
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from fog_contracts.generate.acl import mqtt_acl, zenoh_acl
from fog_contracts.generate.header import firmware_header
from fog_contracts.generate.markdown import OpenApi, channels_markdown
from fog_contracts.generate.robot_toml import robot_settings_markdown
from fog_runtime.clock import SystemClock
from fog_runtime.configuration.robot_file import default_robot
from fog_runtime.configuration.site import load_site
from fog_runtime.health import Health
from fog_runtime.http import Tokens, unused
from fog_runtime.http.openapi import merged
from fognav import checkout
from robot_agent import registry

if TYPE_CHECKING:
    import msgspec

WRITE: Final = "./fognav channels --write"
"""The command that updates all generated files."""


def rest_routes() -> dict[str, OpenApi]:
    """Return each service's OpenAPI description by the service's name."""
    # The services import kernels and web frameworks, which takes time: only this function needs them.
    from console_service.api import make_api as make_console  # noqa: PLC0415  # see above
    from hazard_aggregator.api import make_api as make_aggregator  # noqa: PLC0415  # same
    from map_service.api import make_api as make_map  # noqa: PLC0415  # same
    from planner.api import make_api as make_planner  # noqa: PLC0415  # same

    loaded = load_site(checkout.site_folder(None))
    clock, health, tokens = SystemClock(), Health(), Tokens()
    service = unused()
    return {
        "hazard-aggregator": make_aggregator(service, loaded.map, clock, health, tokens).openapi(),
        "map-service": make_map(service, loaded.site, clock, health, tokens).openapi(),
        "planner": make_planner(service, loaded.site, health, tokens).openapi(),
        "console-service": make_console(service, health, tokens).openapi(),
    }


def openapi() -> str:
    """Return the OpenAPI document of all services, as `/api/v1/openapi.json` of a running system has it."""
    return json.dumps(merged(rest_routes()), indent=2) + "\n"


def markdown() -> str:
    """Return `docs/channels.md`."""
    return channels_markdown(rest_routes())


def robot_settings() -> str:
    """Return `docs/robot-settings.md`."""
    own = distribution("robot-agent").entry_points
    drivers: list[tuple[str, msgspec.Struct]] = []
    for part, group in (("base", registry.BASES), ("lidar", registry.LIDARS)):
        for name in sorted(point.name for point in own if point.group == group):
            robot = default_robot(**{part: name})
            drivers.append((f"`[{part}.options]` of `{name}`", registry.options(robot)[part == "lidar"]))
    return robot_settings_markdown(default_robot().settings, drivers)


FILES: Final[Mapping[str, Callable[[], str]]] = {
    "docs/channels.md": markdown,
    "docs/robot-settings.md": robot_settings,
    "deploy/mosquitto/acl": mqtt_acl,
    "deploy/zenoh/acl.json5": zenoh_acl,
    "firmware/include/fognav_contract.h": firmware_header,
}
"""The generator of each file, by its path in the checkout."""


def acls(folder: Path | None) -> tuple[str, str]:
    """Return the access lists of the MQTT broker and of the zenoh router, for the site in `folder` or for any site.

    Those of a site list its robots by id. Raises `SiteError`.
    """
    if folder is None:
        return mqtt_acl(), zenoh_acl()
    site = load_site(folder).site
    return mqtt_acl(site.id), zenoh_acl(site.id, [robot.id for robot in site.robots])


def stale_generated(folder: Path) -> list[str]:
    """Return the names of the files in a checkout that are out of date or missing."""
    return [name for name, make in FILES.items() if not _is_current(folder / name, make().encode())]


def write_generated(folder: Path) -> list[str]:
    """Write the files in a checkout that are out of date or missing; return their names."""
    return [name for name, make in FILES.items() if _update(folder / name, make().encode())]


def _is_current(file: Path, content: bytes) -> bool:
    return file.is_file() and file.read_bytes() == content


def _update(file: Path, content: bytes) -> bool:
    """Write a file unless it has this content; return whether it was written."""
    if _is_current(file, content):
        return False
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(content)
    return True


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
