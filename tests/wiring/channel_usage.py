"""Who uses which channel, by the sources of the members: the calls that name a channel, and liveliness.

A call names its channel as `ch.NAME`, its first argument; what a core's tables contain is not found here.
"""

from __future__ import annotations

import ast
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple, TypeVar

from fog_contracts import channels as ch

if TYPE_CHECKING:
    from collections.abc import Iterator

    from fog_contracts.channels import Channel, Role

ROOT: Final = Path(__file__).parents[2]
N = TypeVar("N", ast.Attribute, ast.Call)

SIDES: Final = {
    "subscribe": "subscribers", "subscribe_polled": "subscribers", "latest": "subscribers", "on": "subscribers",
    "query": "subscribers", "_query": "subscribers", "on_message": "subscribers",
    "decode": "subscribers", "decode_text": "subscribers", "encode_text": "publishers",
    "publish": "publishers", "publish_nowait": "publishers", "Will": "publishers", "serve": "publishers",
}  # fmt: skip
"""Which side of a channel's row a call belongs to, by the name of what is called."""

NOT_YET: Final[frozenset[tuple[Role, Channel]]] = frozenset(
    {
        ("console", ch.NODE_UPDATE),
        ("console", ch.PLANNER_PLAN),
    }
)
"""What the table allows and no program does so far; whoever makes it true removes it from here."""


class Use(NamedTuple):
    """A call that names a channel: where it is, and on which side of the channel's row the caller is."""

    place: str
    channel: Channel
    side: str


def uses(folder: str) -> list[Use]:
    """Return every call below a folder of the repository that names a channel as its first argument.

    Raises `AssertionError` for a channel that is passed to a function without a known side.
    """
    found: list[Use] = []
    for place, call in _calls(folder):
        match call.args:
            case [ast.Attribute(value=ast.Name(id="ch"), attr=name), *_] if name.lower() in ch.CHANNELS:
                called = _name(call)
                assert called in SIDES, f"{place} passes ch.{name} to {called}: add it to SIDES"
                found.append(Use(place, ch.CHANNELS[name.lower()], SIDES[called]))
    return found


def liveliness_declared(folder: str) -> set[str]:
    """Return the roles whose presence the sources below a folder declare."""
    declared = [call for _, call in _calls(folder) if _name(call) == "declare_liveliness"]
    return {str(ast.literal_eval(call.args[0])) for call in declared}


def liveliness_read(folder: str) -> list[str]:
    """Return where the sources below a folder ask who is present, be it only to learn whether their router answers."""
    return [place for place, node in _nodes(folder, ast.Attribute) if node.attr in {"present", "router_answers"}]


def session_roles(folder: str) -> dict[str, str]:
    """Return the role of every zenoh session that the sources below a folder open, by its place."""
    return {
        place: str(ast.literal_eval(keyword.value))
        for place, call in _calls(folder)
        if ast.unparse(call.func) == "ZenohEdge.open"
        for keyword in call.keywords
        if keyword.arg == "role"
    }


def _calls(folder: str) -> Iterator[tuple[str, ast.Call]]:
    """Yield every call below a folder, or in a file, with its place."""
    return _nodes(folder, ast.Call)


def _nodes(folder: str, kind: type[N]) -> Iterator[tuple[str, N]]:
    """Yield every node of a kind below a folder, or in a file, with its file and function (`file.py:function`)."""
    path = ROOT / folder
    for file in [path] if path.is_file() else sorted(path.rglob("*.py")):
        if "bench" in file.parts:  # it measures, and is no part of the system
            continue
        tree = ast.parse(file.read_text(encoding="utf-8"))
        functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]
        for node in ast.walk(tree):
            if isinstance(node, kind):
                around = [f for f in functions if f.lineno <= node.lineno <= (f.end_lineno or 0)]
                name = max(around, key=lambda f: f.lineno).name if around else ""
                yield f"{file.relative_to(ROOT)}:{name}", node


def _name(call: ast.Call) -> str:
    return ast.unparse(call.func).rsplit(".", 1)[-1]
