"""A valid message of any type, made from the limits that its type states: for tests that need one of each."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec
from msgspec import inspect

if TYPE_CHECKING:
    from collections.abc import Callable

    from fog_contracts.channels import Channel
    from fog_contracts.messages import Message


def sample(kind: type[Message], **fields: object) -> Message:
    """Return the smallest valid message of a type; `fields` have these values instead.

    Raises `msgspec.ValidationError` for a value that the type does not allow.
    """
    made = _struct(inspect.type_info(kind))
    return msgspec.convert({**made, **fields}, kind)


def sample_of(channel: Channel) -> Message | str:
    """Return a message that may be published on a channel."""
    if channel.message is None:
        return channel.values[0] if channel.values else "text"
    return sample(channel.message)


def _struct(kind: Any) -> dict[str, Any]:
    tag = {} if kind.tag_field is None else {kind.tag_field: kind.tag}
    return {**tag, **{field.encode_name: _value(field.type) for field in kind.fields if field.required}}


def _number(kind: Any) -> Any:
    if kind.ge is not None and kind.ge > 0:
        return kind.ge
    return 0 if kind.gt is None or kind.gt < 0 else min(1.0, kind.le or 1.0)


def _choice(kind: Any) -> Any:
    return None if kind.includes_none else _value(kind.types[0])


_SAMPLES: dict[type, Callable[[Any], Any]] = {
    inspect.IntType: _number,
    inspect.FloatType: _number,
    inspect.StrType: lambda kind: "a" * max(kind.min_length or 0, 1),
    inspect.BytesType: lambda kind: b"a" * (kind.min_length or 0),
    inspect.BoolType: lambda _: False,
    inspect.LiteralType: lambda kind: kind.values[0],
    inspect.ListType: lambda kind: [_value(kind.item_type) for _ in range(kind.min_length or 0)],
    inspect.TupleType: lambda kind: [_value(item) for item in kind.item_types],
    inspect.DictType: lambda _: {},
    inspect.UnionType: _choice,
    inspect.StructType: _struct,
    inspect.Metadata: lambda kind: _value(kind.type),
}


def _value(kind: Any) -> Any:
    return _SAMPLES[type(kind)](kind)
