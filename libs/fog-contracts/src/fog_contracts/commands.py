"""Signing and validation of operators' commands to a robot (HMAC-SHA256 over the encoded command without signature).

A command that only stops a robot needs no signature: whoever reaches the robot may stop it, with any clock and no key.
"""

import hmac
from collections.abc import Mapping
from typing import Final

import msgspec

from fog_contracts.messages import CommandKind, HandOver, Pose, ProfileName, Reason, RefusalCode, RobotCommand

VALID_S: Final = 5.0
"""Seconds of the robot's clock after `issued_at` during which a command is valid."""
KEY_BYTES: Final = 32
STOPS: Final[frozenset[CommandKind]] = frozenset({"disable", "cancel"})
"""Commands that pass unsigned, at any age and repeatedly: a refused stop is worse than an unwanted one."""
PROFILE_OF: Final[Mapping[CommandKind, ProfileName]] = {
    "profile_default": "default", "profile_full": "full", "profile_fog": "fog",
}  # fmt: skip
"""The profile of navigation that a command selects."""


def _signature(command: RobotCommand, key: bytes) -> bytes:
    if len(key) < KEY_BYTES:
        raise ValueError(f"the operators' key must have at least {KEY_BYTES} bytes, not {len(key)}")
    unsigned = msgspec.structs.asdict(msgspec.structs.replace(command, signature=b""))
    if command.given is None:
        del unsigned["given"]  # robots of an earlier version sign without it
    elif command.given.mission is None:  # and so do they without this
        unsigned["given"] = msgspec.structs.asdict(command.given)
        del unsigned["given"]["mission"]
    return hmac.digest(key, msgspec.msgpack.encode(unsigned), "sha256")


def sign(command: RobotCommand, key: bytes) -> RobotCommand:
    """Return the command with its signature; raises `ValueError` when the key is too short."""
    return msgspec.structs.replace(command, signature=_signature(command, key))


def unsigned_stop(kind: CommandKind, *, robot: str, operator: str, nonce: str) -> RobotCommand:
    """Return a command that stops a robot, for who has no key; raises `ValueError` for any other kind."""
    if kind not in STOPS:
        raise ValueError(f"a command to {kind} must be signed with the site's operator key")
    return RobotCommand(kind=kind, robot=robot, operator=operator, nonce=nonce)


def signed_command(  # noqa: PLR0913  # the fields of a command
    kind: CommandKind,
    *,
    robot: str,
    operator: str,
    nonce: str,
    boot: str,
    issued_at: float,
    key: bytes,
    pose: Pose | None = None,
    given: HandOver | None = None,
) -> RobotCommand:
    """Return an operator's signed command; raises `ValueError` when the key is too short.

    `nonce` must never repeat; `boot` and `issued_at` are `boot` and `clock` of the robot's latest state; `pose` belongs
    to `initial_pose` only, `given` to `hand_over`.
    """
    unsigned = RobotCommand(
        kind=kind, pose=pose, given=given, robot=robot, operator=operator, nonce=nonce, boot=boot, issued_at=issued_at
    )
    return sign(unsigned, key)


class CommandGate:
    """Accepts a command once: for this run of this robot, correctly signed, at most 5 s old, with an unused nonce.

    Of a command that stops the robot only the robot's id is checked. Ages are of the robot's monotonic clock.
    A nonce is kept only while its command could still be valid, so the command rate bounds the memory.
    """

    def __init__(self, robot: str, key: bytes, boot: str) -> None:
        self._robot = robot
        self._key = key
        self._boot = boot
        self._nonce_expiry: dict[str, float] = {}

    def refusal(self, command: RobotCommand, now: float) -> Reason | None:
        """Return why the command is refused at `now`, or None to accept it; each is accepted once, a stop always."""
        if command.robot != self._robot:
            sentence = f"this robot is {self._robot}, the command is for {command.robot}"
            return Reason(RefusalCode.OTHER_ROBOT, sentence)
        if command.kind in STOPS:
            return None
        if not hmac.compare_digest(command.signature, _signature(command, self._key)):
            sentence = "the signature does not match: sign the command with the site's operator key"
            return Reason(RefusalCode.NOT_SIGNED, sentence)
        if command.boot != self._boot:
            sentence = "the command was issued to another run of the agent, which restarted: issue it again"
            return Reason(RefusalCode.OTHER_RUN, sentence)
        return _age_refusal(now - command.issued_at) or self._use(command, now)

    def _use(self, command: RobotCommand, now: float) -> Reason | None:
        self._nonce_expiry = {nonce: expiry for nonce, expiry in self._nonce_expiry.items() if expiry >= now}
        if command.nonce in self._nonce_expiry:
            return Reason(RefusalCode.REPEATED, "this command was already carried out: issue a new one")
        self._nonce_expiry[command.nonce] = command.issued_at + 2 * VALID_S
        return None


def _age_refusal(age: float) -> Reason | None:
    if age < 0.0:
        ahead = f"the command was issued {-age:.1f} s in the future of the robot's clock: take `clock` from its state"
        return Reason(RefusalCode.FROM_FUTURE, ahead)
    if age > VALID_S:
        old = f"the command is {age:.1f} s old, more than {VALID_S:.0f} s: issue it again"
        return Reason(RefusalCode.TOO_OLD, old)
    return None
