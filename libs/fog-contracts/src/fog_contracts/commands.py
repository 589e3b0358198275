"""Signing and judging of operators' commands to a robot (HMAC-SHA256 over the encoded command without signature)."""

import hmac
from typing import Final

import msgspec

from fog_contracts.messages import RobotCommand

VALID_S: Final = 5.0
"""How long after `issued_at` a command may be carried out."""
KEY_BYTES: Final = 32


def _signature(command: RobotCommand, key: bytes) -> bytes:
    if len(key) < KEY_BYTES:
        raise ValueError(f"the operators' key must have at least {KEY_BYTES} bytes, not {len(key)}")
    unsigned = msgspec.structs.replace(command, signature=b"")
    return hmac.digest(key, msgspec.msgpack.encode(unsigned), "sha256")


def sign(command: RobotCommand, key: bytes) -> RobotCommand:
    """Return the command with its signature; raises `ValueError` when the key is too short."""
    return msgspec.structs.replace(command, signature=_signature(command, key))


class CommandGate:
    """Lets a command through once: right robot, right signature, not older than 5 s, nonce never seen.

    A nonce is remembered as long as its command could still be valid, so memory stays bounded by the command rate.
    """

    def __init__(self, robot: str, key: bytes) -> None:
        self._robot = robot
        self._key = key
        self._seen: dict[str, float] = {}

    def refusal(self, command: RobotCommand, stamp: float) -> str | None:
        """Return why the command must not be carried out at `stamp`, or None; a command passes at most once."""
        if command.robot != self._robot:
            return f"this robot is {self._robot}, the command is for {command.robot}"
        if not hmac.compare_digest(command.signature, _signature(command, self._key)):
            return "the signature does not fit: sign with the site's operator key"
        age = stamp - command.issued_at
        if not -VALID_S <= age <= VALID_S:
            return (
                f"the command is {age:.1f} s old, more than {VALID_S:.0f} s: issue it again (are the clocks in step?)"
            )
        self._seen = {nonce: until for nonce, until in self._seen.items() if until >= stamp}
        if command.nonce in self._seen:
            return "this command was carried out already: issue a new one"
        self._seen[command.nonce] = command.issued_at + 2 * VALID_S
        return None
