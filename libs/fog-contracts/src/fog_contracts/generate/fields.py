"""The fields of a message type for documentation: type, unit, limits and default, read from the type itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import msgspec
from msgspec import inspect

from fog_contracts.messages import Message

if TYPE_CHECKING:
    from collections.abc import Mapping

_SUFFIXES: Final[Mapping[str, str]] = {"_m": "m", "_cm": "cm", "_s": "s", "_ms": "ms"}
"""Units by the suffix of a field's name."""
_NUMBERS: Final = (inspect.IntType, inspect.FloatType)


@dataclass(frozen=True, slots=True)
class Field:
    """One field; `element` is the type of a list's items or of a dictionary's values, else the field's own type."""

    name: str
    type: inspect.Type
    element: inspect.Type
    unit: str
    required: bool
    default: object
    nullable: bool

    @property
    def choices(self) -> tuple[str, ...]:
        """The allowed values of a field with a fixed set of them; else empty."""
        element = self.element
        return tuple(str(value) for value in element.values) if isinstance(element, inspect.LiteralType) else ()


def message_fields(kind: type[Message]) -> list[Field]:
    """Return the fields of a message type in the order of their definition."""
    described = inspect.type_info(kind)
    assert isinstance(described, inspect.StructType)
    return [_field(each) for each in described.fields]


def summary(kind: type[Message]) -> str:
    """Return a message's docstring as one paragraph."""
    return " ".join((kind.__doc__ or "").split())


def parts(kind: type[Message]) -> list[type[Message]]:
    """Return the message types of this one's fields, without those nested deeper."""
    found: list[type[Message]] = []
    for each in message_fields(kind):
        _collect(each.type, found)
    return found


def type_text(kind: inspect.Type) -> str:  # noqa: C901, PLR0911  # one case per kind of type
    """Return a readable name of a type: `number`, `list (1 to 8) of number or null`, a message's own name."""
    match kind:
        case inspect.Metadata():
            return type_text(kind.type)
        case inspect.UnionType():
            return " or ".join(type_text(each) for each in sorted(kind.types, key=_null_last))
        case inspect.StructType():
            return kind.cls.__name__
        case inspect.LiteralType():
            return " \\| ".join(f"`{value}`" for value in kind.values)
        case inspect.ListType():
            return f"list{_between(kind.min_length, kind.max_length)} of {type_text(kind.item_type)}"
        case inspect.TupleType():
            return f"({', '.join(type_text(each) for each in kind.item_types)})"
        case inspect.DictType():
            return f"map of {type_text(kind.key_type)} to {type_text(kind.value_type)}"
        case inspect.StrType():
            return "id" if kind.pattern else f"text{_between(kind.min_length, kind.max_length, ' characters')}"
        case inspect.BytesType():
            return f"bytes{_between(kind.min_length, kind.max_length)}"
        case _:
            if type(kind) not in _PLAIN:
                raise TypeError(f"{kind}: documents have no word for this type; give it one in {__name__}._PLAIN")
            return _PLAIN[type(kind)]


_PLAIN: Final[Mapping[type[inspect.Type], str]] = {
    inspect.IntType: "integer",
    inspect.FloatType: "number",
    inspect.BoolType: "boolean",
    inspect.NoneType: "null",
    inspect.AnyType: "anything",
}


def bounds(kind: inspect.Type) -> tuple[str, float | None, str, float | None]:
    """Return the bounds of a number: `>` or `>=` with the lower one, `<` or `<=` with the upper one, None for none."""
    plain = _bare(kind)
    if not isinstance(plain, _NUMBERS):
        return "", None, "", None
    low = (">", plain.gt) if plain.gt is not None else (">=", plain.ge)
    high = ("<", plain.lt) if plain.lt is not None else ("<=", plain.le)
    return *low, *high


def _field(each: inspect.Field) -> Field:
    nullable = False
    element = _bare(each.type)
    unit = _unit(each.type)
    while True:
        if isinstance(element, inspect.UnionType):
            nullable = nullable or any(isinstance(one, inspect.NoneType) for one in element.types)
            rest = [one for one in element.types if not isinstance(one, inspect.NoneType)]
            if len(rest) != 1:
                break
            inner = rest[0]
        elif isinstance(element, inspect.ListType):
            inner = element.item_type
        elif isinstance(element, inspect.DictType):
            inner = element.value_type
        elif isinstance(element, inspect.TupleType) and len({_unit(one) for one in element.item_types}) == 1:
            inner = element.item_types[0]
        else:
            break
        unit = unit or _unit(inner)
        element = _bare(inner)
    unit = unit or next((unit for end, unit in _SUFFIXES.items() if each.name.endswith(end)), "")
    default = each.default if each.default is not msgspec.NODEFAULT else None
    if each.default_factory is not msgspec.NODEFAULT:
        default = each.default_factory()
    return Field(each.encode_name, each.type, element, unit, each.required, default, nullable)


def _bare(kind: inspect.Type) -> inspect.Type:
    while isinstance(kind, inspect.Metadata):
        kind = kind.type
    return kind


def _unit(kind: inspect.Type) -> str:
    return str((kind.extra or {}).get("unit", "")) if isinstance(kind, inspect.Metadata) else ""


def _null_last(kind: inspect.Type) -> bool:
    return isinstance(kind, inspect.NoneType)


def _between(low: int | None, high: int | None, noun: str = "") -> str:
    if low is None and high is None:
        return ""
    if low == high:
        return f" of {low}{noun}" if noun else f" ({low})"
    if low is None:
        return f" (at most {high}{noun})"
    return f" ({low} or more{noun})" if high is None else f" ({low} to {high}{noun})"


def _collect(kind: inspect.Type, found: list[type[Message]]) -> None:
    plain = _bare(kind)
    match plain:
        case inspect.StructType():
            if issubclass(plain.cls, Message) and plain.cls not in found:
                found.append(plain.cls)
        case inspect.UnionType():
            for each in plain.types:
                _collect(each, found)
        case inspect.ListType():
            _collect(plain.item_type, found)
        case inspect.DictType():
            _collect(plain.value_type, found)
        case inspect.TupleType():
            for each in plain.item_types:
                _collect(each, found)
        case _:
            pass
