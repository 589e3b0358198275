"""What became of an operator's command to a robot."""

import msgspec

from fog_contracts.messages import Mode


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """What became of a command: the robot's answer, and its mode afterwards (None if it publishes no state).

    `code` identifies the refusal, and `causes` the conditions behind it, as in `CommandReply`.
    """

    accepted: bool
    reason: str
    mode: Mode | None
    code: str = ""
    causes: list[str] = []
