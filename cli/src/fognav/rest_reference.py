"""The page of the services' REST routes, from their OpenAPI descriptions: each route, then each type field by field."""

import json
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

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
