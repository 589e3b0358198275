"""Messages between agent and guardian on their Unix socket (SOCK_SEQPACKET, msgpack, one message a packet).

To an agent that it refuses the guardian sends one sentence, the reason, and closes the link.
"""

from typing import Annotated, Final, Literal

import msgspec
from msgspec import Meta, Struct

from fog_contracts.messages import Code, Count, Sentence
from robot_agent.hardware import BaseStatus, WheelOdometry

PACKET_LIMIT = 4096
"""Bytes of the largest packet that either side accepts."""

WHEEL_SPEED_MAX_M_S: Final = 0.5
"""No base of this system turns a wheel faster, whatever its own limit."""

WheelSpeed = Annotated[float, Meta(ge=-WHEEL_SPEED_MAX_M_S, le=WHEEL_SPEED_MAX_M_S)]


Maneuver = Literal["seek_dock", "leave_dock", "back_off"]
"""A movement beyond ordinary driving, which the guardian allows within limits of its own (`guardian.maneuvers`)."""


class WheelCommand(Struct, frozen=True, kw_only=True):
    """Wheel speeds that the agent requests (m/s), 20 times a second, 10 times when idle; `seq` grows by one with each.

    `reset` passes on an operator's authenticated reset: the guardian clears a latched fault and wakes the base again.
    `maneuver` goes on as long as it is asked for. `rest`: the base may sleep until a command without it.
    """

    seq: Count
    left: WheelSpeed
    right: WheelSpeed
    reset: bool = False
    maneuver: Maneuver | None = None
    rest: bool = False


class BaseFeedback(Struct, frozen=True, kw_only=True):
    """The newest reading of the base.

    `fault`: the guardian's latched fault, or the silence of a base that has not moved yet (None: none), `fault_code`
    its identifier. `stopped`: why the guardian keeps the wheels at zero whatever the agent requests (None: it does
    not). `corrupted`: damaged frames of the base so far. `bumped`: the fault is a pressed bumper, from which the robot
    may back off. `passing`: it is the silence of a base that has not moved yet, and ends with it. `at`: when it was
    sent, s of the monotonic clock that agent and guardian share (None: unknown). `guardian`: the id of this run of the
    guardian. `travel_wrap_m`: that of the drive train by which it reads the counters (None: unknown).
    """

    seq: Count
    status: BaseStatus
    odometry: WheelOdometry
    fault: Sentence | None
    stopped: Sentence | None
    fault_code: Code = ""
    corrupted: Count = 0
    bumped: bool = False
    passing: bool = False
    at: float | None = None
    guardian: Annotated[str, Meta(max_length=32)] = ""
    travel_wrap_m: float | None = None


encode = msgspec.msgpack.Encoder().encode
"""Encode either message, or the reason of a refusal."""
decode_command = msgspec.msgpack.Decoder(WheelCommand).decode
"""Decode a command; raises `msgspec.DecodeError`."""
decode_feedback = msgspec.msgpack.Decoder(BaseFeedback).decode
"""Decode feedback; raises `msgspec.DecodeError`."""
decode_reply = msgspec.msgpack.Decoder(BaseFeedback | Sentence).decode
"""Decode what the guardian sent: feedback, or the reason why it refuses this agent; raises `msgspec.DecodeError`."""
