"""Bytes to messages and back, with every limit enforced before a decoder sees the bytes."""

from typing import TypeVar

import msgspec

from fog_contracts.channels import Channel
from fog_contracts.messages import Message

M = TypeVar("M", bound=Message)


class ContractError(ValueError):
    """Bytes that violate the contract of their channel: too long, malformed, a field missing or out of range."""

    def __init__(self, channel: str, reason: str) -> None:
        super().__init__(f"{channel}: {reason}")
        self.channel = channel
        self.reason = reason


_json_encoder = msgspec.json.Encoder()
_msgpack_encoder = msgspec.msgpack.Encoder()
_decoders: dict[tuple[str, type[Message]], msgspec.json.Decoder[Message] | msgspec.msgpack.Decoder[Message]] = {}


def _decoder(encoding: str, kind: type[M]) -> msgspec.json.Decoder[M] | msgspec.msgpack.Decoder[M]:
    decoder = _decoders.get((encoding, kind))
    if decoder is None:
        new = msgspec.json.Decoder(kind) if encoding == "json" else msgspec.msgpack.Decoder(kind)
        _decoders[encoding, kind] = new  # type: ignore[assignment]  # no dict type says that a value decodes its key's type
        return new
    return decoder  # type: ignore[return-value]  # same


def encode(channel: Channel, message: Message, *, reply: bool = False) -> bytes:
    """Encode a message for its channel; raises `ContractError` when it is of another type or over the limit."""
    kind, limit = (channel.reply, channel.reply_limit) if reply else (channel.message, channel.limit)
    if kind is None or not isinstance(message, kind):
        raise ContractError(channel.name, f"carries {kind and kind.__name__}, not {type(message).__name__}")
    data = (_json_encoder if channel.encoding == "json" else _msgpack_encoder).encode(message)
    if len(data) > limit:
        raise ContractError(channel.name, f"{len(data)} bytes are over the limit of {limit}")
    return data


def decode(channel: Channel, data: bytes, kind: type[M], *, reply: bool = False) -> M:
    """Decode a payload of the channel as `kind`; raises `ContractError` that names the field and what is wrong."""
    expected, limit = (channel.reply, channel.reply_limit) if reply else (channel.message, channel.limit)
    if expected is not kind:
        raise ContractError(channel.name, f"carries {expected and expected.__name__}, not {kind.__name__}")
    if len(data) > limit:
        raise ContractError(channel.name, f"{len(data)} bytes are over the limit of {limit}")
    try:
        return _decoder(channel.encoding, kind).decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        # The decoder skips unknown fields, but a deeply nested one exhausts its stack.
        raise ContractError(channel.name, str(error)) from error


def encode_text(channel: Channel, text: str) -> bytes:
    """Encode the text of a plain-text channel; raises `ContractError` for another channel, or over the limit."""
    if channel.message is not None or channel.kind != "pub":
        raise ContractError(
            channel.name, f"carries {channel.message.__name__ if channel.message else 'nothing'}, not text"
        )
    data = text.encode()
    if len(data) > channel.limit:
        raise ContractError(channel.name, f"{len(data)} bytes are over the limit of {channel.limit}")
    return data


def decode_text(channel: Channel, data: bytes) -> str:
    """Decode a payload of a plain-text channel; raises `ContractError`."""
    if len(data) > channel.limit:
        raise ContractError(channel.name, f"{len(data)} bytes are over the limit of {channel.limit}")
    try:
        return data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ContractError(channel.name, f"not UTF-8: {error}") from error


def json_schema(kind: type[msgspec.Struct]) -> bytes:
    """Return the JSON schema of a type, which is self-contained: readers of recordings have no other."""
    (described,), components = msgspec.json.schema_components([kind], ref_template="#/$defs/{name}")
    # Foxglove needs an object at the top level, not a reference to one.
    root = components.pop(described["$ref"].rsplit("/", 1)[1]) if "$ref" in described else described
    return msgspec.json.encode({**root, "$defs": components})
