"""Idempotency keys: a request that is repeated after a lost response returns the first result and does nothing.

The result is stored in the same atomic step as the change itself, so there is never one without the other.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from typing import Final

import msgspec

LIFETIME_S: Final = 86_400
"""Seconds for which a result is remembered."""


class IdempotencyError(ValueError):
    """An idempotency key was used for another request before."""


class _Result(msgspec.Struct, frozen=True):
    fingerprint: str
    record: msgspec.Raw


@dataclass(frozen=True, slots=True)
class Attempt:
    """One attempt at a request: the key in the store, and a fingerprint of the request."""

    name: str
    fingerprint: str

    @classmethod
    def of(cls, caller: str, key: str, target: str, body: object) -> Attempt:
        """Return the attempt of a caller with this Idempotency-Key at a request: its target (a path) and body."""
        name = hashlib.sha256(f"{caller}\n{key}".encode()).hexdigest()
        fingerprint = hashlib.sha256(target.encode() + b"\n" + msgspec.json.encode(body)).hexdigest()
        return cls(f"idempotency:{name}", fingerprint)

    def result(self, record: bytes) -> object:
        """Return what is stored for this attempt."""
        return _Result(self.fingerprint, msgspec.Raw(record))

    def recorded(self, data: bytes) -> bytes:
        """Return the record in a stored result; raises `IdempotencyError` if it is another request's."""
        result = msgspec.json.decode(data, type=_Result)
        if result.fingerprint != self.fingerprint:
            raise IdempotencyError("this Idempotency-Key was used for another request: use a new one")
        return bytes(result.record)
