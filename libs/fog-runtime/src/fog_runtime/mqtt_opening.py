"""The first packets of an MQTT connection: CONNECT, whose client id gets the user's name before it, and CONNACK.

A broker ends a connection when another one opens with the same client id. Ids can be guessed, so whoever has one user's
password could end the connections of all others. With `USER/` before it, a client id is the user's own (MQTT 3.1.1 and
5.0, section 3.1).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

CONNECT_BYTES: Final = 64 * 1024
"""Longest CONNECT that is read: with id, will, name and password; those of Fognav have less than 1 KiB."""
_CONNECT: Final = 0x10
_CONNACK: Final = 0x20
_MQTT_5: Final = 5
_WILL: Final = 0x04
_USER: Final = 0x80
_TEXT_MAX: Final = 0xFFFF
_CONTINUES: Final = 0x80
_NUMBER_BYTES: Final = 4


class MalformedError(ValueError):
    """What should be a CONNECT packet is none."""


class _IncompleteError(Exception):
    """More bytes are needed."""


@dataclass
class _Reader:
    """Reads the fields of a packet one after another."""

    data: bytes
    at: int = 0

    def take(self, size: int) -> bytes:
        """Return the next bytes; raises `_IncompleteError`."""
        if self.at + size > len(self.data):
            raise _IncompleteError
        self.at += size
        return self.data[self.at - size : self.at]

    def number(self) -> int:
        """Return a number of variable length (section 2.2.3, 1.5.5)."""
        value = 0
        for index in range(_NUMBER_BYTES):
            byte = self.take(1)[0]
            value |= (byte & ~_CONTINUES) << (7 * index)
            if not byte & _CONTINUES:
                return value
        raise MalformedError("a length of more than four bytes")

    def text(self) -> bytes:
        """Return a string, or binary data, without its length."""
        return self.take(int.from_bytes(self.take(2), "big"))


def _number(value: int) -> bytes:
    encoded = bytearray()
    while True:
        value, low = divmod(value, _CONTINUES)
        encoded.append(low | (_CONTINUES if value else 0))
        if not value:
            return bytes(encoded)


def _text(data: bytes) -> bytes:
    if len(data) > _TEXT_MAX:
        raise MalformedError("a client id that is too long")
    return len(data).to_bytes(2, "big") + data


def with_user_in_id(packet: bytes) -> tuple[bytes, bytes]:
    """Return the body of a CONNECT packet whose client id begins with `USER/`, and the user; raises `MalformedError`.

    An id that the broker shall choose stays empty, and who gives no user's name keeps his.
    """
    reader = _Reader(packet)
    try:
        reader.text()  # the protocol's name
        level, flags, *_ = reader.take(4)  # and the keep-alive
        if level == _MQTT_5:
            reader.take(reader.number())
        before = reader.at
        client = reader.text()
        after = reader.at
        if flags & _WILL:
            if level == _MQTT_5:
                reader.take(reader.number())
            reader.text()
            reader.text()
        user = reader.text() if flags & _USER else b""
    except _IncompleteError as error:
        raise MalformedError("a CONNECT packet that ends too early") from error
    if not client or not user:
        return packet, user
    return packet[:before] + _text(user + b"/" + client) + packet[after:], user


class MqttOpening:
    """Changes the client id in CONNECT, and sees in CONNACK whether the broker has let the client in."""

    def __init__(self) -> None:
        self.user = ""
        self._sent = bytearray()
        self._connected = False
        self._answered = bytearray()

    def from_client(self, data: bytes) -> bytes:
        """Return what to pass on of the client's next bytes; raises `MalformedError`."""
        if self._connected:
            return data
        self._sent += data
        reader = _Reader(bytes(self._sent[: CONNECT_BYTES + 8]))
        try:
            if reader.take(1)[0] != _CONNECT:
                raise MalformedError("something else than CONNECT")
            size = reader.number()
            if size > CONNECT_BYTES:
                raise MalformedError("a CONNECT packet that is too long")
            packet, user = with_user_in_id(reader.take(size))
        except _IncompleteError:
            return b""
        self._connected, self.user = True, user.decode(errors="replace")
        return bytes((_CONNECT,)) + _number(len(packet)) + packet + bytes(self._sent[reader.at :])

    def admits(self, data: bytes) -> bool:
        """Whether CONNACK with the code 0 has come, with these next bytes of the broker's."""
        self._answered += data
        reader = _Reader(bytes(self._answered[:16]))
        try:
            if reader.take(1)[0] != _CONNACK:
                return False
            reader.number()
            return reader.take(2)[1] == 0
        except _IncompleteError:
            return False
