"""What agent and guardian tell each other over their Unix socket (SOCK_SEQPACKET, msgpack, one message a packet)."""

from typing import Annotated

import msgspec
from msgspec import Meta, Struct

from fog_contracts.messages import Count, Sentence

PACKET_LIMIT = 4096
"""Bytes of the largest packet that either side accepts."""

WheelSpeed = Annotated[float, Meta(ge=-0.5, le=0.5)]
Ticks = Annotated[int, Meta(ge=0, le=65_535)]


class WheelCommand(Struct, frozen=True, kw_only=True):
    """Wheel speeds that the agent asks for (m/s), 20 times a second; `seq` grows by one with each.

    `reset` passes on an operator's authenticated reset: the guardian clears a latched fault and wakes the base again.
    """

    seq: Count
    left: WheelSpeed
    right: WheelSpeed
    reset: bool = False


class BaseFeedback(Struct, frozen=True, kw_only=True):
    """What the guardian last read from the base.

    Encoders are raw counters of 16 bits that wrap. `fault` names what the serial link or the Open Interface does wrong
    (None: nothing), `stopped` why the guardian holds the wheels at zero whatever the agent asks (None: it doesn't).
    `battery` is the charged fraction, None when unknown.
    """

    seq: Count
    left_ticks: Ticks
    right_ticks: Ticks
    oi_mode: Annotated[int, Meta(ge=0, le=255)]
    bumper: bool
    cliff: bool
    wheel_drop: bool
    battery: Annotated[float, Meta(ge=0.0, le=1.0)] | None
    charging: bool
    fault: Sentence | None
    stopped: Sentence | None


encode = msgspec.msgpack.Encoder().encode
"""Encode either message."""
decode_command = msgspec.msgpack.Decoder(WheelCommand).decode
"""Decode a command; raises `msgspec.DecodeError`."""
decode_feedback = msgspec.msgpack.Decoder(BaseFeedback).decode
"""Decode feedback; raises `msgspec.DecodeError`."""
