"""An operator's commands to robots: signed (stops need no key), sent over zenoh, answered by the robot itself."""

import secrets
from typing import Final

from fog_contracts import channels as ch
from fog_contracts.commands import STOPS, signed_command, unsigned_stop
from fog_contracts.messages import CommandKind, CommandReply, HandOver, Pose, RobotState
from fog_runtime.transports.zenoh_edge import ZenohEdge

REPLY_TIMEOUT_S: Final = 2.0


class RobotCommands:
    """Sends one operator's commands to robots; `operator` is the name that the robots log.

    Without a `key` it sends only commands that stop a robot (`fog_contracts.commands.STOPS`).
    """

    def __init__(self, edge: ZenohEdge, *, operator: str, key: bytes | None) -> None:
        self._edge = edge
        self._operator = operator
        self._key = key

    async def send(
        self,
        kind: CommandKind,
        robot: str,
        state: RobotState | None,
        pose: Pose | None = None,
        timeout_s: float = REPLY_TIMEOUT_S,
        *,
        given: HandOver | None = None,
    ) -> CommandReply | None:
        """Send a command (`initial_pose` with a pose, `hand_over` with what is `given`).

        Return None without a reply within `timeout_s` of the clock.
        `state` is the latest one that the robot published, at most 5 s ago; only a stop needs none.
        Raises `ContractError` for an invalid reply, `ValueError` for a command that needs key and state without them.
        """
        nonce = secrets.token_hex(16)
        if kind in STOPS:
            command = unsigned_stop(kind, robot=robot, operator=self._operator, nonce=nonce)
        elif self._key is None or state is None:
            raise ValueError(f"a command to {kind} needs the site's operator key and the robot's latest state")
        else:
            command = signed_command(
                kind,
                robot=robot,
                operator=self._operator,
                nonce=nonce,
                boot=state.boot,
                issued_at=state.clock,
                key=self._key,
                pose=pose,
                given=given,
            )
        return await self._edge.query(ch.ROBOT_COMMAND, command, CommandReply, timeout_s, robot=robot)
