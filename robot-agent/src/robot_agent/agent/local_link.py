"""Messages between the agent and the tools on its own computer, on a Unix socket (SOCK_SEQPACKET, msgpack).

Down come the entries of the input log as they happen (`agent.recording.input_log`): what is shown live and what is
recorded are one format. Up go the words of an operator who stands at the robot and drives it by hand. Who may open the
socket is that operator: its file belongs to the robot's user and group (ADR 64).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec import Struct

from fog_contracts.messages import Count
from robot_agent.agent.hand_driving import HandReply, HandRequest
from robot_agent.agent.recording.input_log import ENTRY_OF_TOPIC, TOPIC_OF_ENTRY

if TYPE_CHECKING:
    from pathlib import Path

    from robot_agent.agent.recording.input_log import Entry

SOCKET: Final = "agent.sock"
"""Name of the agent's socket, in the folder of the guardian's."""
PACKET_LIMIT: Final = 262_144
"""Bytes of the largest packet down: a scan has some 7,000."""
REQUEST_LIMIT: Final = 1024
"""Bytes of the largest packet up."""


class Missed(Struct, frozen=True, kw_only=True):
    """So many entries did not fit into the socket: this reader is too slow for them."""

    count: Count


class Equipment(Struct, frozen=True, kw_only=True):
    """What the agent runs with, as far as no measurement tells it: said at once, and once a second.

    `version`: of its code. `processes`: ids of the robot's processes, by name. `base`, `lidar`: why nothing is heard of
    it; empty while something is. `damaged`: frames of each device so far that came damaged. `mirrored`, `masks`: how
    the lidar is mounted by the settings that this agent has read (`fog_contracts.robot.LidarSettings`).
    """

    version: str
    processes: dict[str, int] = {}
    base: str = ""
    lidar: str = ""
    damaged: dict[str, int] = {}
    mirrored: bool = False
    masks: list[tuple[float, float]] = []


_OTHERS: Final[dict[str, type[Struct]]] = {
    "local/reply": HandReply,
    "local/missed": Missed,
    "local/equipment": Equipment,
}
_TOPICS: Final[dict[type, str]] = {kind: topic for topic, kind in _OTHERS.items()} | dict(TOPIC_OF_ENTRY)
_KINDS: Final[dict[str, type[Struct]]] = _OTHERS | dict(ENTRY_OF_TOPIC)
_envelope = msgspec.msgpack.Decoder(tuple[str, msgspec.Raw])
_requests: msgspec.msgpack.Decoder[HandRequest] = msgspec.msgpack.Decoder(HandRequest)
encode_request = msgspec.msgpack.Encoder().encode


def encode(what: Entry | HandReply | Missed | Equipment) -> bytes:
    """Return the packet of an entry or a reply."""
    return msgspec.msgpack.encode((_TOPICS[type(what)], what))


def decode(packet: bytes) -> Any:  # noqa: ANN401  # an `Entry`, or one of the above
    """Return what a packet holds; None for a kind that this version does not know. Raises `msgspec.DecodeError`."""
    topic, data = _envelope.decode(packet)
    kind = _KINDS.get(topic)
    return None if kind is None else msgspec.msgpack.decode(data, type=kind)


def decode_request(packet: bytes) -> HandRequest:
    """Return an operator's request; raises `msgspec.DecodeError`."""
    return _requests.decode(packet)


def socket_beside(guardian_socket: Path) -> Path:
    """Return the path of the agent's socket of a robot with this guardian's socket."""
    return guardian_socket.with_name(SOCKET)
