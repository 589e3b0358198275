"""`docs/channels.md`: the channel table, the messages field by field, and the REST routes, for people."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final, TypeGuard

import msgspec

from fog_contracts import messages
from fog_contracts.channels import CHANNELS, DURABILITIES, KIB, MIB, ROLES, Channel, Role
from fog_contracts.generate import NOTE, Field, bounds, message_fields, parts, summary, type_text
from fog_contracts.messages import Described

if TYPE_CHECKING:
    from fog_contracts.messages import Message

OpenApi = Mapping[str, Any]

_HEAD: Final = f"""\
<!-- {NOTE} -->

# Channels, messages and routes

Everything that processes exchange: over MQTT between sensor nodes and the fog, over zenoh between the
fog and the robots, and the REST routes of the services. An id in angle brackets is `[a-z0-9][a-z0-9-]{{0,31}}`,
an area's number on the thesis's topics has one to four digits. Lengths are in metres, angles in radians, in the frame
`map`, unless a field says otherwise; a stamp is in seconds since 1970 by the sender's clock and serves people and
traces, never freshness checks. Unknown fields are ignored; a message that is too long, lacks a field or has
one out of range is refused, counted and logged.

"""
_STALE: Final = """\
*Stale after* is measured from a message's arrival by the receiver's own clock. Without it
the value holds until the next message, or as long as the message itself says.
"""
_PARTS: Final = """\
A reply over 32 KiB is only announced, and its parts are asked for: the reply is empty, with an attachment (JSON)
`{"reply": NAME, "size": BYTES}`; the query `KEY?reply=NAME;part=NUMBER` returns a part of 32 KiB (the last one is
shorter), or an error once the reply is not kept any more. Replies are dropped on a congested link: ask again.
"""
_IDENTIFIERS: Final = """\
## Identifiers

