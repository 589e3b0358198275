"""Foxglove's WebSocket protocol, the server's side of what a viewer needs: channels, subscriptions, parameters. Pure.

Specification: github.com/foxglove/ws-protocol, docs/spec.md, and the same messages under the name `foxglove.sdk.v1`.
`foxglove-sdk` has a server, too. It is not used because it asks nobody who they are, on an address of its own, and
keeps up to 1,024 messages for a slow viewer, each of which may be a whole costmap.
"""

from __future__ import annotations

import base64
import struct
from typing import TYPE_CHECKING, Annotated, Final, NamedTuple

import msgspec

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

SUBPROTOCOLS: Final = ("foxglove.sdk.v1", "foxglove.websocket.v1")
_MESSAGE_DATA: Final = 1
_SERVED: Final = "subscribe, unsubscribe and getParameters"

Number = Annotated[int, msgspec.Meta(ge=0, lt=2**32)]
Name = Annotated[str, msgspec.Meta(max_length=200)]


class Schema(NamedTuple):
    """How the messages of a channel are read."""

    name: str
    encoding: str
    data: bytes


class Channel(NamedTuple):
    """A topic, whose messages are in `encoding`."""

    id: int
    topic: str
    encoding: str
    schema: Schema


class Subscription(msgspec.Struct, frozen=True):
    """A channel, and the number under which its messages are wanted."""

    id: Number
    channelId: Number  # noqa: N815  # the protocol's name


class Subscribe(msgspec.Struct, frozen=True, tag_field="op", tag="subscribe"):
    """Asks for messages."""

    subscriptions: Annotated[list[Subscription], msgspec.Meta(max_length=1000)]


class Unsubscribe(msgspec.Struct, frozen=True, tag_field="op", tag="unsubscribe"):
    """Wants no more of them."""

    subscriptionIds: Annotated[list[Number], msgspec.Meta(max_length=1000)]  # noqa: N815  # the protocol's name


class GetParameters(msgspec.Struct, frozen=True, tag_field="op", tag="getParameters"):
    """Asks for parameters, without names for all."""

    parameterNames: Annotated[list[Name], msgspec.Meta(max_length=1000)] = []  # noqa: N815  # the protocol's name
    id: Name | None = None


Request = Subscribe | Unsubscribe | GetParameters
_decoder: Final[msgspec.json.Decoder[Request]] = msgspec.json.Decoder(Request)
Value = str | float | bool


class ProtocolError(ValueError):
    """A message that is not understood, or asks for what is not served."""


def parsed(message: str | bytes) -> Request:
    """Return what a viewer asks for; raises `ProtocolError`."""
    if isinstance(message, bytes):
        raise ProtocolError(f"binary messages are not served: this shows a floor only. Send {_SERVED}")
    try:
        return _decoder.decode(message)
    except (msgspec.DecodeError, UnicodeEncodeError, RecursionError) as error:
        raise ProtocolError(f"not understood ({error}): this shows a floor only. Send {_SERVED}") from error


def server_info(name: str, session: str) -> str:
    """Return who this is, and what it can."""
    return _text(
        op="serverInfo", name=name, capabilities=["parameters"], supportedEncodings=[], metadata={}, sessionId=session
    )


def advertised(channels: Sequence[Channel]) -> str:
    """Return which channels there are."""
    told = [
        {
            "id": each.id, "topic": each.topic, "encoding": each.encoding, "schemaName": each.schema.name,
            "schemaEncoding": each.schema.encoding, "schema": _schema(each.schema),
        }
        for each in channels
    ]  # fmt: skip
    return _text(op="advertise", channels=told)


def _schema(schema: Schema) -> str:
    """Return a schema as text: one that is binary in base64."""
    return base64.b64encode(schema.data).decode() if schema.encoding == "protobuf" else schema.data.decode()


def warning(text: str) -> str:
    """Return a sentence for the person who looks on."""
    return _text(op="status", level=1, message=text)


def parameter_values(values: Mapping[str, Value], asked: GetParameters) -> str:
    """Return the parameters that were asked for, as far as there are such."""
    found = [
        {"name": name, "value": value}
        for name, value in sorted(values.items())
        if not asked.parameterNames or name in asked.parameterNames
    ]
    return _text(op="parameterValues", parameters=found, **({} if asked.id is None else {"id": asked.id}))


def message_data(subscription: int, stamp: float, payload: bytes) -> bytes:
    """Return a message of a subscribed channel; `stamp` in seconds since 1970."""
    return struct.pack("<BIQ", _MESSAGE_DATA, subscription, int(stamp * 1e9)) + payload


def _text(**fields: object) -> str:
    return msgspec.json.encode(fields).decode()
