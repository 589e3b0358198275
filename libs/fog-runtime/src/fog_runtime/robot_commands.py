"""An operator's commands to robots: signed (stops need no key), sent over zenoh, answered by the robot itself."""

import secrets
from typing import Final

from fog_contracts import channels as ch
from fog_contracts.commands import signed_command, unsigned_stop
from fog_contracts.messages import CommandKind, CommandReply, Pose
from fog_runtime.clock import Clock
from fog_runtime.zenoh_edge import ZenohEdge

REPLY_TIMEOUT_S: Final = 2.0


class RobotCommands:
    """Sends one operator's commands to robots; `operator` is the name that the robots log.

    Without a `key` it sends only commands that stop a robot (`fog_contracts.commands.STOPS`).
    """

    def __init__(self, edge: ZenohEdge, clock: Clock, *, operator: str, key: bytes | None) -> None:
        self._edge = edge
        self._clock = clock
        self._operator = operator
        self._key = key

    async def send(
        self, kind: CommandKind, robot: str, pose: Pose | None = None, timeout_s: float = REPLY_TIMEOUT_S
    ) -> CommandReply | None:
        """Send a command (`initial_pose` with a pose); return None without a reply within `timeout_s` of the clock.

        Raises `ContractError` for an invalid reply, `ValueError` for a command that needs a key without one.
        """
        nonce = secrets.token_hex(16)
        if self._key is None:
            command = unsigned_stop(kind, robot=robot, operator=self._operator, nonce=nonce)
        else:
            command = signed_command(
                kind,
                robot=robot,
                operator=self._operator,
                nonce=nonce,
                issued_at=self._clock.stamp(),
                key=self._key,
                pose=pose,
            )
        return await self._edge.query(ch.ROBOT_COMMAND, command, CommandReply, timeout_s, robot=robot)