Programs compare identifiers, people read the sentences beside them. Those of a robot's reasons (`ReasonCode`) are in
[safety.md](safety.md#reasons).
"""
_REST: Final = """\
## REST

Errors are RFC 9457 problem documents: `type` is `urn:fognav:` and an identifier of the tables below, `title` what it
says, `detail` a sentence with the remedy. Writing requires a bearer token.
"""
_LARGE: Final = 2**31
_METHODS: Final = ("get", "put", "post", "patch", "delete")


def channels_markdown(services: Mapping[str, OpenApi]) -> str:
    """Return the whole document; `services` are the OpenAPI descriptions by the name of the service."""
    parts = [_roles(), _durabilities(), _mqtt(), _zenoh(), _messages(), _identifiers(), _routes(services)]
    return _HEAD + "\n".join(parts)


def _roles() -> str:
    rows = ([f"`{role}`", description] for role, description in ROLES.items())
    return "## Roles\n\n" + _table(["role", "description"], rows)


def _durabilities() -> str:
    rows = ([f"`{name}`", description] for name, description in DURABILITIES.items())
    head = "## Durability\n\n"
    tail = "\nOver MQTT `latest` means retained. A zenoh channel of durability `latest` can also be queried.\n"
    return head + _table(["durability", "what a late or disconnected subscriber receives"], rows) + tail


def _mqtt() -> str:
    rows = (
        [
            _key(row), _carried(row), _ends(row), str(row.qos), f"`{row.durability}`", _rate(row), _age(row),
            _size(row.limit),
        ]
        for row in CHANNELS.values()
        if row.transport == "mqtt"
    )  # fmt: skip
    columns = ["topic", "carries", "from → to", "QoS", "durability", "rate", "stale after", "size limit"]
    return f"## MQTT\n\nMessages are JSON in UTF-8, or plain text. {_STALE}\n" + _table(columns, rows)


def _zenoh() -> str:
    published = [row for row in CHANNELS.values() if row.transport == "zenoh" and row.kind == "pub"]
    queried = [row for row in CHANNELS.values() if row.kind == "query"]
    presence = [row for row in CHANNELS.values() if row.kind == "liveliness"]
    columns = ["key", "carries", "from → to", "durability", "rate", "stale after", "size limit"]
    rows = (
        [_key(row), _carried(row), _ends(row), f"`{row.durability}`", _rate(row), _age(row), _size(row.limit)]
        for row in published
    )
    queries = (
        [
            _key(row), _message(row.message), _message(row.reply), _names(row.subscribers), _names(row.publishers),
            f"{_size(row.limit)}, {_size(row.reply_limit)}",
        ]
        for row in queried
    )  # fmt: skip
    return "\n".join(
        [
            f"## zenoh\n\nMessages are msgpack. {_STALE}",
            "### Published\n\n" + _table(columns, rows),
            "### Queries\n\n" + _table(["key", "request", "reply", "sent by", "answered by", "size limit"], queries),
            _PARTS,
            "### Presence\n\n"
            + _table(["key", "meaning", "from → to"], ([_key(row), row.about, _ends(row)] for row in presence)),
        ]
    )


def _messages() -> str:
    found: list[type[Message]] = []

    def add(kind: type[Message] | None) -> None:
        if kind is not None and kind not in found:
            found.append(kind)
            for part in parts(kind):
                add(part)

    for row in CHANNELS.values():
        add(row.message)
        add(row.reply)
    return "## Messages\n\n" + "\n".join(_one(kind) for kind in found)


def _one(kind: type[Message]) -> str:
    rows = ([f"`{f.name}`", _linked(type_text(f.type)), f.unit, _limits(f), _default(f)] for f in message_fields(kind))
    return f"### {kind.__name__}\n\n{summary(kind)}\n\n" + _table(["field", "type", "unit", "limits", "default"], rows)


def _identifiers() -> str:
    """Return a table of each enumeration of identifiers whose members say what they mean."""
    described = [kind for _, kind in sorted(vars(messages).items()) if isinstance(kind, type) and _is_described(kind)]
    sections = [_IDENTIFIERS]
    for kind in described:
        rows = ([f"`{member}`", member.says] for member in kind)
        sections.append(f"### {kind.__name__}\n\n{summary(kind)}\n\n" + _table(["identifier", "says"], rows))
    return "\n".join(sections)


def _is_described(kind: type) -> TypeGuard[type[Described]]:
    return issubclass(kind, Described) and kind is not Described


def _routes(services: Mapping[str, OpenApi]) -> str:
    sections = [_REST]
    problems = [described.get("x-problems", {}) for described in services.values()]
    names = set[str]().union(*problems).intersection(*problems)
    shared = {code: problems[0][code] for code in sorted(names)}
    for name, described in services.items():
        rows = [_route(method, path, path_item[method]) for path, path_item in sorted(described["paths"].items())
                for method in _METHODS if method in path_item]  # fmt: skip
        sections.append(
            f"### {name}\n\n"
            + _table(["route", "description", "parameters", "body", "responses", "errors", "token"], rows)
        )
        own = {code: text for code, text in described.get("x-problems", {}).items() if code not in shared}
        sections.append(f"#### Problems of {name}\n\n{_problems(own)}")
    sections.append(f"### Problems of every service\n\n{_problems(shared)}")
    return "\n".join(sections)


def _problems(described: Mapping[str, Any]) -> str:
    rows = (
        [f"`{code}`", str(text["status"]), *(text[part].replace("|", "\\|") for part in ("says", "remedy"))]
        for code, text in described.items()
    )
    return _table(["identifier", "status", "says", "what to do"], rows)


def _route(method: str, path: str, operation: Mapping[str, Any]) -> list[str]:
    description = operation.get("description") or operation.get("summary") or ""
    parameters = [f"`{each['name']}`" for each in operation.get("parameters", []) if each["in"] != "path"]
    body = _schema((operation.get("requestBody") or {}).get("content"))
    described = sorted(operation.get("responses", {}).items())
    responses = [
        " ".join(part for part in (code, _schema(response.get("content"))) if part)
        for code, response in described
        if code[0] in "123"
    ]
    # What else may go wrong (`default`) goes without saying.
    errors = [code for code, _ in described if code[0] in "45"]
    return [
        f"`{method.upper()} {path}`", _sentence(description), ", ".join(parameters), body, ", ".join(responses),
        ", ".join(errors), "yes" if operation.get("security") else "",
    ]  # fmt: skip


def _schema(content: Mapping[str, Any] | None) -> str:
    for kind, described in (content or {}).items():
        schema = described.get("schema", {})
        reference = schema.get("$ref") or schema.get("items", {}).get("$ref") or ""
        if reference:
            name = reference.rsplit("/", 1)[1]
            return f"list of {name}" if "items" in schema else name
        if kind != "application/json":
            return str(kind)
    return ""


def _sentence(text: str) -> str:
    return " ".join(text.split("\n\n", maxsplit=1)[0].split()).replace("|", "\\|")


# --- Cells of tables ------------------------------------------------------------------------------------------------


def _table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [columns, ["---"] * len(columns), *rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def _key(row: Channel) -> str:
    return "`" + re.sub(r"\{(\w+)\}", r"<\1>", row.template) + "`"


def _carried(row: Channel) -> str:
    if row.message is not None:
        return _message(row.message)
    values = " or ".join(f"`{value}`" for value in row.values)
    return f"{values}: {row.about}" if values else row.about


def _message(kind: type[Message] | None) -> str:
    if kind is None:
        return "nothing"
    return f"[{kind.__name__}](#{kind.__name__.lower()})"


def _linked(text: str) -> str:
    """Link the names of messages, which a text with backticks does not contain."""
    return text if "`" in text else re.sub(r"\b[A-Z]\w+", lambda name: f"[{name[0]}](#{name[0].lower()})", text)


def _ends(row: Channel) -> str:
    return f"{_names(row.publishers)} → {_names(row.subscribers)}"


def _names(roles: Sequence[Role]) -> str:
    return ", ".join(roles)


def _rate(row: Channel) -> str:
    idle = "" if row.idle_hz is None else f", idle {row.idle_hz:g} Hz"
    return "on change" if row.rate_hz is None else f"{row.rate_hz:g} Hz{idle}"


def _age(row: Channel) -> str:
    return "" if math.isinf(row.max_age_s) else f"{row.max_age_s:g} s"


def _size(limit: int) -> str:
    for unit, size in (("MiB", MIB), ("KiB", KIB)):
        if limit >= size and limit % size == 0:
            return f"{limit // size} {unit}"
    return f"{limit} B"


def _limits(field: Field) -> str:
    low_sign, low, high_sign, high = bounds(field.element)
    pairs = ((low_sign, low), (high_sign, high))
    return ", ".join(f"{sign} {_number(value)}" for sign, value in pairs if value is not None)


def _number(value: float) -> str:
    if not isinstance(value, int):
        return f"{value:g}"
    for offset in (0, 1):
        power = value + offset
        if power >= _LARGE and power.bit_count() == 1:
            return f"2^{power.bit_length() - 1}" + " - 1" * offset
    return str(value)


def _default(field: Field) -> str:
    return "" if field.required else f"`{msgspec.json.encode(field.default).decode()}`"
